"""Numbers of a simulated sensor that replace those of its preset; what is not given stays the preset's."""

from dataclasses import replace
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, SerializerFunctionWrapHandler, model_serializer

from model_training.simulation.depth_noise import DEPTHS, DepthModel
from model_training.simulation.exposure import RGBS, RgbModel
from model_training.simulation.lidar import LIDARS, LidarModel
from model_training.simulation.stereo_pair import STEREOS, StereoModel
from model_training.simulation.survey_drive import SurveyModel
from service.errors import DatasetError


class _Parameters(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_serializer(mode="wrap")
    def given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Only what replaces a preset's number: a plan that replaces nothing is written as it was before this existed."""
        return {name: value for name, value in handler(self).items() if value is not None}


class LidarParameters(_Parameters):
    """Of the survey's LiDAR; metres, degrees above the horizon, shares, as in ``LidarModel``."""

    channels: int | None = Field(None, ge=16, le=128)
    columns: int | None = Field(None, ge=64, le=4096)
    top_deg: float | None = Field(None, ge=-90, le=90)
    bottom_deg: float | None = Field(None, ge=-90, le=90)
    range_noise_m: float | None = Field(None, ge=0, le=1)
    dropout: float | None = Field(None, ge=0, le=0.99)
    max_range_m: float | None = Field(None, ge=1, le=500)

    def on(self, preset: str) -> LidarModel:
        """The preset with these numbers.

        Raises:
            DatasetError: the vertical field is empty.
        """
        own = LIDARS[preset]
        model = replace(own, **self.model_dump())
        if (model.channels, model.top_deg, model.bottom_deg) != (own.channels, own.top_deg, own.bottom_deg):
            model = replace(
                model, beams_deg=()
            )  # of another vertical field the preset's table says nothing: evenly spaced
        if model.top_deg <= model.bottom_deg:
            raise DatasetError(
                f"lidar.top_deg: {model.top_deg:g} is not above lidar.bottom_deg, {model.bottom_deg:g}; change one of them",
                field="lidar.top_deg",
            )
        return model


class RgbParameters(_Parameters):
    """Of the RGB camera; stops, gains and display values of 0 to 255, as in ``RgbModel``."""

    exposure_ev: float | None = Field(None, ge=-6, le=6)
    most_gain: float | None = Field(None, ge=0.01, le=1000)
    fixed_gain: float | None = Field(None, ge=0, le=1000)
    noise: float | None = Field(None, ge=0, le=128)
    noise_per_gain: float | None = Field(None, ge=0, le=128)

    def on(self, preset: str) -> RgbModel:
        """The preset with these numbers.

        Raises:
            DatasetError: the limit of metering is set for an exposure that is fixed.
        """
        model = replace(RGBS[preset], **self.model_dump())
        if model.fixed_gain > 0 and self.most_gain is not None:
            raise DatasetError(
                f"rgb.most_gain: {self.most_gain:g} would do nothing, since rgb.fixed_gain is {model.fixed_gain:g}; leave one out",
                field="rgb.most_gain",
            )
        return model


class DepthParameters(_Parameters):
    """Of the depth camera; metres, pixels of a 640 wide picture, shares, as in ``DepthModel``."""

    focal_baseline_px_m: float | None = Field(None, ge=1, le=10_000)
    noise_px: float | None = Field(None, ge=0, le=50)
    correlated: float | None = Field(None, ge=0, le=1)
    step_px: float | None = Field(None, ge=0, le=10)
    offset_px: float | None = Field(None, ge=0, le=10)
    scale_error: float | None = Field(None, ge=0, le=0.5)
    bleeding: float | None = Field(None, ge=0, le=0.99)
    hole_level: float | None = Field(None, ge=0, le=99)
    invented_frames: float | None = Field(None, ge=0, le=1)
    min_range_m: float | None = Field(None, ge=0.05, le=10)
    max_range_m: float | None = Field(None, ge=1, le=65)  # 16 bits of millimetres end at 65.535 m

    def on(self, preset: str) -> DepthModel:
        """The preset with these numbers.

        Raises:
            DatasetError: no range is left.
        """
        model = replace(DEPTHS[preset], **self.model_dump())
        _refuse_no_range("depth", model.min_range_m, model.max_range_m)
        return model


class SurveyParameters(_Parameters):
    """Of the survey's drive; metres, degrees, metres a second, shares, as in ``SurveyModel``."""

    position_m: float | None = Field(None, ge=0, le=5)
    angle_deg: float | None = Field(None, ge=0, le=5)
    speed_m_s: float | None = Field(None, ge=0, le=40)
    deskewed: bool | None = None
    followed: float | None = Field(None, ge=0, le=1)

    def model(self) -> SurveyModel:
        """The survey with these numbers.

        Raises:
            DatasetError: nothing moves that could be taken out.
        """
        model = SurveyModel(**self.model_dump())
        if self.deskewed is not None and model.speed_m_s == 0:
            raise DatasetError(
                "survey.deskewed: it would do nothing, since survey.speed_m_s is 0; set a speed, or leave it out",
                field="survey.deskewed",
            )
        return model


class StereoParameters(_Parameters):
    """Of a stereo rig whose pairs are matched; metres and pixels, as in ``StereoModel``."""

    focal_baseline_px_m: float | None = Field(None, ge=1, le=10_000)
    offset_px: float | None = Field(None, ge=0, le=10)
    vertical_px: float | None = Field(None, ge=0, le=10)
    roll_px: float | None = Field(None, ge=0, le=10)
    min_range_m: float | None = Field(None, ge=0.05, le=10)
    max_range_m: float | None = Field(None, ge=1, le=65)  # 16 bits of millimetres end at 65.535 m

    def on(self, preset: str) -> StereoModel:
        """The preset with these numbers.

        Raises:
            DatasetError: no range is left.
        """
        model = replace(STEREOS[preset], **self.model_dump())
        _refuse_no_range("stereo", model.min_range_m, model.max_range_m)
        return model


def _refuse_no_range(sensor: str, min_range_m: float, max_range_m: float) -> None:
    if max_range_m <= min_range_m:
        raise DatasetError(
            f"{sensor}.max_range_m: {max_range_m:g} is not beyond {sensor}.min_range_m, {min_range_m:g}; change one of them",
            field=f"{sensor}.max_range_m",
        )
