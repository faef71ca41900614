"""Build requests of the contract and encoded images from arrays, independent of the transport."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypedDict, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from service.client.encode import Packing, encode_depth, encode_rgb
from service.contract import schema
from service.contract.invalid import invalid
from service.errors import RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import quaternion_xyzw_from

D = TypeVar("D", bound=BaseModel)
#: An image as an array, or the bytes of an image file, which are sent unchanged.
Rgb = NDArray[np.uint8] | bytes
Depth = NDArray[Any] | bytes
Camera = PinholeCamera | schema.Camera


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Track:
    """State of a moving robot between two queries; ``Track()`` begins.

    Attributes:
        before: the answer to the query before.
        T_previous_camera: (4, 4), pose of this camera in the frame of the previous query's camera, from odometry, metres.
            None: the odometry is unknown, and the track begins again.
        odometry_std: standard deviations of ``T_previous_camera``. None: 3 % of the distance plus 0.02 m, and 3 % of the angle plus
            0.2 degrees.
    """

    before: schema.LocalizeAnswer | None = None
    T_previous_camera: NDArray[Any] | None = None
    odometry_std: schema.OdometryStd | None = None


class RequestOptions(TypedDict, total=False):
    """Optional data of a query.

    Attributes:
        map: name of the map. Required if the service has several. ``name@version`` selects an older version.
        gravity: (3,), downward direction in the camera frame, from an IMU. Any length except zero.
        T_vehicle_camera: (4, 4), pose of the camera in the vehicle frame, metres. With it, the answer has ``vehicle_pose``.
        prior: prior knowledge of the camera's pose.
        options: what the answer contains.
        depth_scale_m: metres (disparity: pixels) per unit of the depth image. The default is 0.001 for integers and 1 for
            floating-point values.
        depth_kind: ``z`` (along the optical axis, the default), ``range`` (along the ray) or ``disparity``.
        max_range_m: larger ranges are no measurement, metres.
        baseline_m: baseline of the stereo rig, metres. Required for disparity.
        camera_height_m: height of the camera's centre above the ground, metres. Without it, the service finds the height in the
            depth image. It replaces ``height_m`` of a ``schema.Camera``.
        camera_height_std_m: standard deviation of ``camera_height_m``, metres. The default is 0.05.
        vehicle_base_on_ground: whether the origin of the vehicle frame lies on the ground, as that of ``base_footprint``. Then the
            height of the camera follows from ``T_vehicle_camera``.
        track: state of a moving robot. The answer then has a ``belief`` over all frames.
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
    camera_height_m: float | None
    camera_height_std_m: float | None
    vehicle_base_on_ground: bool
    track: Track | None


class BatchOptions(TypedDict, total=False):
    """Optional data of every query of a batch, as in ``RequestOptions``.

    Attributes:
        map: name of the map.
        T_vehicle_camera: (4, 4), pose of the camera in the vehicle frame, metres.
        prior: prior knowledge of the camera's pose.
        options: what the answer contains.
        vehicle_base_on_ground: whether the origin of the vehicle frame lies on the ground, as in ``RequestOptions``.
    """

    map: str | None
    T_vehicle_camera: NDArray[Any] | None
    prior: schema.Prior | None
    options: schema.Options | None
    vehicle_base_on_ground: bool


