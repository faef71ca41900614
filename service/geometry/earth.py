"""Conversion between WGS-84 and a map frame whose axes are east, north and up at its origin.

The conversion goes through earth-centred coordinates and is exact. The way back to latitude and height iterates 10 times.
The iteration starts at the latitude that is exact for height 0. Ellipsoid: NIMA TR8350.2.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

#: Semi-major axis (m) and flattening of the WGS-84 ellipsoid.
_A, _F = 6378137.0, 1 / 298.257223563
#: Squared first eccentricity of the ellipsoid.
_E2 = _F * (2 - _F)


@dataclass(frozen=True, slots=True)
class Georeference:
    """WGS-84 position of a map's origin. At the origin x points east, y north and z up.

    Attributes:
        latitude_deg: geodetic latitude, degrees, -90 to 90.
        longitude_deg: longitude, degrees, -180 to 180.
        height_m: height above the ellipsoid, metres, at most 100 km up or down.

    Raises:
        ValueError: a number is out of bounds or NaN. The message names the attribute.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0

    def __post_init__(self) -> None:
        """Check that all numbers are within bounds.

        Raises:
            ValueError: a number is out of bounds or NaN.
        """
        limits = {"latitude_deg": 90.0, "longitude_deg": 180.0, "height_m": 1e5}
        for name, most in limits.items():
            value = getattr(self, name)
            if not abs(value) <= most:
                raise ValueError(f"{name}: {value!r} is not between -{most:g} and {most:g}")

    def to_map(self, latitude_deg: float, longitude_deg: float, height_m: float) -> Float64[NDArray[np.float64], "3"]:
        """Return the map coordinates (m) of a WGS-84 position.

        Args:
            latitude_deg: geodetic latitude, degrees.
            longitude_deg: longitude, degrees.
            height_m: height above the ellipsoid, metres.
        """
        away = _earth_centred(latitude_deg, longitude_deg, height_m) - self._origin()
        local: Float64[NDArray[np.float64], 3] = self._east_north_up() @ away
        return local

    def to_earth(self, position_m: Float64[NDArray[np.float64], "3"]) -> tuple[float, float, float]:
        """Return latitude (degrees), longitude (degrees) and height above the ellipsoid (m) of a map position.

        Args:
            position_m: x, y, z in the map frame, metres.
        """
        latitude_deg, longitude_deg, height_m = _geodetic(
            self._origin() + self._east_north_up().T @ position_m
        ).tolist()
        return latitude_deg, longitude_deg, height_m

    def to_earth_all(self, positions_m: Float64[NDArray[np.float64], "*n 3"]) -> Float64[NDArray[np.float64], "*n 3"]:
        """Return latitude (degrees), longitude (degrees) and height above the ellipsoid (m) of many map positions.

        Args:
            positions_m: x, y, z of each in the map frame, metres.
        """
        return _geodetic(self._origin() + positions_m @ self._east_north_up())

    def R_enu_map(self, position_m: Float64[NDArray[np.float64], "3"]) -> Float64[NDArray[np.float64], "3 3"]:
        """Return the rotation from map axes to east, north and up at a map position.

        The two sets of axes differ by about one degree per 100 km from the origin.

        Args:
            position_m: x, y, z in the map frame, metres.
        """
        latitude_deg, longitude_deg, _ = self.to_earth(position_m)
        turned: Float64[NDArray[np.float64], "3 3"] = (
            _east_north_up(latitude_deg, longitude_deg) @ self._east_north_up().T
        )
        return turned

    def T_to(self, other: "Georeference") -> Float64[NDArray[np.float64], "4 4"]:
        """Return T_other_map: the pose of this map frame in the frame of another georeference, metres. It is exact.

        Args:
            other: georeference of the other frame.
        """
        to_other = other._east_north_up()
        T: Float64[NDArray[np.float64], "4 4"] = np.eye(4)
        T[:3, :3] = to_other @ self._east_north_up().T
        T[:3, 3] = to_other @ (self._origin() - other._origin())
        return T

    def _origin(self) -> Float64[NDArray[np.float64], "3"]:
        return _earth_centred(self.latitude_deg, self.longitude_deg, self.height_m)

    def _east_north_up(self) -> Float64[NDArray[np.float64], "3 3"]:
        return _east_north_up(self.latitude_deg, self.longitude_deg)


def _east_north_up(latitude_deg: float, longitude_deg: float) -> Float64[NDArray[np.float64], "3 3"]:
    """Return the unit vectors east, north and up of a position as rows, in earth-centred axes."""
    b, l = np.deg2rad([latitude_deg, longitude_deg])  # noqa: E741  # geodesy's own letters
    return np.array(
        [
            [-np.sin(l), np.cos(l), 0.0],
            [-np.sin(b) * np.cos(l), -np.sin(b) * np.sin(l), np.cos(b)],
            [np.cos(b) * np.cos(l), np.cos(b) * np.sin(l), np.sin(b)],
        ]
    )


def _earth_centred(latitude_deg: float, longitude_deg: float, height_m: float) -> Float64[NDArray[np.float64], "3"]:
    b, l = np.deg2rad([latitude_deg, longitude_deg])  # noqa: E741
    n = _A / np.sqrt(1 - _E2 * np.sin(b) ** 2)
    flat = (n + height_m) * np.cos(b)
    return np.array([flat * np.cos(l), flat * np.sin(l), (n * (1 - _E2) + height_m) * np.sin(b)])


def _geodetic(centred_m: Float64[NDArray[np.float64], "*n 3"]) -> Float64[NDArray[np.float64], "*n 3"]:
    """Return latitude (degrees), longitude (degrees) and height (m) of earth-centred positions."""
    x, y, z = centred_m[..., 0], centred_m[..., 1], centred_m[..., 2]
    flat = np.hypot(x, y)
    latitude, height = np.arctan2(z, flat * (1 - _E2)), np.zeros_like(flat)
    for _ in range(10):
        n = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
        # The division needs the larger of cosine and sine. The cosine is 0 at a pole, the sine is 0 at the equator.
        cosine, sine = np.cos(latitude), np.sin(latitude)
        by_cosine = cosine > abs(sine)
        quotient = np.where(by_cosine, flat, z) / np.where(by_cosine, cosine, sine)
        height = quotient - np.where(by_cosine, n, n * (1 - _E2))
        latitude = np.arctan2(z, flat * (1 - _E2 * n / (n + height)))
    return np.stack([np.rad2deg(latitude), np.rad2deg(np.arctan2(y, x)), height], axis=-1)
