"""Move a dataset into another map frame on the Earth, for example into the frame that all maps of a region share.

A map frame is a plane that touches the Earth at its origin (east, north, up). So two frames differ by an exact rigid transform.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import DatasetError
from service.geometry.earth import Georeference

#: A tenth of a millimetre. More digits would double the size of the file.
_STREET_DECIMALS = 4
#: Origins of global frames for each degree of latitude and of longitude (decision 0195).
_ORIGINS_PER_DEG = 10
#: Largest distance between the middle of a dataset and the origin of a frame that it is moved into, metres. There up leans by 0.9 degrees.
FARTHEST_M = 1e5


@dataclass(frozen=True, slots=True)
class MovedFrame:
    """A map frame that replaces that of a dataset. It can be pickled and compared.

    Attributes:
        of_dataset: georeference of the dataset's own frame.
        moved_to: georeference of the frame that replaces it.
        ground_m: height of the streets in the dataset's own frame, metres. Streets are stored without a height.
    """

    of_dataset: Georeference
    moved_to: Georeference
    ground_m: float = 0.0

    @property
    def georeference(self) -> dict[str, Any]:
        """Return the new georeference as in ``dataset.json``."""
        return asdict(self.moved_to)

    def poses(self, T: Float64[NDArray[np.float64], "n 4 4"]) -> Float64[NDArray[np.float64], "n 4 4"]:
        """Return poses in the new frame (n, 4, 4), metres.

        Args:
            T: poses in the dataset's own frame (n, 4, 4), metres.
        """
        moved: Float64[NDArray[np.float64], "n 4 4"] = self.of_dataset.T_to(self.moved_to) @ T
        return moved

    def streets(self, geojson: dict[str, Any]) -> dict[str, Any]:
        """Return GeoJSON in the new frame. Its positions lie at the height ``ground_m``.

        Args:
            geojson: features in metres of the dataset's own frame.

        Raises:
            DatasetError: a feature has no geometry with coordinates that are numbers.
        """
        T = self.of_dataset.T_to(self.moved_to)

        def moved(xy: Float64[NDArray[np.float64], "n 2"]) -> Float64[NDArray[np.float64], "n 2"]:
            at = np.column_stack([xy, np.full(len(xy), self.ground_m)])
            found: Float64[NDArray[np.float64], "n 2"] = np.round(at @ T[:2, :3].T + T[:2, 3], _STREET_DECIMALS)
            return found

        try:
            shapes = [shapely.geometry.shape(each["geometry"]) for each in geojson["features"]]
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, shapely.errors.ShapelyError) as error:
            raise DatasetError(
                f"streets.geojson: a feature has no geometry that can be moved into another frame: {error!r}; write the file again with "
                "`streetfix streets`",
                field="streets.geojson",
            ) from error
        geometries = [json.loads(shapely.to_geojson(shapely.transform(each, moved))) for each in shapes]
        pairs = zip(geojson["features"], geometries, strict=True)
        return geojson | {"features": [feature | {"geometry": geometry} for feature, geometry in pairs]}


def georeference_of(description: Mapping[str, Any], what: str) -> Georeference:
    """Return a georeference.

    Args:
        description: latitude, longitude and height, as in ``dataset.json`` and in the manifest of a map.
        what: name of its file, for the message.

    Raises:
        DatasetError: it is no place on the Earth.
    """
    try:
        return Georeference(**description)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{what}: georeference: {error}", field="georeference") from error


def require_near(positions: Float64[NDArray[np.float64], "n 3"], what: str) -> None:
    """Refuse a dataset that is too far from the origin of the frame that it was moved into.

    Args:
        positions: of the survey, or of the dataset's own origin, in this frame, metres (n, 3).
        what: name of the dataset, for the message.

    Raises:
        DatasetError: their middle is farther than ``FARTHEST_M`` from the origin.
    """
    away_m = float(np.linalg.norm(positions.mean(axis=0))) if len(positions) else 0.0
    if away_m > FARTHEST_M:
        raise DatasetError(
            f"{what}: the dataset lies {away_m / 1000:,.0f} km from the origin of the map, and a map frame is flat, so up would lean; "
            f"take a map whose origin is at most {FARTHEST_M / 1000:.0f} km away, or check georeference in dataset.json",
            field="georeference",
        )


def global_frame(georeference: Georeference, positions: Float64[NDArray[np.float64], "n 3"]) -> Georeference:
    """Return the frame that all maps of a region share: the one whose origin is nearest to the middle of some positions.

    Origins lie at every tenth of a degree of latitude and of longitude, on the ellipsoid. So the middle is at most 8 km away. Squares of
    equal edges that are counted from such an origin are the same on the ground for every survey.

    Args:
        georeference: of the map frame of the positions.
        positions: metres (n, 3), at least one.
    """
    latitude_deg, longitude_deg, _ = georeference.to_earth(positions.mean(axis=0))
    # A quotient of integers is the double that is nearest to the decimal number, so equal origins are equal to the bit.
    north, east = round(latitude_deg * _ORIGINS_PER_DEG), round(longitude_deg * _ORIGINS_PER_DEG)
    if east == 180 * _ORIGINS_PER_DEG:  # the same meridian as -180
        east = -east
    return Georeference(north / _ORIGINS_PER_DEG, east / _ORIGINS_PER_DEG, 0.0)
