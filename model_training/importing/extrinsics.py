"""Read mountings and intrinsics that a recording does not contain, from a JSON file."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from service.errors import DatasetError
from service.geometry.camera import DistortionModel, PinholeCamera
from service.geometry.distortion import COEFFICIENTS, coefficient_problem
from service.geometry.rigid import Transform

_KEYS = ("T_vehicle_lidar", "T_vehicle_camera")
_EXAMPLE = " or ".join(_KEYS) + ", each as 4 rows of 4 numbers"


@dataclass(frozen=True, slots=True)
class Extrinsics:
    """Mountings of the sensors on the vehicle. None means that the recording contains it.

    Attributes:
        T_vehicle_lidar: of the LiDAR (4, 4).
        T_vehicle_camera: of the camera's optical frame (4, 4).
    """

    T_vehicle_lidar: Transform | None = None
    T_vehicle_camera: Transform | None = None


def read_extrinsics(path: Path) -> Extrinsics:
    """Read ``{"T_vehicle_lidar": 4x4, "T_vehicle_camera": 4x4}``; the camera's frame is its optical frame.

    Args:
        path: of the JSON file.

    Raises:
        DatasetError: the file is missing or no JSON, or a matrix in it is no rigid transform.
    """
    try:
        loaded = json.loads(path.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(
            f"{path}: cannot be read as JSON: {error}; give a JSON file with {_EXAMPLE}", field="extrinsics"
        ) from error
    if not isinstance(loaded, dict) or not loaded.keys() <= set(_KEYS):
        found = ", ".join(map(str, loaded)) if isinstance(loaded, dict) else type(loaded).__name__
        raise DatasetError(f"{path}: found {found[:200]}; write an object with {_EXAMPLE}", field="extrinsics")
    return Extrinsics(**{key: _rigid(path, key, value) for key, value in loaded.items()})


def read_camera(path: Path) -> PinholeCamera:
    """Read intrinsics and lens as in the ``camera`` of a request, alone or in the request.

    Args:
        path: of the JSON file with ``width``, ``height``, ``fx``, ``fy``, ``cx``, ``cy`` (pixels), and for a lens ``distortion`` and
            ``distortion_model``.

    Raises:
        DatasetError: the file is missing, or a value in it is missing or invalid.
    """
    try:
        loaded = json.loads(path.read_text())
        values = loaded.get("camera", loaded)
        numbers = {key: float(values[key]) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        distortion = tuple(float(x) for x in values.get("distortion", ()))
        model: DistortionModel = values.get("distortion_model", "brown_conrady")
    except (
        OSError,
        UnicodeDecodeError,
        json.JSONDecodeError,
        AttributeError,
        KeyError,
        TypeError,
        ValueError,
    ) as error:
        raise DatasetError(
            f"{path}: not a valid camera: {type(error).__name__}: {error}; write JSON with width, height, fx, fy, cx and cy "
            "in pixels",
            field="camera",
        ) from error
    if not all(np.isfinite(x) and x > 0 for key, x in numbers.items() if key not in ("cx", "cy")):
        bad = ", ".join(f"{key} {x:g}" for key, x in numbers.items() if key not in ("cx", "cy"))
        raise DatasetError(
            f"{path}: width, height, fx and fy must be more than 0; the file has {bad}. Give the values of the calibration, "
            "in pixels",
            field="camera",
        )
    if model not in COEFFICIENTS:
        raise DatasetError(
            f"{path}: distortion_model: {model!r} is not valid; choose one of: {', '.join(COEFFICIENTS)}",
            field="camera",
        )
    if problem := coefficient_problem(model, distortion):
        raise DatasetError(f"{path}: distortion: {problem}", field="camera")
    return PinholeCamera(
        int(numbers["width"]),
        int(numbers["height"]),
        numbers["fx"],
        numbers["fy"],
        numbers["cx"],
        numbers["cy"],
        distortion,
        model,
    )


def _rigid(path: Path, key: str, value: object) -> Transform:
    try:
        T = np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise DatasetError(f"{path}: {key} is not a matrix of numbers; write 4 rows of 4 numbers", field=key) from error
    if T.shape != (4, 4) or not np.isfinite(T).all() or not np.allclose(T[3], [0, 0, 0, 1]):
        raise DatasetError(
            f"{path}: {key} has shape {T.shape} or a wrong last row; write 4 rows of 4 finite numbers, the last row 0 0 0 1",
            field=key,
        )
    R = T[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0:
        raise DatasetError(
            f"{path}: {key} has no valid rotation: its first three columns must be orthonormal and right-handed (determinant 1). "
            "Write more digits, or correct the axes",
            field=key,
        )
    return T
