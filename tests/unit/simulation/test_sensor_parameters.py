from dataclasses import fields
from pathlib import Path

import pytest

from model_training.simulation.depth_noise import DEPTHS, DepthModel
from model_training.simulation.exposure import RGBS, RgbModel
from model_training.simulation.lidar import LIDARS, LidarModel
from model_training.simulation.sensor_parameters import (
    DepthParameters,
    LidarParameters,
    RgbParameters,
    StereoParameters,
    SurveyParameters,
)
from model_training.simulation.stereo_pair import STEREOS, StereoModel
from model_training.simulation.survey_drive import SurveyModel
from service.errors import DatasetError

#: What only a preset says: its name, a table of beams, a scan pattern, a matcher.
NOT_NUMBERS = {"name", "beams_deg", "non_repetitive", "matching", "response"}
FORMATS = Path(__file__).parents[3] / "docs" / "formats.md"


@pytest.mark.parametrize(
    ("parameters", "model"),
    [
        (LidarParameters, LidarModel),
        (RgbParameters, RgbModel),
        (DepthParameters, DepthModel),
        (StereoParameters, StereoModel),
        (SurveyParameters, SurveyModel),
    ],
)
def test_every_number_of_a_sensor_can_be_set_and_is_documented(parameters, model):
    numbers = {field.name for field in fields(model)} - NOT_NUMBERS
    assert set(parameters.model_fields) == numbers
    text = FORMATS.read_text()
    assert [name for name in numbers if f"`{name}`" not in text] == []


@pytest.mark.parametrize(
    ("parameters", "presets"),
    [(LidarParameters, LIDARS), (RgbParameters, RGBS), (DepthParameters, DEPTHS), (StereoParameters, STEREOS)],
    ids=["lidar", "rgb", "depth", "stereo"],
)
def test_every_preset_lies_within_the_bounds(parameters, presets):
    for name, preset in presets.items():
        numbers = {field.name: getattr(preset, field.name) for field in fields(preset) if field.name not in NOT_NUMBERS}
        if numbers.get("fixed_gain"):
            del numbers["most_gain"]  # would do nothing, and is refused
        assert parameters.model_validate(numbers).on(name) == preset


def test_numbers_that_are_not_given_stay_the_presets():
    model = DepthParameters(noise_px=0.3).on("stereo")
    assert (model.noise_px, model.offset_px, model.hole_level) == (0.3, 0.05, 1.9)


def test_only_what_is_given_is_written():
    assert DepthParameters(noise_px=0.3, step_px=0).model_dump() == {"noise_px": 0.3, "step_px": 0.0}


@pytest.mark.parametrize(
    ("parameters", "preset", "field"),
    [
        (LidarParameters(bottom_deg=15), "paper_32", "lidar.top_deg"),
        (RgbParameters(most_gain=4), "fixed", "rgb.most_gain"),
        (DepthParameters(min_range_m=4, max_range_m=4), "ideal", "depth.max_range_m"),
        (StereoParameters(min_range_m=4, max_range_m=4), "bm", "stereo.max_range_m"),
    ],
)
def test_parameters_without_result_or_effect_are_refused(parameters, preset, field):
    with pytest.raises(DatasetError, match=field) as refused:
        parameters.on(preset)
    assert refused.value.field == field
