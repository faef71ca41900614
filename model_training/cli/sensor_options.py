"""Option ``--set SENSOR.NUMBER=VALUE``: sensor parameters that replace those of the presets."""

from pydantic import BaseModel, ValidationError

from model_training.simulation.sensor_parameters import (
    DepthParameters,
    LidarParameters,
    RgbParameters,
    StereoParameters,
    SurveyParameters,
)
from service.errors import DatasetError

_MODELS: dict[str, type[BaseModel]] = {
    "lidar": LidarParameters,
    "rgb": RgbParameters,
    "depth": DepthParameters,
    "stereo": StereoParameters,
    "survey": SurveyParameters,
}


def sensor_parameters(
    settings: list[str],
) -> tuple[LidarParameters, RgbParameters, DepthParameters, StereoParameters, SurveyParameters]:
    """Parse the parameters of the LiDAR, the RGB camera, the depth camera, the stereo rig and the survey.

    Args:
        settings: texts such as ``lidar.channels=64``.

    Raises:
        DatasetError: a text has another form, a name is unknown or occurs twice, or a value is out of bounds.
    """
    given: dict[str, dict[str, str]] = {sensor: {} for sensor in _MODELS}
    for text in settings:
        name, equals, value = (part.strip() for part in text.partition("="))
        sensor, _, field = name.partition(".")
        if not equals or not field:
            raise DatasetError(f"set: {text!r} is not SENSOR.NUMBER=VALUE, such as lidar.channels=64", field="set")
        if sensor not in _MODELS:
            raise DatasetError(f"{name}: unknown sensor {sensor!r}; choose one of: {', '.join(_MODELS)}", field=name)
        known = _MODELS[sensor].model_fields
        if field not in known:
            raise DatasetError(f"{name}: {sensor} has no parameter {field!r}; it has: {', '.join(known)}", field=name)
        if field in given[sensor]:
            raise DatasetError(f"{name}: set twice; set it once", field=name)
        given[sensor][field] = value
    try:
        return (
            LidarParameters.model_validate(given["lidar"]),
            RgbParameters.model_validate(given["rgb"]),
            DepthParameters.model_validate(given["depth"]),
            StereoParameters.model_validate(given["stereo"]),
            SurveyParameters.model_validate(given["survey"]),
        )
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        sensor = next(name for name, model in _MODELS.items() if model.__name__ == error.title)
        name = f"{sensor}.{first['loc'][0]}"
        raise DatasetError(f"{name}: {first['msg']} (given: {first['input']!r})", field=name) from error
