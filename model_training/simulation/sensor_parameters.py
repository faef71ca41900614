"""Numbers that replace those of a sensor preset. Numbers that are not set keep the preset's value."""

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
    """Base of all parameters: each field is None or replaces the preset's number of the same name."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_serializer(mode="wrap")
    def given(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return only the numbers that are set. A plan without them keeps the text that it had before these parameters existed.

        Args:
            handler: default serialiser of pydantic.
        """
        return {name: value for name, value in handler(self).items() if value is not None}


class LidarParameters(_Parameters):
    """Numbers of the survey's LiDAR; for meanings and units see ``LidarModel``."""

    channels: int | None = Field(None, ge=16, le=128)
    columns: int | None = Field(None, ge=64, le=4096)
    top_deg: float | None = Field(None, ge=-90, le=90)
    bottom_deg: float | None = Field(None, ge=-90, le=90)
    range_noise_m: float | None = Field(None, ge=0, le=1)
    dropout: float | None = Field(None, ge=0, le=0.99)
    max_range_m: float | None = Field(None, ge=1, le=500)

    def on(self, preset: str) -> LidarModel:
        """Return the preset with these numbers.

        Args:
            preset: one of ``LIDARS``.

        Raises:
            DatasetError: the top of the vertical field of view is not above its bottom.
        """
        own = LIDARS[preset]
        model = replace(own, **self.model_dump())
        if (model.channels, model.top_deg, model.bottom_deg) != (own.channels, own.top_deg, own.bottom_deg):
            # The preset's beam table does not fit another vertical field, so the beams are evenly spaced.
            model = replace(model, beams_deg=())
        if model.top_deg <= model.bottom_deg:
            raise DatasetError(
                f"lidar.top_deg: {model.top_deg:g} is not above lidar.bottom_deg, {model.bottom_deg:g}; change one of them",
                field="lidar.top_deg",
            )
        return model


class RgbParameters(_Parameters):
    """Numbers of the RGB camera; for meanings and units see ``RgbModel``."""

    exposure_ev: float | None = Field(None, ge=-6, le=6)
    most_gain: float | None = Field(None, ge=0.01, le=1000)
    fixed_gain: float | None = Field(None, ge=0, le=1000)
    noise: float | None = Field(None, ge=0, le=128)
    noise_per_gain: float | None = Field(None, ge=0, le=128)

    def on(self, preset: str) -> RgbModel:
        """Return the preset with these numbers.

        Args:
            preset: one of ``RGBS``.

        Raises:
            DatasetError: the limit of the metered gain is set although the gain is fixed.
        """
        model = replace(RGBS[preset], **self.model_dump())
        if model.fixed_gain > 0 and self.most_gain is not None:
            raise DatasetError(
                f"rgb.most_gain: {self.most_gain:g} has no effect with rgb.fixed_gain {model.fixed_gain:g}; omit one "
                "of them",
                field="rgb.most_gain",
            )
        return model


class DepthParameters(_Parameters):
    """Numbers of a depth camera with modelled errors; for meanings and units see ``DepthModel``."""

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
        """Return the preset with these numbers.

        Args:
            preset: one of ``DEPTHS``.

        Raises:
            DatasetError: the largest depth is not greater than the smallest.
        """
        model = replace(DEPTHS[preset], **self.model_dump())
        _refuse_no_range("depth", model.min_range_m, model.max_range_m)
        return model


class SurveyParameters(_Parameters):
    """Numbers of the survey's vehicle; for meanings and units see ``SurveyModel``."""

    position_m: float | None = Field(None, ge=0, le=5)
    angle_deg: float | None = Field(None, ge=0, le=5)
    speed_m_s: float | None = Field(None, ge=0, le=40)
    deskewed: bool | None = None
    followed: float | None = Field(None, ge=0, le=1)

    def model(self) -> SurveyModel:
        """Return the survey model with these numbers.

        Raises:
            DatasetError: ``deskewed`` is set although the vehicle stands still during a scan.
        """
        model = SurveyModel(**self.model_dump())
        if self.deskewed is not None and model.speed_m_s == 0:
            raise DatasetError(
                "survey.deskewed: this option has no effect with survey.speed_m_s 0; set a speed, or omit it",
                field="survey.deskewed",
            )
        return model


class StereoParameters(_Parameters):
    """Numbers of a stereo rig with matched pairs; for meanings and units see ``StereoModel``."""

    focal_baseline_px_m: float | None = Field(None, ge=1, le=10_000)
    offset_px: float | None = Field(None, ge=0, le=10)
    vertical_px: float | None = Field(None, ge=0, le=10)
    roll_px: float | None = Field(None, ge=0, le=10)
    min_range_m: float | None = Field(None, ge=0.05, le=10)
    max_range_m: float | None = Field(None, ge=1, le=65)  # 16 bits of millimetres end at 65.535 m

    def on(self, preset: str) -> StereoModel:
        """Return the preset with these numbers.

        Args:
            preset: one of ``STEREOS``.

        Raises:
            DatasetError: the largest depth is not greater than the smallest.
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
