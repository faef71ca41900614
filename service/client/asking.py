"""Arrays and what is known beside them, as requests of the contract with their pictures; no transport is known here."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypedDict, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from service.client.encode import Packing, encode_depth, encode_rgb
from service.contract import schema
from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import quaternion_xyzw_from

D = TypeVar("D", bound=BaseModel)
Rgb = NDArray[np.uint8]
Depth = NDArray[Any]
Camera = PinholeCamera | schema.Camera


class About(TypedDict, total=False):
    """What may be said beside one pair of pictures.

    Attributes:
        map: which one; needed where the service has several. ``name@version`` asks an older version.
        gravity: down in the camera frame, three numbers of any length but zero, from an IMU.
        T_vehicle_camera: (4, 4), where the camera sits; then ``vehicle_pose`` is answered too.
        prior: where the camera is believed to be.
        options: what to answer.
        depth_scale_m: metres for each unit of the depth array; by default 0.001 for integers, 1 for floating values.
        depth_kind: along the optical axis (the default), along the ray, or disparity.
        max_range_m: what lies beyond is no measurement.
        baseline_m: of the stereo rig, metres.
    """

    map: str | None
    gravity: Sequence[float] | NDArray[Any] | None
    T_vehicle_camera: NDArray[Any] | None
    prior: schema.Prior | None
    options: schema.Options | None
    depth_scale_m: float | None
    depth_kind: str
    max_range_m: float | None
    baseline_m: float | None


class AboutSequence(TypedDict, total=False):
    """What may be said beside a sequence; of the first frame's camera, as in ``About``."""

    map: str | None
    T_vehicle_camera: NDArray[Any] | None
    prior: schema.Prior | None
    options: schema.Options | None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame:
    """A pair of pictures of a sequence or a batch.

    Attributes:
        rgb: (H, W, 3) uint8, sRGB.
        depth: (H, W), metres as floating values, or uint16; 0 and NaN where nothing was measured.
        camera: rectified intrinsics, pixels.
        T_reference_camera: (4, 4), where this camera stood against the first frame's; None in the first frame and in a batch.
        gravity, depth_scale_m, depth_kind, max_range_m, baseline_m: as in ``About``.
    """

    rgb: Rgb
    depth: Depth
    camera: Camera
    T_reference_camera: NDArray[Any] | None = None
    gravity: Sequence[float] | NDArray[Any] | None = None
    depth_scale_m: float | None = None
    depth_kind: str = "z"
    max_range_m: float | None = None
    baseline_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Asked(Generic[D]):
    """A request and its pictures, encoded: colour and depth of each frame."""

    document: D
    pictures: tuple[tuple[bytes, bytes], ...]


def one(rgb: Rgb, depth: Depth, camera: Camera, about: About, packing: Packing) -> Asked[schema.LocalizeRequest]:
    """A single pair.

    Raises:
        RequestError: an array or a number makes no sense; its name is in ``field``.
    """
    _only_known(about, About)
    names = ("gravity", "depth_scale_m", "depth_kind", "max_range_m", "baseline_m")
    known = {name: about[name] for name in names if name in about}  # type: ignore[literal-required]  # names of About
    frame = Frame(rgb=rgb, depth=depth, camera=camera, **known)
    said, pictures = _frame(frame, packing)
    return Asked(_checked(lambda: schema.LocalizeRequest.model_validate(said | _of_all(about))), (pictures,))


def several(frames: Sequence[Frame], about: AboutSequence, packing: Packing) -> Asked[schema.BatchRequest]:
    """Pairs that are each answered on their own; what is said beside them holds for each.

    Raises:
        RequestError: as ``one``; or a frame stands against another, which only a sequence's do.
    """
    _only_known(about, AboutSequence)
    for number, frame in enumerate(frames):
        if frame.T_reference_camera is not None:
            raise RequestError(
                f"frames.{number}.T_reference_camera: each pair of a batch stands alone; ask localize_sequence for one pose of all",
                field=f"frames.{number}.T_reference_camera",
            )
    said = [_frame(frame, packing, f"frames.{number}.") for number, frame in enumerate(frames)]
    requests = [each | _of_all(about) for each, _ in said]
    document = _checked(lambda: schema.BatchRequest.model_validate({"requests": requests}))
    return Asked(document, tuple(pictures for _, pictures in said))


