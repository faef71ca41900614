"""What a map bundle is made of, before it is written and after it is opened."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy.typing import NDArray

from service.imaging.view_grid import ViewGrid
from service.registration.surfel_map import SurfelMap

PLACES_FILE, VIEWS_FILE = "places.npy", "views.npy"
ENCODER_FILE = "encoder.onnx"
CALIBRATION_FILE, PREVIEW_FILE = "calibration.json", "preview.webp"
CLOUD_FOLDER = "cloud"
#: What maps are merged by; a service only checks its hash.
STATISTICS_FILE = "voxels.npy"

#: What no map reaches, metres from its origin; and how far a rotation may be off by what its numbers were rounded to.
MOST_AWAY_M, _SKEW = 1e7, 1e-3
NO_POSE = f"a pose is not finite, stretches, mirrors, or lies more than {MOST_AWAY_M:g} m from the origin"

UNCALIBRATED = {"calibrated": False, "why": "nobody calibrated it; answers carry confidence null"}

#: A place: pose of the levelled LiDAR (x forward, z up) and the number of its street's feature, -1 for none.
PLACE = np.dtype([("T_map_place", "<f8", (4, 4)), ("street", "<i4")])
#: A view: the number of its place and its heading, counter-clockwise from map x.
VIEW = np.dtype([("place", "<i4"), ("heading_rad", "<f8")])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundleContent:
    """All that a map is, in memory; ``write_bundle`` makes files of it.

    Attributes:
        name: how requests address the map.
        headings: views of each place's fan.
        spacing_m: travelled distance between places.
        rows_seen: rows of the view grid that the survey's sensor covers.
        T_map_place: levelled pose of each place: x forward, z up, the LiDAR at the origin.
        place_street: number of the feature in ``streets`` that each place lies in; -1 for none.
        view_place: place of each view.
        view_heading_rad: heading of each view in the map frame.
        descriptors: unit vectors, a row a view.
        encoder: the ONNX file that made them.
        streets: GeoJSON, or None where the map knows no streets.
        cloud: the prepared cloud, or None where there is nothing to register on.
        statistics: sums of the points of every voxel of the cloud, for whoever adds to the map; None keeps none.
        calibration: confidence calibration; by default there is none.
        preview_webp: the map from above; may be empty.
        parameters: further numbers the map was built with; ``lidar_height_m`` must be there.
    """

    name: str
    grid: ViewGrid
    headings: int
    spacing_m: float
    rows_seen: Bool[NDArray[np.bool_], " rows"]
    T_map_place: Float64[NDArray[np.float64], "P 4 4"]
    place_street: Int32[NDArray[np.int32], " P"]
    view_place: Int32[NDArray[np.int32], " V"]
    view_heading_rad: Float64[NDArray[np.float64], " V"]
    descriptors: Float32[NDArray[np.float32], "V D"]
    encoder: bytes
    parameters: Mapping[str, float]
    streets: Mapping[str, Any] | None = None
    cloud: SurfelMap | None = None
    statistics: NDArray[Any] | None = None
    calibration: Mapping[str, Any] = field(default_factory=lambda: dict(UNCALIBRATED))
    preview_webp: bytes = b""
    georeference: Mapping[str, Any] | None = None
    licence: str = ""
    tool_versions: Mapping[str, str] = field(default_factory=dict)


def are_poses(T: Float64[NDArray[np.float64], "n 4 4"]) -> bool:
    """Whether each turns and moves, no more: one that does not spoils all that is reckoned with it."""
    R = T[:, :3, :3]
    if not (np.abs(T[:, :3, 3]) <= MOST_AWAY_M).all() or not (np.abs(R) <= 1 + _SKEW).all():
        return False
    skew = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3))
    return bool((skew < _SKEW).all() and (np.linalg.det(R) > 0).all() and (T[:, 3] == [0, 0, 0, 1]).all())
