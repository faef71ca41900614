"""The parts of a map bundle: file names, array types and the content in memory."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy.typing import NDArray

from service.imaging.view_grid import ViewGrid
from service.maps.byte_planes import Columns
from service.registration.surfel_map import SurfelMap

PLACES_FILE, VIEWS_FILE = "places.npy", "views.npy"
ENCODER_FILE = "encoder.onnx"
CALIBRATION_FILE, PREVIEW_FILE = "calibration.json", "preview.webp"
CLOUD_FOLDER = "cloud"
#: Voxel statistics for merging and updating maps, which check the hash of this file. The service only checks its size.
STATISTICS_FILE = "voxels.zst"
#: Files that the service does not read. A folder that only serves may lack them (``maps/store``).
NOT_SERVED = frozenset({STATISTICS_FILE, PREVIEW_FILE})

#: Largest coordinate of a pose (m). Largest error of an entry of R R^T, which allows for rounded numbers.
MOST_AWAY_M, _SKEW = 1e7, 1e-3
NO_POSE = f"a pose is not finite, scales, mirrors, or is more than {MOST_AWAY_M:g} m from the origin"

#: Content of ``calibration.json`` for a map without calibration.
UNCALIBRATED = {"calibrated": False, "why": "nobody calibrated it; answers carry confidence null"}

#: A place: pose of the levelled LiDAR (x forward, z up), and the index of its street's feature (-1: none).
PLACE = np.dtype([("T_map_place", "<f8", (4, 4)), ("street", "<i4")])
#: A map view: the index of its place, and its heading (rad), counter-clockwise from map x.
VIEW = np.dtype([("place", "<i4"), ("heading_rad", "<f8")])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BundleContent:
    """The complete content of a map in memory. ``write_bundle`` writes it to files.

    Attributes:
        name: name of the map in requests.
        grid: the view grid of the map views.
        headings: number of map views per place.
        spacing_m: travelled distance between places, metres.
        rows_seen: True for the rows of the view grid that the survey's sensor covers.
        T_map_place: levelled pose of each place: x forward, z up, the LiDAR at the origin.
        place_street: index of the feature in ``streets`` that each place lies in; -1 for none.
        view_place: index of the place of each view.
        view_heading_rad: heading of each view, radians, counter-clockwise from map x.
        descriptors: unit vectors, a row per view.
        encoder: content of the ONNX file that computed the descriptors.
        parameters: further numbers that the map was built with. ``lidar_height_m`` is required.
        streets: GeoJSON FeatureCollection. None if the map has no streets.
        cloud: the prepared cloud. None if the map has nothing to register against.
        statistics: sums over the points of each voxel of the cloud, for merging and updating; they may be computed while they are
            written. None stores none.
        calibration: content of ``calibration.json``. The default states that there is no calibration.
        preview_webp: image of the map from above. May be empty.
        georeference: arguments of ``Georeference`` for the map's origin. None if the position on the Earth is unknown.
        licence: text of the licence. May be empty.
        tool_versions: version of each tool that built the map, by name.
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
    statistics: Columns | None = None
    calibration: Mapping[str, Any] = field(default_factory=lambda: dict(UNCALIBRATED))
    preview_webp: bytes = b""
    georeference: Mapping[str, Any] | None = None
    licence: str = ""
    tool_versions: Mapping[str, str] = field(default_factory=dict)


def are_poses(T: Float64[NDArray[np.float64], "n 4 4"]) -> bool:
    """Check that all matrices are rigid transforms with coordinates up to ``MOST_AWAY_M``.

    Args:
        T: candidate poses, translation in metres.

    Returns:
        False if any matrix is not finite, stretches, shears, mirrors or lies too far from the origin.
    """
    R = T[:, :3, :3]
    if not (np.abs(T[:, :3, 3]) <= MOST_AWAY_M).all() or not (np.abs(R) <= 1 + _SKEW).all():
        return False
    skew = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3))
    return bool((skew < _SKEW).all() and (np.linalg.det(R) > 0).all() and (T[:, 3] == [0, 0, 0, 1]).all())
