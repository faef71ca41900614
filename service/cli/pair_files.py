"""Read the JSON files of ``streetfix localize --sequence`` and ``--batch``. They name several image pairs."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from service.errors import RequestError

#: Fields of a frame that all frames of a sequence may share. A batch shares all fields.
_SHARED_BY_FRAMES = ("camera", "depth")
_EXAMPLE = '{"rgb_file": "0.jpg", "depth_file": "0.png", "camera": {"width": 640, ...}}'


@dataclass(frozen=True, slots=True)
class ImagePair:
    """One image pair of a file.

    Attributes:
        name: position in the file, such as ``frames.1``, for errors.
        rgb: file of the colour image.
        depth: file of the depth image.
        request: the other fields: those of a frame of the contract's sequence, or of its single request.
    """

    name: str
    rgb: Path
    depth: Path
    request: dict[str, Any]


@dataclass(frozen=True, slots=True)
class SequenceFile:
    """A sequence of image pairs.

    Attributes:
        pairs: the frames. The first one is the reference.
        about: fields of the contract's sequence beside ``frames``, such as ``map`` and ``prior``.
    """

    pairs: list[ImagePair]
    about: dict[str, Any]


def read_sequence(path: Path) -> SequenceFile:
    """Read a sequence.

    Frames without ``camera`` or ``depth`` take those beside ``frames``. ``T_odometry_camera`` of all frames (the camera's pose in
    the frame of the odometry, metres) becomes ``T_reference_camera``.

    Args:
        path: a JSON object with ``frames``. Relative paths of images start from its folder.

    Raises:
        RequestError: the file cannot be read, or a frame is incomplete. The message names the file and the field.
    """
    document = _object_of(path, "sequence")
    shared = {name: document.pop(name) for name in _SHARED_BY_FRAMES if name in document}
    pairs = list(_pairs(path, document.pop("frames", None), "frames", shared))
    _use_odometry(path, pairs)
    return SequenceFile(pairs, document)


def read_batch(path: Path) -> list[ImagePair]:
    """Read a batch of independent pairs. Fields beside ``requests`` hold for all requests that do not have them.

    Args:
        path: a JSON object with ``requests``. Relative paths of images start from its folder.

    Raises:
        RequestError: the file cannot be read, or a request is incomplete. The message names the file and the field.
    """
    document = _object_of(path, "batch")
    entries = document.pop("requests", None)
    return list(_pairs(path, entries, "requests", document))


def _object_of(path: Path, option: str) -> dict[str, Any]:
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise RequestError(f"{path}: cannot be read ({error.strerror}); check --{option}", field=option) from error
    except (ValueError, RecursionError) as error:
        raise RequestError(f"{path}: not valid JSON ({error})", field=option) from error
    if not isinstance(document, dict):
        raise RequestError(f"{path}: expected a JSON object; see streetfix localize --help", field=option)
    return document


def _pairs(path: Path, entries: Any, name: str, shared: dict[str, Any]) -> Iterator[ImagePair]:
    if not isinstance(entries, list) or not entries:
        raise RequestError(f"{path}: {name}: expected a list of at least one object like {_EXAMPLE}", field=name)
    for number, entry in enumerate(entries):
        field = f"{name}.{number}"
        if not isinstance(entry, dict):
            raise RequestError(f"{path}: {field}: expected an object like {_EXAMPLE}", field=field)
        request = shared | entry
        rgb, depth = (
            _image_file(path, request.pop(file, None), f"{field}.{file}") for file in ("rgb_file", "depth_file")
        )
        if "camera" not in request:
            raise RequestError(
                f"{path}: {field}.camera is missing; give it here, or beside {name} for all", field=f"{field}.camera"
            )
        yield ImagePair(field, rgb, depth, request)


def _image_file(path: Path, value: Any, field: str) -> Path:
    if not isinstance(value, str) or not value:
        raise RequestError(f"{path}: {field} is missing; give the path of the image", field=field)
    return path.parent / value


def _use_odometry(path: Path, pairs: list[ImagePair]) -> None:
    """Replace ``T_odometry_camera`` of all frames by ``T_reference_camera``."""
    given = [pair.request.pop("T_odometry_camera", None) for pair in pairs]
    if all(each is None for each in given):
        return
    poses = []
    for pair, value in zip(pairs, given, strict=True):
        field = f"{pair.name}.T_odometry_camera"
        if value is None:
            raise RequestError(f"{path}: {field} is missing, but other frames have it; give it for all", field=field)
        if pair.request.get("T_reference_camera") is not None:
            raise RequestError(f"{path}: {field} and T_reference_camera exclude each other; omit one", field=field)
        poses.append(_transform(path, value, field))
    from service.geometry.rigid import inverse, quaternion_xyzw_from

    T_reference_odometry = inverse(poses[0])
    for pair, T_odometry_camera in zip(pairs[1:], poses[1:], strict=True):
        T = T_reference_odometry @ T_odometry_camera
        position, orientation = T[:3, 3].tolist(), quaternion_xyzw_from(T[:3, :3]).tolist()
        pair.request["T_reference_camera"] = {
            "position": dict(zip("xyz", position, strict=True)),
            "orientation": dict(zip("xyzw", orientation, strict=True)),
        }


def _transform(path: Path, value: Any, field: str) -> Any:
    """Return a rigid transform of the contract as a 4x4 matrix."""
    import numpy as np

    from service.geometry.rigid import rotation_from_quaternion_xyzw, transform_from

    try:
        position = [float(value["position"][axis]) for axis in "xyz"]
        quaternion = [float(value["orientation"][axis]) for axis in "xyzw"]
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise RequestError(
            f"{path}: {field}: expected position x, y, z in metres and orientation x, y, z, w", field=field
        ) from error
    if not all(map(math.isfinite, position)) or not 1e-6 < math.hypot(*quaternion) < 1e9:
        raise RequestError(f"{path}: {field}: expected finite numbers and a unit quaternion", field=field)
    return transform_from(rotation_from_quaternion_xyzw(np.array(quaternion)), np.array(position))
