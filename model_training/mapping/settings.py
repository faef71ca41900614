"""How a map is built."""

import math
from dataclasses import dataclass
from pathlib import Path

from model_training.stock import CALIBRATION
from service.errors import DatasetError
from service.maps.manifest import Manifest


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """How a map is built; all of it is in the manifest.

    Raises:
        DatasetError: a number makes no sense, naming the field.
    """

    name: str
    spacing_m: float = 1.0
    headings: int = 24
    voxel_m: float = 0.3
    expected_lidar_height_m: float = 1.8
    remove_weather: bool = False
    passes_vote: bool = False
    traffic_vote: bool = True
    align_survey: bool = True
    licence: str = ""
    calibration: Path | None = CALIBRATION

    def __post_init__(self) -> None:
        """Refuse what would end in an empty fan or a cloud without voxels."""
        lowest = {"spacing_m": 0.0, "headings": 1, "voxel_m": 0.01, "expected_lidar_height_m": 0.1}
        for field, least in lowest.items():
            value = getattr(self, field)
            if not least <= value < math.inf:
                raise DatasetError(f"{field}: {value:g} is not {least:g} or more; give a number that is", field=field)

    @classmethod
    def of_map(cls, manifest: Manifest, *, passes_vote: bool = False) -> "BuildSettings":
        """What a map was built with, for more of the same."""
        parameters = manifest.parameters
        return cls(
            name=manifest.name, spacing_m=manifest.spacing_m, headings=manifest.headings, voxel_m=parameters["voxel_m"],
            expected_lidar_height_m=parameters.get("expected_lidar_height_m", parameters["lidar_height_m"]),
            remove_weather=bool(parameters.get("weather_removed", 0.0)), passes_vote=passes_vote, licence=manifest.licence,
            align_survey=bool(parameters.get("survey_aligned", 0.0)), traffic_vote=bool(parameters.get("traffic_vote", 0.0)),
            calibration=None,
        )  # fmt: skip
