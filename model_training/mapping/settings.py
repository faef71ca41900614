"""Settings of a map build."""

import math
from dataclasses import dataclass
from pathlib import Path

from model_training.datasets.dataset import MOST_SURVEY_STD_DEG, MOST_SURVEY_STD_M, SurveyAccuracy
from model_training.stock import CALIBRATION
from service.errors import DatasetError
from service.imaging.pca import USUAL_LIDAR_HEIGHT_M
from service.maps.manifest import Manifest


@dataclass(frozen=True, slots=True)
class BuildSettings:
    """Settings of a map build. The bundle records them.

    Attributes:
        name: name of the map in requests.
        spacing_m: travelled distance between the scans that become places, metres.
        between_m: largest distance between places, metres. Farther scans get places between them; 0 puts none there.
        headings: number of map views per place.
        voxel_m: edge of a voxel of the cloud, metres.
        expected_lidar_height_m: expected height of the LiDAR above the ground, metres. The search for the ground starts there.
        remove_weather: remove the returns of rain and snow from the scans.
        passes_vote: remove voxels that more passes of the survey see through than hit.
        traffic_vote: remove voxels that at least as many scans see through as hit.
        align_survey: align the scans of the survey before the build.
        survey_std_m: standard deviation of the survey's positions per axis, metres; None takes what the dataset states.
        survey_std_deg: standard deviation of the survey's angles, degrees; None takes what the dataset states.
        licence: text of the licence. May be empty.
        calibration: calibration file; None builds a map without calibration.

    Raises:
        DatasetError: a number is too small or not finite. The message names the field.
    """

    name: str
    spacing_m: float = 1.0
    between_m: float = 3.0
    headings: int = 24
    voxel_m: float = 0.3
    expected_lidar_height_m: float = USUAL_LIDAR_HEIGHT_M
    remove_weather: bool = False
    passes_vote: bool = False
    traffic_vote: bool = True
    align_survey: bool = True
    survey_std_m: float | None = None
    survey_std_deg: float | None = None
    licence: str = ""
    calibration: Path | None = CALIBRATION

    def __post_init__(self) -> None:
        """Refuse values that would give an empty fan or a cloud without voxels."""
        lowest = {"spacing_m": 0.0, "between_m": 0.0, "headings": 1, "voxel_m": 0.01, "expected_lidar_height_m": 0.1}
        for field, least in lowest.items():
            value = getattr(self, field)
            if not least <= value < math.inf:
                raise DatasetError(f"{field}: {value:g} is not valid; give {least:g} or more", field=field)
        for field, most in (("survey_std_m", MOST_SURVEY_STD_M), ("survey_std_deg", MOST_SURVEY_STD_DEG)):
            std = getattr(self, field)
            if std is not None and not 0 <= std <= most:
                raise DatasetError(f"{field}: {std:g} is not valid; give 0 to {most:g}", field=field)

    def survey_accuracy(self, stated: SurveyAccuracy | None) -> dict[str, float]:
        """Return the accuracy of the survey's poses as parameters of the manifest; nothing that is unknown.

        Args:
            stated: what the dataset states; None if nothing.
        """
        position_m, angle_deg = self.survey_std_m, self.survey_std_deg
        if stated is not None:
            position_m = stated.position_std_m if position_m is None else position_m
            angle_deg = stated.angle_std_deg if angle_deg is None else angle_deg
        known = {"survey_position_std_m": position_m, "survey_angle_std_deg": angle_deg}
        return {name: value for name, value in known.items() if value is not None}

    @classmethod
    def of_map(cls, manifest: Manifest, *, passes_vote: bool = False) -> "BuildSettings":
        """Return the settings that a map was built with, without a calibration.

        Args:
            manifest: manifest of the map.
            passes_vote: whether the next build uses the visibility vote of passes. It is not taken from the manifest.
        """
        parameters = manifest.parameters
        return cls(
            name=manifest.name,
            spacing_m=manifest.spacing_m,
            headings=manifest.headings,
            voxel_m=parameters["voxel_m"],
            between_m=parameters.get("between_m", 0.0),
            expected_lidar_height_m=parameters.get("expected_lidar_height_m", parameters["lidar_height_m"]),
            remove_weather=bool(parameters.get("weather_removed", 0.0)),
            passes_vote=passes_vote,
            licence=manifest.licence,
            align_survey=bool(parameters.get("survey_aligned", 0.0)),
            survey_std_m=parameters.get("survey_position_std_m"),
            survey_std_deg=parameters.get("survey_angle_std_deg"),
            traffic_vote=bool(parameters.get("traffic_vote", 0.0)),
            calibration=None,
        )
