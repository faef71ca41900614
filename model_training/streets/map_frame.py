"""Convert WGS-84 or projected coordinates to a dataset's map frame (x east, y north, metres). pyproj stays offline."""

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import DatasetError
from service.geometry.earth import Georeference

Points = Float64[NDArray[np.float64], "n 2"]
#: Greatest distance from the map's origin, metres. The map frame is a plane: the ground at 50 km lies 200 m below it.
#: No survey of one map reaches that far.
FARTHEST_M = 50_000.0


class MapFrame:
    """The frame of a map on the Earth.

    Args:
        georeference: of the map's origin, as in ``dataset.json``.

    Raises:
        DatasetError: the georeference is no place on the Earth.
    """

    def __init__(self, georeference: Mapping[str, Any]) -> None:
        try:
            self.origin = Georeference(**georeference)
        except (TypeError, ValueError) as error:
            raise DatasetError(f"dataset.json: georeference: {error}", field="georeference") from error
        o = self.origin
        place = f"+lat_0={o.latitude_deg!r} +lon_0={o.longitude_deg!r} +h_0={o.height_m!r}"
        self._to_map = _pyproj().Transformer.from_pipeline(
            "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
            f"+step +proj=topocentric +ellps=WGS84 {place}"
        )

    def from_wgs84(self, longitude_latitude_deg: Points) -> Points:
        """Convert WGS-84 coordinates to map coordinates (n, 2), metres.

        Streets have no height, so the points get the height of the origin.

        Args:
            longitude_latitude_deg: (n, 2), degrees, in GeoJSON's order.

        Returns:
            Map coordinates (n, 2); NaN for a point that is invalid or further than ``FARTHEST_M`` from the origin.
        """
        longitude, latitude = np.asarray(longitude_latitude_deg, np.float64).reshape(-1, 2).T
        x, y, z = self._to_map.transform(longitude, latitude, np.full(len(longitude), self.origin.height_m))
        known = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360) & (np.sqrt(x**2 + y**2 + z**2) <= FARTHEST_M)
        # The distance includes z: a point on the other side of the Earth has x and y near 0.
        points: Points = np.where(known[:, None], np.column_stack([x, y]), np.nan)
        return points

    def from_projection(self, points: Points, projection: str) -> Points:
        """Convert projected coordinates to map coordinates (n, 2), metres; NaN as in ``from_wgs84``.

        Args:
            points: eastings and northings (n, 2).
            projection: a PROJ string, WKT or an authority's code, as in OpenDRIVE's geoReference.

        Raises:
            DatasetError: PROJ does not understand the projection.
        """
        pyproj = _pyproj()
        # We need no heights, and the geoid grids for them (egm96) are rarely installed.
        flat = " ".join(word for word in projection.split() if not word.startswith(("+geoidgrids=", "+vunits=")))
        try:
            crs = pyproj.CRS.from_user_input(flat)
            if crs.is_compound:
                crs = crs.sub_crs_list[0]
            to_earth = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        except pyproj.exceptions.ProjError as error:
            raise DatasetError(
                f"geoReference {projection!r} is not a projection that PROJ knows ({error}); correct it, or use the "
                "coordinates unchanged with --frame map",
                field="geoReference",
            ) from error
        return self.from_wgs84(np.column_stack(to_earth.transform(points[:, 0], points[:, 1])))


def _pyproj() -> ModuleType:
    import pyproj
    import pyproj.network

    pyproj.network.set_network_enabled(active=False)  # type: ignore[attr-defined]  # documented, but not in its __all__
    return pyproj
