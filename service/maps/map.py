"""An open map: its places, views, descriptors, streets, calibration and cloud, however its files are organised."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32
from numpy.typing import NDArray

from service.geometry.earth import Georeference
from service.imaging.view_grid import ViewGrid
from service.maps import content as parts
from service.maps.calibration import Calibration
from service.maps.files import read_file
from service.maps.index import ViewIndex
from service.maps.manifest import Manifest
from service.maps.streets import Streets
from service.registration.surfel_tiles import Cloud


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    """An open map. Threads may share it: the arrays of its files are read-only and memory-mapped.

    Attributes:
        path: folder of the map.
        manifest: the checked manifest.
        grid: the view grid of the map views.
        rows_seen: True for the rows of the view grid that the survey's sensor covers.
        places: (P,) of dtype ``PLACE``.
        views: (V,) of dtype ``VIEW``, sorted by place.
        view_index: index of the descriptors.
        streets: street polygons. None if the map has none.
        streets_document: GeoJSON of the streets. It stays in memory, because the folder may be removed while the
            service still uses the map.
        calibration: confidence calibration. None if the map is not calibrated.
        cloud: the cloud. None if the map has nothing to register against.
        places_xy: x of all places, then y of all places, map frame, metres. In memory.
    """

    path: Path
    manifest: Manifest
    grid: ViewGrid
    rows_seen: Bool[NDArray[np.bool_], " rows"]
    places: NDArray[Any]
    views: NDArray[Any]
    view_index: ViewIndex
    streets: Streets | None
    streets_document: bytes | None
    calibration: Calibration | None
    cloud: Cloud | None
    places_xy: Float64[NDArray[np.float64], "2 P"] = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "places_xy", np.ascontiguousarray(self.T_map_place[:, :2, 3].T))

    def searched(
        self,
        descriptor: Float32[NDArray[np.float32], " D"],  # noqa: ARG002 - as of TiledMap
        near: tuple[Float64[NDArray[np.float64], "2"], float] | None = None,  # noqa: ARG002
    ) -> "Map":
        """Return the part of the map to search for a query: all of it. A tiled map has parts (``TiledMap.searched``).

        Args:
            descriptor: descriptor of the query.
            near: x and y (m, map frame) and radius (m) of the area where the camera is; None if unknown.
        """
        return self

    def around(self, positions_of: Callable[[], Float64[NDArray[np.float64], "n 3"]]) -> "Map":  # noqa: ARG002 - as of TiledMap
        """Return the part of the map around some positions: all of it. A tiled map has parts (``TiledMap.around``).

        Args:
            positions_of: returns the positions, map frame, m, the most important first. Only a tiled map needs them.
        """
        return self

    def expect_next(self, xy_m: Float64[NDArray[np.float64], "2"], before_m: Float64[NDArray[np.float64], "2"]) -> None:
        """Take note of where a camera moves. Only a tiled map has tiles to prepare (``TiledMap.expect_next``).

        Args:
            xy_m: x and y of the camera, map frame, m.
            before_m: x and y one step earlier, map frame, metres.
        """

    @property
    def open_tiles(self) -> int:
        """Number of open tiles of a tiled map; 0 for a map of one bundle."""
        return 0

    def numbers_of(self, places: Int32[NDArray[np.int32], " n"]) -> Int32[NDArray[np.int32], " n"]:
        """Return the numbers of some places in the whole map: the same. A part of a tiled map has its own indices.

        Args:
            places: indices of places in ``places``.
        """
        return places

    @property
    def name(self) -> str:
        """Name of the map in requests."""
        return self.manifest.name

    @property
    def T_map_place(self) -> Float64[NDArray[np.float64], "P 4 4"]:
        """Levelled pose of each place: x forward, z up, the LiDAR at the origin."""
        poses: Float64[NDArray[np.float64], "P 4 4"] = self.places["T_map_place"]
        return poses

    @property
    def place_street(self) -> Int32[NDArray[np.int32], " P"]:
        """Index of each place's street feature; -1 for none."""
        numbers: Int32[NDArray[np.int32], " P"] = self.places["street"]
        return numbers

    @property
    def view_place(self) -> Int32[NDArray[np.int32], " V"]:
        """Index of the place of each view."""
        numbers: Int32[NDArray[np.int32], " V"] = self.views["place"]
        return numbers

    @property
    def view_heading_rad(self) -> Float64[NDArray[np.float64], " V"]:
        """Heading of each view, radians, counter-clockwise from map x."""
        headings: Float64[NDArray[np.float64], " V"] = self.views["heading_rad"]
        return headings

    @property
    def earth(self) -> Georeference | None:
        """WGS-84 position of the map's origin. None if the manifest has no georeference."""
        georeference = self.manifest.georeference
        return None if georeference is None else Georeference(**georeference)

    def encoder_bytes(self) -> bytes:
        """Return the content of the encoder's ONNX file.

        Raises:
            BundleError: the file cannot be read, for example because the bundle was removed after opening.
        """
        return read_file(self.path / parts.ENCODER_FILE)

    def streets_geojson(self) -> bytes:
        """Return the streets' GeoJSON as in the file, or an empty collection if the map has none."""
        if self.streets_document is None:
            return b'{"type": "FeatureCollection", "features": []}\n'
        return self.streets_document
