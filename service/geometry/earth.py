"""Between WGS-84 and a map frame that is east, north, up at its origin.

Exact through earth-centred coordinates (Bowring's start, then Newton's steps on the way back; NIMA TR8350.2 for the ellipsoid).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

_A, _F = 6378137.0, 1 / 298.257223563
_E2 = _F * (2 - _F)


@dataclass(frozen=True, slots=True)
class Georeference:
    """Where on the Earth a map's origin lies; x is east there, y north, z up. Degrees, metres above the ellipsoid.

    Raises:
        ValueError: a number is no place on the Earth, naming it.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no place."""
        limits = {"latitude_deg": 90.0, "longitude_deg": 180.0, "height_m": 1e5}
        for name, most in limits.items():
            value = getattr(self, name)
            if not abs(value) <= most:
                raise ValueError(f"{name}: {value!r} is not between -{most:g} and {most:g}")

    def to_map(self, latitude_deg: float, longitude_deg: float, height_m: float) -> Float64[NDArray[np.float64], "3"]:
        """Map coordinates (m) of a place on the Earth."""
        away = _earth_centred(latitude_deg, longitude_deg, height_m) - self._origin()
        local: Float64[NDArray[np.float64], 3] = self._east_north_up() @ away
        return local

    def to_earth(self, position_m: Float64[NDArray[np.float64], "3"]) -> tuple[float, float, float]:
        """Latitude and longitude (degrees) and height (m) of map coordinates."""
        x, y, z = (self._origin() + self._east_north_up().T @ position_m).tolist()
        flat = float(np.hypot(x, y))
        latitude = float(np.arctan2(z, flat * (1 - _E2)))
        height = 0.0
        for _ in range(10):
            n = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
            # Near the poles the distance from the axis says nothing about the height, near the equator z does not.
            cosine, sine = np.cos(latitude), np.sin(latitude)
            height = float(flat / cosine - n if cosine > abs(sine) else z / sine - n * (1 - _E2))
            latitude = float(np.arctan2(z, flat * (1 - _E2 * n / (n + height))))
        return float(np.rad2deg(latitude)), float(np.rad2deg(np.arctan2(y, x))), height

    def R_enu_map(self, position_m: Float64[NDArray[np.float64], "3"]) -> Float64[NDArray[np.float64], "3 3"]:
        """From map axes to east, north and up at a position of the map; they part by a degree in a hundred kilometres."""
        latitude_deg, longitude_deg, _ = self.to_earth(position_m)
        turned: Float64[NDArray[np.float64], "3 3"] = (
            _east_north_up(latitude_deg, longitude_deg) @ self._east_north_up().T
        )
        return turned

    def _origin(self) -> Float64[NDArray[np.float64], "3"]:
        return _earth_centred(self.latitude_deg, self.longitude_deg, self.height_m)

    def _east_north_up(self) -> Float64[NDArray[np.float64], "3 3"]:
        return _east_north_up(self.latitude_deg, self.longitude_deg)


def _east_north_up(latitude_deg: float, longitude_deg: float) -> Float64[NDArray[np.float64], "3 3"]:
    """Rows: east, north and up at a place, earth-centred."""
    b, l = np.deg2rad([latitude_deg, longitude_deg])  # noqa: E741  # geodesy's own letters
    return np.array([
        [-np.sin(l), np.cos(l), 0.0],
        [-np.sin(b) * np.cos(l), -np.sin(b) * np.sin(l), np.cos(b)],
        [np.cos(b) * np.cos(l), np.cos(b) * np.sin(l), np.sin(b)],
    ])  # fmt: skip


def _earth_centred(latitude_deg: float, longitude_deg: float, height_m: float) -> Float64[NDArray[np.float64], "3"]:
    b, l = np.deg2rad([latitude_deg, longitude_deg])  # noqa: E741
    n = _A / np.sqrt(1 - _E2 * np.sin(b) ** 2)
    flat = (n + height_m) * np.cos(b)
    return np.array([flat * np.cos(l), flat * np.sin(l), (n * (1 - _E2) + height_m) * np.sin(b)])