def sequence(frames: Sequence[Frame], about: AboutSequence, packing: Packing) -> Asked[schema.SequenceRequest]:
    """Frames that are answered as one, the reference first.

    Raises:
        RequestError: as ``one``.
    """
    _only_known(about, AboutSequence)
    said = [_frame(frame, packing, f"frames.{number}.") for number, frame in enumerate(frames)]
    content = [
        each | {"T_reference_camera": _transform(frame.T_reference_camera, f"frames.{number}.T_reference_camera")}
        for number, (frame, (each, _)) in enumerate(zip(frames, said, strict=True))
    ]
    document = _checked(lambda: schema.SequenceRequest.model_validate({"frames": content} | _of_all(about)))
    return Asked(document, tuple(pictures for _, pictures in said))


def _frame(frame: Frame, packing: Packing, where: str = "") -> tuple[dict[str, Any], tuple[bytes, bytes]]:
    """What goes with one pair, and its pictures."""
    try:
        depth = encode_depth(frame.depth, scale_m=frame.depth_scale_m, codec=packing.depth_codec)
        pictures = (encode_rgb(frame.rgb, quality=packing.quality), depth.data)
    except RequestError as error:
        raise RequestError(f"{where}{error.message}", field=f"{where}{error.field}") from error
    said = {
        "camera": _camera(frame.camera),
        "depth": {
            "scale_m": depth.scale_m, "kind": frame.depth_kind, "max_range_m": frame.max_range_m, "baseline_m": frame.baseline_m,
        },
        "gravity": _vector(frame.gravity, f"{where}gravity"),
    }  # fmt: skip
    return said, pictures


def _of_all(about: About | AboutSequence) -> dict[str, Any]:
    """What a single pair and a sequence both say."""
    options, prior = about.get("options"), about.get("prior")
    if prior is not None and prior.position is not None and prior.wgs84 is not None:  # gRPC could send the one alone
        raise RequestError("prior: position and wgs84 say the same thing; send one of them", field="prior")
    return {
        "map": about.get("map"), "prior": prior,
        "T_vehicle_camera": _transform(about.get("T_vehicle_camera"), "T_vehicle_camera"),
    } | ({} if options is None else {"options": options})  # fmt: skip


def _camera(camera: Camera) -> dict[str, Any]:
    if isinstance(camera, schema.Camera):
        return camera.model_dump()
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return numbers | {"distortion": list(camera.distortion)}


def _vector(vector: Sequence[float] | NDArray[Any] | None, field: str) -> dict[str, float] | None:
    if vector is None:
        return None
    numbers = np.asarray(vector, np.float64)
    if numbers.shape != (3,):
        raise RequestError(f"{field}: an array {numbers.shape} is no direction; give three numbers", field=field)
    return dict(zip("xyz", numbers.tolist(), strict=True))


def _transform(T: NDArray[Any] | None, field: str) -> dict[str, Any] | None:
    """A 4 x 4 matrix as the contract says it.

    Raises:
        RequestError: it is no rigid transform.
    """
    if T is None:
        return None
    matrix = np.asarray(T, np.float64)
    rigid = matrix.shape == (4, 4) and np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6)
    if not rigid or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-4):
        raise RequestError(
            f"{field}: this array {matrix.shape} is no rigid transform; give a 4 x 4 matrix of rotation and translation (metres)",
            field=field,
        )
    x, y, z, w = quaternion_xyzw_from(matrix[:3, :3]).tolist()
    position = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _only_known(about: About | AboutSequence, known: type) -> None:
    if unknown := sorted(set(about) - set(known.__annotations__)):
        raise TypeError(f"unknown argument {unknown[0]!r}; known are {', '.join(known.__annotations__)}")


def _checked(make: Callable[[], D]) -> D:
    try:
        return make()
    except ValidationError as error:
        from service.contract.convert import invalid  # it brings the whole service, which a good request does without

        raise invalid(error) from error
