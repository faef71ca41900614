"""Position of a recording's map frame on the Earth, as a user gives it."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from model_training.importing.trajectory import Trajectory
from service.errors import DatasetError
from service.geometry.earth import Georeference
from service.geometry.rigid import rotation_z, transform_from

_FORM = "LAT,LON[,HEIGHT[,HEADING]] in degrees and metres, such as 48.98,8.44"


@dataclass(frozen=True, slots=True)
class MapOrigin:
    """Where the origin of the recorded poses is on the Earth, and where their x axis points.

    Attributes:
        origin: WGS-84 position of the origin.
        heading_deg: direction of the x axis of the recorded poses, counter-clockwise from east, degrees.
    """

    origin: Georeference
    heading_deg: float = 0.0

    def georeference(self) -> dict[str, Any]:
        """Return the georeference as in ``dataset.json``."""
        return asdict(self.origin)

    def turned(self, trajectory: Trajectory) -> Trajectory:
        """Return a trajectory in the frame whose x axis points east and whose y axis points north.

        Args:
            trajectory: T_map_vehicle in the frame of the recorded poses.
        """
        if self.heading_deg == 0.0:
            return trajectory
        T_east_map = transform_from(rotation_z(float(np.deg2rad(self.heading_deg))), np.zeros(3))
        name = f"{trajectory.name}, turned by {self.heading_deg:g} degrees"
        return Trajectory(trajectory.stamps_s, T_east_map @ trajectory.T_map_vehicle, name)


def read_map_origin(text: str) -> MapOrigin:
    """Read ``LAT,LON[,HEIGHT[,HEADING]]``: degrees, degrees, metres above the WGS-84 ellipsoid, degrees counter-clockwise from east.

    Args:
        text: the numbers, with commas between them.

    Raises:
        DatasetError: the text has another form, or a number is out of bounds.
    """
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if not 2 <= len(numbers) <= 4 or not np.isfinite(numbers).all():
        raise DatasetError(f"georeference: {text!r} is not {_FORM}", field="georeference")
    latitude_deg, longitude_deg, height_m, heading_deg = (*numbers, 0.0, 0.0)[:4]
    if abs(heading_deg) > 360:
        raise DatasetError(
            f"georeference: the heading {heading_deg:g} is not between -360 and 360; give degrees counter-clockwise from east",
            field="georeference",
        )
    try:
        return MapOrigin(Georeference(latitude_deg, longitude_deg, height_m), heading_deg)
    except ValueError as error:
        raise DatasetError(f"georeference: {error}; give {_FORM}", field="georeference") from error