class SequenceOptions(BatchOptions, total=False):
    """Optional data of a sequence, as in ``RequestOptions``.

    ``T_vehicle_camera``, ``prior`` and the odometry of ``track`` describe the camera of the first frame.

    Attributes:
        track: state of a moving robot. The frames are those of its cameras at one moment.
    """

    track: Track | None


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Frame:
    """One colour image and one depth image of a sequence or a batch.

    Attributes:
        rgb: (H, W, 3), sRGB, or the bytes of a JPEG, PNG or WebP file.
        depth: (H, W), metres as floating-point values, or uint16. 0 and NaN mean that nothing was measured. Or the bytes of a
            16-bit PNG, TIFF, NPY or raw16 file.
        camera: intrinsics of both images, pixels, and their distortion if they are not rectified.
        T_reference_camera: (4, 4), transform from this camera to the first frame's camera, metres. None in the first frame
            and in a batch.
        gravity, depth_scale_m, depth_kind, max_range_m, baseline_m, camera_height_m, camera_height_std_m: as in ``RequestOptions``.
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
    camera_height_m: float | None = None
    camera_height_std_m: float | None = None


class StreamOptions(TypedDict, total=False):
    """Optional data of a stream, as in ``RequestOptions``. It holds for every frame.

    Attributes:
        map: name of the map.
        T_vehicle_camera: (4, 4), pose of the camera in the vehicle frame, metres.
        options: what the answers contain.
        vehicle_base_on_ground: whether the origin of the vehicle frame lies on the ground, as in ``RequestOptions``.
    """

    map: str | None
    T_vehicle_camera: NDArray[Any] | None
    options: schema.Options | None
    vehicle_base_on_ground: bool


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class StreamFrame:
    """One colour image and one depth image of a moving robot.

    Attributes:
        rgb, depth, camera: as in ``Frame``.
        T_previous_camera: (4, 4), pose of this camera in the frame of the previous frame's camera, from odometry, metres. None in the
            first frame. None later: the odometry is unknown, and the track begins again.
        odometry_std: standard deviations of ``T_previous_camera``, as in ``Track``.
        prior: prior knowledge of the camera's pose. It counts in the first frame of a track only.
        gravity, depth_scale_m, depth_kind, max_range_m, baseline_m, camera_height_m, camera_height_std_m: as in ``RequestOptions``.
    """

    rgb: Rgb
    depth: Depth
    camera: Camera
    T_previous_camera: NDArray[Any] | None = None
    odometry_std: schema.OdometryStd | None = None
    prior: schema.Prior | None = None
    gravity: Sequence[float] | NDArray[Any] | None = None
    depth_scale_m: float | None = None
    depth_kind: str = "z"
    max_range_m: float | None = None
    baseline_m: float | None = None
    camera_height_m: float | None = None
    camera_height_std_m: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PreparedRequest(Generic[D]):
    """A request with its encoded images.

    Attributes:
        document: the request of the contract, without images.
        pictures: encoded colour image and encoded depth image of each frame.
        before: answer to the query before of the same track; None without one.
    """

    document: D
    pictures: tuple[tuple[bytes, bytes], ...]
    before: schema.LocalizeAnswer | None = None


def one(
    rgb: Rgb, depth: Depth, camera: Camera, about: RequestOptions, packing: Packing
) -> PreparedRequest[schema.LocalizeRequest]:
    """Build the request for a single query.

    Args:
        rgb: (H, W, 3), sRGB, or the bytes of an image file.
        depth: (H, W), metres along the optical axis as floating-point values, or uint16. Or the bytes of an image file.
        camera: intrinsics of both images, pixels, and their distortion if they are not rectified.
        about: optional data of the query.
        packing: how images are encoded.

    Raises:
        RequestError: an argument is invalid. ``field`` names it.
        TypeError: ``about`` has an unknown key.
    """
    _only_known(about, RequestOptions)
    names = (
        "gravity",
        "depth_scale_m",
        "depth_kind",
        "max_range_m",
        "baseline_m",
        "camera_height_m",
        "camera_height_std_m",
    )
    known = {name: about[name] for name in names if name in about}  # type: ignore[literal-required]  # names of RequestOptions
    frame = Frame(rgb=rgb, depth=depth, camera=camera, **known)
    said, pictures = _frame(frame, packing)
    track = about.get("track")
    content = said | _of_all(about) | _track(track)
    document = _checked(lambda: schema.LocalizeRequest.model_validate(content))
    return PreparedRequest(document, (pictures,), None if track is None else track.before)


def several(frames: Sequence[Frame], about: BatchOptions, packing: Packing) -> PreparedRequest[schema.BatchRequest]:
    """Build the request for a batch of independent queries.

    Args:
        frames: the queries. ``T_reference_camera`` must be None.
        about: optional data that holds for every query.
        packing: how images are encoded.

    Raises:
        RequestError: as ``one``, or a frame has a ``T_reference_camera``.
        TypeError: ``about`` has an unknown key.
    """
    _only_known(about, BatchOptions)
    for number, frame in enumerate(frames):
        if frame.T_reference_camera is not None:
            raise RequestError(
                f"frames.{number}.T_reference_camera: not allowed in a batch; use localize_sequence",
                field=f"frames.{number}.T_reference_camera",
            )
    said = [_frame(frame, packing, f"frames.{number}.") for number, frame in enumerate(frames)]
    requests = [each | _of_all(about) for each, _ in said]
    document = _checked(lambda: schema.BatchRequest.model_validate({"requests": requests}))
    return PreparedRequest(document, tuple(pictures for _, pictures in said))


def sequence(
    frames: Sequence[Frame], about: SequenceOptions, packing: Packing
) -> PreparedRequest[schema.SequenceRequest]:
    """Build the request for a sequence, which gets one common answer.

    Args:
        frames: the first frame is the reference. Each further frame needs ``T_reference_camera``.
        about: optional data of the sequence.
        packing: how images are encoded.

    Raises:
        RequestError: as ``one``.
        TypeError: ``about`` has an unknown key.
    """
    _only_known(about, SequenceOptions)
    said = [_frame(frame, packing, f"frames.{number}.") for number, frame in enumerate(frames)]
    content = [
        each | {"T_reference_camera": _transform(frame.T_reference_camera, f"frames.{number}.T_reference_camera")}
        for number, (frame, (each, _)) in enumerate(zip(frames, said, strict=True))
    ]
    track = about.get("track")
    told = {"frames": content} | _of_all(about) | _track(track)
    document = _checked(lambda: schema.SequenceRequest.model_validate(told))
    return PreparedRequest(document, tuple(pictures for _, pictures in said), None if track is None else track.before)


def stream_frame(
    number: int, frame: StreamFrame, about: StreamOptions, packing: Packing
) -> PreparedRequest[schema.LocalizeRequest]:
    """Build the request for the next frame of a stream. Its odometry is in ``track`` of the document, without a belief.

    Args:
        number: number of the frame, for messages.
        frame: the frame.
        about: optional data that holds for every frame.
        packing: how images are encoded.

    Raises:
        RequestError: as ``one``, or the frame has an ``odometry_std`` and no ``T_previous_camera``. ``field`` begins with
            ``frames.NUMBER``.
    """
    where = f"frames.{number}."
    if frame.odometry_std is not None and frame.T_previous_camera is None:
        field = f"{where}odometry_std"
        raise RequestError(f"{field}: it needs T_previous_camera, which is missing; pass both", field=field)
    pictures = Frame(
        rgb=frame.rgb,
        depth=frame.depth,
        camera=frame.camera,
        gravity=frame.gravity,
        depth_scale_m=frame.depth_scale_m,
        depth_kind=frame.depth_kind,
        max_range_m=frame.max_range_m,
        baseline_m=frame.baseline_m,
        camera_height_m=frame.camera_height_m,
        camera_height_std_m=frame.camera_height_std_m,
    )
    said, encoded = _frame(pictures, packing, where)
    odometry = {
        "T_previous_camera": _transform(frame.T_previous_camera, f"{where}T_previous_camera"),
        "odometry_std": frame.odometry_std,
    }
    try:
        content = said | _of_all(BatchOptions(**about, prior=frame.prior)) | {"track": odometry}
        document = _checked(lambda: schema.LocalizeRequest.model_validate(content))
    except RequestError as error:
        raise RequestError(f"{where}{error.message}", field=f"{where}{error.field}") from error
    return PreparedRequest(document, (encoded,))


def only_stream_options(about: StreamOptions) -> None:
    """Refuse unknown options of a stream.

    Args:
        about: optional data of a stream.

    Raises:
        TypeError: ``about`` has an unknown key.
    """
    _only_known(about, StreamOptions)


def _frame(frame: Frame, packing: Packing, where: str = "") -> tuple[dict[str, Any], tuple[bytes, bytes]]:
    """Return the request fields of one frame and its encoded images.

    Raises:
        RequestError: a value is invalid. ``field`` begins with ``where``.
    """
    try:
        rgb = _rgb(frame, packing)
        depth, scale_m = _depth(frame, packing)
    except RequestError as error:
        raise RequestError(f"{where}{error.message}", field=f"{where}{error.field}") from error
    said = {
        "camera": _camera(frame.camera) | _height(frame, where),
        "depth": {
            "scale_m": scale_m,
            "kind": frame.depth_kind,
            "max_range_m": frame.max_range_m,
            "baseline_m": frame.baseline_m,
        },
        "gravity": _vector(frame.gravity, f"{where}gravity"),
    }
    return said, (rgb, depth)


def _rgb(frame: Frame, packing: Packing) -> bytes:
    if isinstance(frame.rgb, bytes):
        return _file(frame.rgb, "rgb")
    return encode_rgb(frame.rgb, quality=packing.quality)


def _depth(frame: Frame, packing: Packing) -> tuple[bytes, float | None]:
    """Return the encoded depth image and its scale, metres per unit. None leaves the scale of a file to the service."""
    if isinstance(frame.depth, bytes):
        return _file(frame.depth, "depth"), frame.depth_scale_m
    encoded = encode_depth(frame.depth, scale_m=frame.depth_scale_m, codec=packing.depth_codec)
    return encoded.data, encoded.scale_m


def _file(data: bytes, field: str) -> bytes:
    if not data:
        raise RequestError(f"{field}: the file is empty (0 bytes); pass the bytes of an image file", field=field)
    return data


def _of_all(about: RequestOptions | BatchOptions) -> dict[str, Any]:
    """Return the request fields that a single query and a sequence have in common.

    Raises:
        RequestError: a value is invalid, or the prior has two positions.
    """
    options, prior = about.get("options"), about.get("prior")
    if prior is not None and prior.position is not None and prior.wgs84 is not None:  # gRPC could send only one of them
        raise RequestError("prior: position and wgs84 exclude each other; send one of them", field="prior")
    return (
        {
            "map": about.get("map"),
            "prior": prior,
            "T_vehicle_camera": _transform(about.get("T_vehicle_camera"), "T_vehicle_camera"),
        }
        | ({} if options is None else {"options": options})
        | ({"vehicle_base_on_ground": about["vehicle_base_on_ground"]} if "vehicle_base_on_ground" in about else {})
    )


def _track(track: Track | None) -> dict[str, Any]:
    """Return the field of a track; none without a track, because an earlier service does not know it."""
    if track is None:
        return {}
    if not isinstance(track, Track):
        raise RequestError("track: it is no Track; pass Track(before=answer, T_previous_camera=...)", field="track")
    if track.before is None and track.T_previous_camera is not None:
        raise RequestError(
            "track.before: it is missing, but T_previous_camera is given; pass the previous answer as before, or Track() to begin",
            field="track.before",
        )
    belief = None if track.before is None else track.before.belief
    if track.before is not None and belief is None and track.before.confidence is not None:
        raise RequestError(
            "track.before: this answer has no belief, because its request had no track; begin with track=Track()",
            field="track.before",
        )
    if belief is not None and belief.token is None:
        raise RequestError(
            "track.before: this answer comes from a stream, which keeps the track itself; pass an answer of localize, or send this frame "
            "with localize_stream",
            field="track.before",
        )
    T = _transform(track.T_previous_camera, "track.T_previous_camera")
    content = {"belief": None if belief is None else belief.token, "T_previous_camera": T}
    # An earlier service does not know odometry_std, so it is sent only if it is set.
    return {"track": content | ({} if track.odometry_std is None else {"odometry_std": track.odometry_std})}


def _camera(camera: Camera) -> dict[str, Any]:
    if isinstance(camera, schema.Camera):
        return camera.model_dump(exclude_unset=True)
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    content = numbers | {"distortion": list(camera.distortion)}
    # An earlier service does not know the field, so only a fisheye lens sends it.
    return (
        content
        if camera.distortion_model == "brown_conrady"
        else content | {"distortion_model": camera.distortion_model}
    )


def _height(frame: Frame, where: str) -> dict[str, float]:
    """Return the fields of the camera's height. Nothing is sent that was not given: an earlier service does not know the fields.

    Raises:
        RequestError: a standard deviation was given without a height.
    """
    height_m, std_m = frame.camera_height_m, frame.camera_height_std_m
    if height_m is None:
        if std_m is not None:
            field = f"{where}camera_height_std_m"
            raise RequestError(f"{field}: it needs camera_height_m, which is missing; pass both", field=field)
        return {}
    return {"height_m": height_m} | ({} if std_m is None else {"height_std_m": std_m})


def _vector(vector: Sequence[float] | NDArray[Any] | None, field: str) -> dict[str, float] | None:
    if vector is None:
        return None
    numbers = np.asarray(vector, np.float64)
    if numbers.shape != (3,):
        raise RequestError(
            f"{field}: an array of shape {numbers.shape} is not a valid direction; pass three numbers", field=field
        )
    return dict(zip("xyz", numbers.tolist(), strict=True))


def _transform(T: NDArray[Any] | None, field: str) -> dict[str, Any] | None:
    """Convert a (4, 4) matrix to the contract's rigid transform.

    Raises:
        RequestError: the matrix is no rigid transform.
    """
    if T is None:
        return None
    matrix = np.asarray(T, np.float64)
    rigid = matrix.shape == (4, 4) and np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6)
    if not rigid or not np.allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-4):
        raise RequestError(
            f"{field}: an array of shape {matrix.shape} is not a valid rigid transform; "
            "pass a 4 x 4 matrix of rotation and translation (metres)",
            field=field,
        )
    x, y, z, w = quaternion_xyzw_from(matrix[:3, :3]).tolist()
    position = dict(zip("xyz", matrix[:3, 3].tolist(), strict=True))
    return {"position": position, "orientation": {"x": x, "y": y, "z": z, "w": w}}


def _only_known(about: RequestOptions | BatchOptions | StreamOptions, known: type) -> None:
    if unknown := sorted(set(about) - set(known.__annotations__)):
        raise TypeError(f"unknown argument {unknown[0]!r}; pass one of {', '.join(known.__annotations__)}")


def _checked(make: Callable[[], D]) -> D:
    try:
        return make()
    except ValidationError as error:
        raise invalid(error) from error
