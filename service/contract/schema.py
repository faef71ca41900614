"""The public contract: requests and answers, for REST as JSON and for gRPC as messages. Angles are in degrees; the core uses radians."""

import math
import re
import uuid
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationInfo, field_validator, model_validator
from pydantic.config import JsonDict

from service.errors import NotLocalizedError, RequestError
from service.geometry.camera import DistortionModel
from service.geometry.distortion import COEFFICIENTS, LIMITS, coefficient_problem
from service.option_limits import (
    HEIGHT_STD_M,
    LEAST_BASELINE_M,
    LEAST_FALSE_ACCEPT_RATE,
    LEAST_HEIGHT_M,
    LEAST_HEIGHT_STD_M,
    LEAST_ODOMETRY_STD_DEG,
    LEAST_ODOMETRY_STD_M,
    LEAST_SIDE,
    MOST_ASPECT,
    MOST_BASELINE_M,
    MOST_HEIGHT_M,
    MOST_HEIGHT_STD_M,
    MOST_NEIGHBOURS,
    MOST_ODOMETRY_STD_DEG,
    MOST_ODOMETRY_STD_M,
    NEIGHBOURS,
    VEHICLE_HEIGHT_STD_M,
)
from service.retrieval.prior import HEADING_STD_DEG, POSITION_STD_M

#: Limits of a focal length, in widths or heights of the image: 175 and 0.6 degrees of view. A value outside was given in another unit
#: than pixels.
LEAST_FOCAL, MOST_FOCAL = 0.02, 100.0
#: Longest side of an image, pixels.
MOST_SIDE = 32768
#: Limit of the components of a vector whose length does not matter. An accelerometer may use m/s2, thousandths of g or its own steps.
MOST_COMPONENT = 1e6
#: Most characters of the token of a belief. A track of eight modes has 1,850.
MOST_TOKEN = 2048
#: Name of the request id: header (REST, in any case) and metadata key (gRPC, in lower case).
REQUEST_ID = "x-request-id"
_REQUEST_ID_FORM = re.compile(r"[A-Za-z0-9._-]{1,64}")


def request_id_of(given: str) -> str:
    """Return the caller's request id if it is 1 to 64 letters, digits, ``.``, ``_`` or ``-``; else a new one.

    Args:
        given: id that the caller sent; empty if it sent none.
    """
    return given if _REQUEST_ID_FORM.fullmatch(given) else uuid.uuid4().hex


class _Strict(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Vector(_Strict):
    """Vector with three components."""

    x: float
    y: float
    z: float


class Direction(_Strict):
    """Vector with three components. Only its direction counts."""

    x: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    y: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    z: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)


class Quaternion(_Strict):
    """Rotation. A request may send any length but zero. An answer has length 1."""

    x: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    y: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    z: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    w: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)


class Position(_Strict):
    """Position, metres, between parts of a robot or between places that it passed."""

    x: float = Field(ge=-1e5, le=1e5)
    y: float = Field(ge=-1e5, le=1e5)
    z: float = Field(ge=-1e5, le=1e5)


class RigidTransform(_Strict):
    """Rigid transform. `T_a_b` maps points from frame b to frame a."""

    position: Position
    orientation: Quaternion


def _coefficients(model: DistortionModel) -> str:
    """Describe the coefficients of a lens and their limits."""
    counts, limits = COEFFICIENTS[model], dict[float, list[str]]()
    for name, limit in LIMITS[model]:
        limits.setdefault(limit, []).append(name)
    bounds = ", ".join(f"{' '.join(names)} within {limit:g}" for limit, names in limits.items())
    count = " or ".join(filter(None, (", ".join(map(str, counts[:-1])), str(counts[-1]))))
    return f"{model}: {count} coefficients of {', '.join(name for name, _ in LIMITS[model])} ({bounds})"


class Camera(_Strict):
    """Intrinsics and lens of both images as sent, pixels. The centre of the first pixel is (0, 0).

    The service rectifies both images if `distortion` or `distortion_model` describes a lens.
    """

    model: Literal["PINHOLE"] = Field(
        "PINHOLE",
        description="projection without the lens. The service refuses any other model; distortion_model names the lens",
    )
    width: int = Field(ge=LEAST_SIDE, le=MOST_SIDE)
    height: int = Field(
        ge=LEAST_SIDE, le=MOST_SIDE, description=f"neither side may be longer than {MOST_ASPECT} times the other"
    )
    fx: float = Field(
        ge=LEAST_FOCAL * LEAST_SIDE,
        le=MOST_FOCAL * MOST_SIDE,
        description=f"focal length, pixels, {LEAST_FOCAL} to {MOST_FOCAL:g} times the width",
    )
    fy: float = Field(
        ge=LEAST_FOCAL * LEAST_SIDE,
        le=MOST_FOCAL * MOST_SIDE,
        description=f"focal length, pixels, {LEAST_FOCAL} to {MOST_FOCAL:g} times the height",
    )
    cx: float = Field(ge=-2 * MOST_SIDE, le=2 * MOST_SIDE)
    cy: float = Field(ge=-2 * MOST_SIDE, le=2 * MOST_SIDE)
    distortion_model: DistortionModel = Field(
        "brown_conrady",
        description="lens of both images. brown_conrady: OpenCV's models plumb_bob and rational_polynomial. kannala_brandt: OpenCV's "
        "fisheye model (equidistant in ROS), which needs four coefficients, also if they are zero",
    )
    distortion: list[Annotated[float, Field(ge=-1e3, le=1e3)]] = Field(
        default_factory=list,
        validate_default=True,
        max_length=14,
        description="distortion coefficients of both images as sent, in OpenCV order. Empty or zeros: the images are rectified. "
        + "; ".join(_coefficients(model) for model in COEFFICIENTS)
        + ". The radius must grow from the centre of the image to its corners",
    )
    height_m: float | None = Field(
        None,
        ge=LEAST_HEIGHT_M,
        le=MOST_HEIGHT_M,
        description="height of the camera's centre above the ground, metres. Not sent: the service finds it in the depth image",
    )
    height_std_m: float = Field(
        HEIGHT_STD_M,
        ge=LEAST_HEIGHT_STD_M,
        le=MOST_HEIGHT_STD_M,
        description="standard deviation of height_m, metres. It counts only with height_m",
    )

    @field_validator("model", mode="before")
    @classmethod
    def _is_rectified(cls, model: object) -> object:
        if model != "PINHOLE":
            raise ValueError(
                "only PINHOLE is supported; send the lens as distortion_model and distortion, or rectify both images"
            )
        return model

    @field_validator("distortion")
    @classmethod
    def _is_a_lens(cls, distortion: list[float], info: ValidationInfo) -> list[float]:
        model = info.data.get("distortion_model")  # None: refused itself
        is_lens = model == "kannala_brandt" or any(distortion)
        if model is not None and is_lens and (problem := coefficient_problem(model, distortion)):
            raise ValueError(problem)
        return distortion

    @field_validator("fx", "fy")
    @classmethod
    def _is_in_pixels(cls, focal: float, info: ValidationInfo) -> float:
        side = info.data.get("width" if info.field_name == "fx" else "height")  # None: refused itself
        if side is not None and not LEAST_FOCAL * side <= focal <= MOST_FOCAL * side:
            seen_deg = 2 * math.degrees(math.atan(0.5 * side / focal))
            raise ValueError(
                f"{focal:g} px for a side of {side} px means a field of view of {seen_deg:.3g} degrees; send the focal length in pixels"
            )
        return focal

    @field_validator("height")
    @classmethod
    def _is_no_strip(cls, height: int, info: ValidationInfo) -> int:
        width = info.data.get("width")  # None: refused itself
        if width is not None and max(width, height) > MOST_ASPECT * min(width, height):
            raise ValueError(
                f"the aspect ratio of {width} x {height} px exceeds {MOST_ASPECT}:1; send the image size of the camera"
            )
        return height


class Depth(_Strict):
    """Format of the depth image."""

    scale_m: float | None = Field(
        None,
        ge=1e-6,
        le=1e4,
        description="metres per stored unit (disparity: pixels per stored unit). Default: 0.001 for integers, 1 for floats",
    )
    kind: Literal["z", "range", "disparity"] = Field(
        "z", description="z: depth along the optical axis. range: depth along the ray. disparity: stereo disparity"
    )
    encoding: Literal["auto", "carla", "compressed_depth"] = Field(
        "auto",
        description="auto: the service detects the encoding from the first bytes. carla: depth in the 24 bits of a colour PNG. "
        "compressed_depth: data of a ROS compressedDepth message, PNG or RVL",
    )
    max_range_m: float | None = Field(
        None, ge=0.01, le=1e5, description="depth beyond this range counts as not measured"
    )
    baseline_m: float | None = Field(
        None,
        ge=LEAST_BASELINE_M,
        le=MOST_BASELINE_M,
        description="baseline of the stereo rig. Disparity needs it. "
        "With a baseline, the service also estimates the rig's disparity offset",
    )


class PriorPosition(_Strict):
    """Prior of the camera position in the map frame, metres."""

    x: float = Field(ge=-1e7, le=1e7)
    y: float = Field(ge=-1e7, le=1e7)
    std_m: float = Field(POSITION_STD_M, ge=1e-3, le=1e6, description="standard deviation of each coordinate, metres")


class PriorWgs84(_Strict):
    """Prior of the camera position on the Earth. The map must be georeferenced."""

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-180, le=180)
    std_m: float = Field(
        POSITION_STD_M, ge=1e-3, le=1e6, description="standard deviation of each horizontal coordinate, metres"
    )


class Prior(_Strict):
    """Prior of the camera pose. The prior narrows the search. The images may still contradict the prior."""

    position: PriorPosition | None = None
    wgs84: PriorWgs84 | None = None
    heading_deg: float | None = Field(
        None, ge=-360, le=360, description="heading of the optical axis, counter-clockwise from map x"
    )
    heading_std_deg: float = Field(HEADING_STD_DEG, ge=1e-3, le=360, description="standard deviation of the heading")


class Options(_Strict):
    """Options of the localization and of its answer."""

    neighbours: int = Field(
        NEIGHBOURS,
        ge=1,
        le=MOST_NEIGHBOURS,
        description="k: number of distinct places that vote and that the answer lists",
    )
    refine: bool = Field(
        True,
        description="true: the service registers the depth image on the map cloud. "
        "false: the answer is the pose of retrieval only, and covariance and confidence are null",
    )
    false_accept_rate: float | None = Field(
        None,
        ge=LEAST_FALSE_ACCEPT_RATE,
        lt=1,
        description="tolerated share of out-of-map queries with status LOCALIZED. The service refuses a rate below the lowest "
        "rate that the map's calibration supports, or that the recording of this rig supports. Up to 0.01, a LOCALIZED answer has a "
        "confidence of at least 0.9, and at any rate one of at least 0.5. Default: the service's setting",
    )


class OdometryStd(_Strict):
    """Standard deviations of the odometry since the image pair before."""

    position_m: float = Field(
        ge=LEAST_ODOMETRY_STD_M,
        le=MOST_ODOMETRY_STD_M,
        description="standard deviation of the translation along each axis, metres",
    )
    angle_deg: float = Field(
        ge=LEAST_ODOMETRY_STD_DEG,
        le=MOST_ODOMETRY_STD_DEG,
        description="standard deviation of the rotation about each axis, degrees",
    )


class Track(_Strict):
    """State of a moving robot that the client carries from request to request. `{}` begins a track.

    The answer then has a `belief`. Send its `token` with the next image pair and the odometry between them.
    """

    belief: str | None = Field(
        None,
        max_length=MOST_TOKEN,
        pattern=r"^[A-Za-z0-9_-]*$",
        description="token of the belief of the answer before. Not sent: the track begins",
    )
    T_previous_camera: RigidTransform | None = Field(
        None,
        description="odometry since the image pair before: pose of this camera in the frame of the previous camera. Not sent: the "
        "odometry is unknown, and the track begins again",
    )
    odometry_std: OdometryStd | None = Field(
        None,
        description="how accurate T_previous_camera is. Not sent: 3 % of the distance plus 0.02 m, and 3 % of the angle plus 0.2 degrees. "
        "Refused without T_previous_camera",
    )


_MAP = "name of the map. Optional if only one map is mounted. With several maps, prior.wgs84 chooses the nearest georeferenced one"
#: Examples. A camera that looks along the vehicle's x axis, 1.6 m above its origin; and its pose after 0.8 m of straight travel.
_CAMERA: JsonDict = {"model": "PINHOLE", "width": 640, "height": 480, "fx": 320, "fy": 320, "cx": 319.5, "cy": 239.5}
_DEPTH: JsonDict = {"scale_m": 0.001, "kind": "z", "max_range_m": 80}
_FORWARD_CAMERA: JsonDict = {
    "position": {"x": 0.5, "y": 0.0, "z": 1.6},
    "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5},
}
_AHEAD: JsonDict = {"position": {"x": 0.0, "y": 0.0, "z": 0.8}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


class LocalizeRequest(_Strict):
    """JSON part of a request."""

    model_config = ConfigDict(
        title="LocalizeRequest",
        json_schema_extra={
            "examples": [
                {
                    "map": "paper-city",
                    "camera": _CAMERA | {"height_m": 1.6, "height_std_m": 0.05},
                    "depth": _DEPTH,
                    "gravity": {"x": 0.01, "y": 0.999, "z": 0.02},
                    "prior": {"position": {"x": 12.0, "y": -40.0, "std_m": 20.0}, "heading_deg": 90.0},
                    "options": {"neighbours": 5},
                }
            ]
        },
    )

    map: str | None = Field(None, max_length=64, description=_MAP)
    camera: Camera
    depth: Depth = Depth()
    gravity: Direction | None = Field(
        None, description="direction of gravity (down) in the camera frame, from an IMU. Any length but zero"
    )
    T_vehicle_camera: RigidTransform | None = Field(
        None, description="pose of the camera on the vehicle. If sent, the answer also has the vehicle pose"
    )
    vehicle_base_on_ground: bool = Field(
        False,
        description="true: the origin of the vehicle frame lies on the ground and its z axis points up, as base_footprint of "
        "REP 105. Without camera.height_m, the camera's height is then the z of T_vehicle_camera "
        f"(standard deviation {VEHICLE_HEIGHT_STD_M:g} m)",
    )
    prior: Prior | None = Field(None, description="prior of the camera pose: a position, a heading, or both")
    options: Options = Options()
    track: Track | None = Field(
        None,
        description="state of a moving robot that the client carries. A gRPC stream has none, because it keeps the track",
    )


MOST_FRAMES = 16


class BatchRequest(_Strict):
    """JSON part of a batch. Request k belongs to the parts rgbK and depthK."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "requests": [
                        {"map": "paper-city", "camera": _CAMERA, "depth": _DEPTH},
                        {"map": "paper-city", "camera": _CAMERA, "depth": _DEPTH, "options": {"refine": False}},
                    ]
                }
            ]
        }
    )

    requests: list[LocalizeRequest] = Field(min_length=1, max_length=MOST_FRAMES)


class SequenceFrame(_Strict):
    """Image pair of a sequence. Frame k belongs to the parts rgbK and depthK."""

    camera: Camera
    depth: Depth = Depth()
    gravity: Direction | None = Field(
        None, description="direction of gravity (down) in the camera frame, from an IMU. Any length but zero"
    )
    T_reference_camera: RigidTransform | None = Field(
        None, description="pose of this camera in the frame of the first frame's camera. Null in the first frame"
    )


class SequenceRequest(_Strict):
    """JSON part of a sequence: frames of a traversal, or the cameras of a rig at one instant.

    The answer is the pose of the first frame.
    """

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "map": "paper-city",
                    "frames": [
                        {"camera": _CAMERA, "depth": _DEPTH},
                        {"camera": _CAMERA, "depth": _DEPTH, "T_reference_camera": _AHEAD},
                    ],
                    "T_vehicle_camera": _FORWARD_CAMERA,
                    "vehicle_base_on_ground": True,
                }
            ]
        }
    )

    map: str | None = Field(None, max_length=64, description=_MAP)
    frames: list[SequenceFrame] = Field(min_length=1, max_length=MOST_FRAMES)
    T_vehicle_camera: RigidTransform | None = Field(
        None,
        description="pose of the first frame's camera on the vehicle. If sent, the answer also has the vehicle pose",
    )
    vehicle_base_on_ground: bool = Field(
        False,
        description="true: the origin of the vehicle frame lies on the ground and its z axis points up, as base_footprint of "
        "REP 105. Without camera.height_m, the first camera's height is then the z of T_vehicle_camera "
        f"(standard deviation {VEHICLE_HEIGHT_STD_M:g} m). A camera within 2 m of the first one follows by its T_reference_camera",
    )
    prior: Prior | None = Field(None, description="prior of the pose of the first frame's camera")
    options: Options = Options()
    track: Track | None = Field(
        None,
        description="state of a moving robot that the client carries. The frames are those of its cameras at one moment, and the "
        "odometry is that of the first frame's camera",
    )


class Street(BaseModel):
    """A street, or a section of a street, under the registered position.

    Without registration, it is the street of the heaviest cluster of similar places.
    """

    id: str
    name: str = Field(examples=["End of street 4"])
    street: str = Field(examples=["4"])
    section: Literal["beginning", "end"] | None
    class_index: int = Field(description="number of the class, 0 to 15 in the paper's city")
    vote: float = Field(
        description="this street's share of the similarity-weighted votes of the nearest places, 0 to 1"
    )


HeadingDeg = Annotated[
    float,
    Field(
        gt=-180,
        le=180,
        description="heading of the optical axis (or of the vehicle's x axis), counter-clockwise from map x",
    ),
]


class Pose(BaseModel):
    """Pose in the map frame, metres. The camera frame is x right, y down, z forward."""

    position: Vector
    orientation: Quaternion
    heading_deg: HeadingDeg
    covariance: list[float] | None = Field(
        description="6x6, row by row, translation (m) first, then rotation (rad), in map axes, about the origin of this frame. "
        "Null if unknown, as without registration"
    )


class GeoPosition(BaseModel):
    """Position on the WGS-84 ellipsoid, with the field names of OGC GeoPose."""

    lat: float = Field(description="latitude, degrees")
    lon: float = Field(description="longitude, degrees")
    h: float = Field(description="height above the ellipsoid, metres")


class GeoPose(BaseModel):
    """OGC GeoPose 1.0, Basic-Quaternion. The quaternion leads from east, north, up at the position to the axes of the body.

    The body is the vehicle (x forward, y left, z up) if the request has T_vehicle_camera.
    Otherwise, the body is the camera (x right, y down, z forward).
    """

    position: GeoPosition
    quaternion: Quaternion


class Neighbour(BaseModel):
    """One of the most similar places of the map."""

    place: int
    distance: float = Field(description="Euclidean distance of the descriptors, 0 to 2")
    similarity: float = Field(description="cosine similarity of the descriptors")
    street: str | None = Field(description="id of the street of this place")
    position: Vector
    heading_deg: HeadingDeg


class HypothesisOfPose(BaseModel):
    """A pose that the camera may have had."""

    confirmed: bool = Field(
        description="true only for the first hypothesis of a LOCALIZED answer, the answer's pose. "
        "false: do not use this hypothesis as a pose"
    )
    pose: Pose = Field(
        description="T_map_camera. Its covariance holds only if this hypothesis is right. "
        "The covariance is null for the other hypotheses of a LOCALIZED answer"
    )
    share: float = Field(
        description="share of the support of all hypotheses, 0 to 1. Without a track, LOCALIZED needs more than a half for "
        "the first hypothesis"
    )
    inliers: float = Field(description="share of the depth weight that lies on the map, 0 to 1")
    similarity: float = Field(description="cosine similarity of the query to the places around the pose")


class Spread(BaseModel):
    """Where the camera may be, over all hypotheses and the rest of the map.

    The spread is not a pose. Its mean usually lies between the hypotheses.

    Each hypothesis is weighted with the probability that it is right. The whole map has the rest of the probability.
    The covariance is the covariance of this mixture (law of total covariance).
    Hypotheses that are metres apart give metres. A single hypothesis that is probably wrong gives the size of the map.
    For an OUT_OF_MAP answer, the camera may also be outside the map. No covariance can express that.
    """

    mean: Vector = Field(description="mean position, map frame, metres. The mean is not a camera position")
    covariance: list[float] = Field(description="covariance of the position, 3x3, row by row, in map axes, m^2")
    heading_std_deg: float = Field(
        description="circular standard deviation of the heading. 103.9 if the heading is unknown"
    )
    hypotheses_weight: float = Field(description="probability that one of the hypotheses is right, 0 to 1")


class Reason(BaseModel):
    """What may be wrong with the query or the map.

    The service derives the reason from the confidence features. A reason is a place to look, not a finding.
    """

    check: str = Field(
        description="what to check: intrinsics, depth unit, field of view or depth range, baseline, traffic in the map, "
        "calibration or depth. depth: too few pixels have a depth"
    )
    evidence: dict[str, FiniteFloat] = Field(
        description="confidence features outside the range of the calibration data: "
        "name, and distance from the mean of the calibration data in standard deviations"
    )
    remedy: str = Field(description="what to do")


class CameraHeight(BaseModel):
    """Height of the camera above the ground that the service used."""

    height_m: float = Field(description="height of the camera's centre above the ground, metres")
    origin: Literal["given", "estimated", "assumed"] = Field(
        description="given: by the request. estimated: from the ground in the depth image. assumed: the depth image shows no "
        "ground, so the service takes the usual height of 1.5 m; send camera.height_m if the camera has another height"
    )


class MapVersion(BaseModel):
    """A map and its version, for example the map that answered."""

    name: str
    version: str = Field(description="hash of the map's content")


class TimingsMs(BaseModel):
    """Duration of each stage, milliseconds. register is 0 without registration."""

    decode: float
    fuse: float
    encode: float
    search: float
    register_: float = Field(alias="register")
    total: float


class AcceptanceThreshold(BaseModel):
    """The threshold that decided whether an answer is LOCALIZED."""

    confidence: float = Field(ge=0, le=1, description="least confidence of a LOCALIZED answer")
    false_accept_rate: float = Field(
        gt=0,
        lt=1,
        description="upper bound (95 %, Clopper and Pearson) of the share of out-of-map queries that reach this confidence, "
        "from the calibration data, or from a recording of this rig (rig_correction). It may be lower than the requested rate: calibration "
        "measured some rates only. It may be higher if the request named no rate, and the recording does not support the service's. It "
        "holds for a query without a track",
    )


class Mode(BaseModel):
    """A pose that a moving robot may have, after all its frames."""

    pose: Pose = Field(description="T_map_camera. Its covariance holds only if this mode is right")
    weight: float = Field(
        ge=0, le=1, description="probability that the position is within 1 m. An unseen mode may have drifted farther"
    )
    number: int = Field(
        ge=0, description="identity of the mode within its track. Odometry moves a mode and keeps its number"
    )
    unseen: int = Field(ge=0, description="number of frames since the last one that agreed with the mode")


class Belief(BaseModel):
    """Where a moving robot may be, after all frames of its track. The weights of all modes, elsewhere and outside sum to 1."""

    epoch: int = Field(
        ge=0,
        description="number of disruptions so far. It rises when a LOCALIZED answer does not continue the last one by odometry: "
        "after a displacement, a wrong answer, or a long way without images. It also rises when a track with a pose begins again. "
        "Then the transform from odometry to the map jumps",
    )
    modes: list[Mode] = Field(description="the most probable first, at most 8. None of them is confirmed")
    elsewhere: float = Field(ge=0, le=1, description="probability of all other places of the map")
    outside: float = Field(ge=0, le=1, description="probability of a place outside the map")
    token: str | None = Field(
        description="send it as track.belief with the next image pair. Null in a gRPC stream, which keeps the track itself"
    )


class LocalizeAnswer(BaseModel):
    """Answer to a query. Only a LOCALIZED answer has a pose, a vehicle pose, a geopose and a street.

    In any other answer, `hypotheses` and `spread` say where the camera may be. None of that is confirmed.
    """

    status: Literal["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"] = Field(
        description="LOCALIZED: act on the pose. AMBIGUOUS: the camera is in the map, but its pose is uncertain. "
        "OUT_OF_MAP: the map does not show what the images show. The status is always LOCALIZED if confidence is null"
    )
    confidence: float | None = Field(
        description="probability that the position of the first hypothesis is within 1 m. "
        "Null if the map has no cloud or no calibration, or if options.refine is false"
    )
    street: Street | None = Field(
        description="null unless LOCALIZED. Also null if the map has no streets, or if the position lies in none"
    )
    pose: Pose | None = Field(description="T_map_camera. Null unless LOCALIZED")
    vehicle_pose: Pose | None = Field(
        description="T_map_vehicle, if the request has T_vehicle_camera. Null unless LOCALIZED"
    )
    geopose: GeoPose | None = Field(
        description="pose of the vehicle if the request has T_vehicle_camera, else of the camera. "
        "Null unless LOCALIZED. Also null if the map is not georeferenced"
    )
    hypotheses: list[HypothesisOfPose] = Field(
        description="distinct registered poses, the best supported first. Unconfirmed unless LOCALIZED. "
        "Empty without registration"
    )
    spread: Spread | None = Field(description="where the camera may be. Null for a LOCALIZED answer")
    reasons: list[Reason] = Field(
        default_factory=list,  # an earlier service sends none
        description="why the answer may not be LOCALIZED, the likeliest reason first. Empty for a LOCALIZED answer. "
        "Empty in any other answer: all confidence features lie in the range of the calibration data. "
        "The place may then be outside the map, or be a perceptual alias",
    )
    neighbours: list[Neighbour] = Field(
        description="k distinct places. The places nearest to the registered poses come first, "
        "with those of the best supported pose before all others. The most similar places follow. "
        "Without registration, only similarity orders them"
    )
    camera_height: CameraHeight | None = Field(
        None,  # an earlier service sends none
        description="height of the camera above the ground, in an answer of any status. In a sequence, that of the first frame",
    )
    calibration: Literal["in_range", "extrapolated"] | None = Field(
        None,  # an earlier service sends none
        description="in_range: calibration data like this query support the confidence. extrapolated: at least one confidence "
        "feature lies outside the range of the calibration data, so the confidence may be wrong. Null if confidence is null, or "
        "if nothing was registered",
    )
    extrapolated: dict[str, FiniteFloat] = Field(
        default_factory=dict,  # an earlier service sends none
        description="the confidence features outside that range: name, and distance from the mean of the calibration data in "
        "standard deviations. Empty unless calibration is extrapolated",
    )
    threshold: AcceptanceThreshold | None = Field(
        None,  # an earlier service sends none
        description="the threshold that decided the status. Null if confidence is null",
    )
    rig_correction: str | None = Field(
        None,  # an earlier service sends none
        description="name of the correction for a rig that the confidence has. Null if the map has none for the rig of this query, or "
        "if confidence is null",
    )
    belief: Belief | None = Field(
        None,  # an earlier service sends none
        description="where the robot may be, after all frames of its track. Null without a track, and if the map has no calibration",
    )
    map: MapVersion
    timings_ms: TimingsMs

    @model_validator(mode="after")
    def _no_pose_unless_localized(self) -> Self:
        """Refuse an inconsistent answer, whether it is created or parsed."""
        localized = self.status == "LOCALIZED"
        if localized != (self.pose is not None) or localized != (self.spread is None):
            raise ValueError("A LOCALIZED answer needs a pose and no spread. Other answers need a spread and no pose.")
        if not localized and (self.vehicle_pose, self.geopose, self.street) != (None, None, None):
            raise ValueError("Only a LOCALIZED answer may have vehicle_pose, geopose or street.")
        if localized and self.reasons:
            raise ValueError("A LOCALIZED answer must have no reasons.")
        if (self.calibration == "extrapolated") != bool(self.extrapolated):
            raise ValueError("extrapolated lists features if calibration is extrapolated, and only then.")
        if any(each.confirmed != (localized and number == 0) for number, each in enumerate(self.hypotheses)):
            raise ValueError(
                "A LOCALIZED answer confirms its first hypothesis and no other. Other answers confirm none."
            )
        return self

    def require_pose(self) -> Pose:
        """Return the camera pose, ``T_map_camera``.

        Raises:
            NotLocalizedError: the answer is not LOCALIZED; the error carries the answer.
        """
        if self.pose is None:
            raise self._not_localized()
        return self.pose

    def require_vehicle_pose(self) -> Pose:
        """Return the vehicle pose, ``T_map_vehicle``.

        Raises:
            NotLocalizedError: the answer is not LOCALIZED; the error carries the answer.
            RequestError: the request did not have T_vehicle_camera.
        """
        if self.status != "LOCALIZED":
            raise self._not_localized()
        if self.vehicle_pose is None:
            raise RequestError(
                "vehicle_pose: missing, because the request had no T_vehicle_camera; send T_vehicle_camera",
                field="T_vehicle_camera",
            )
        return self.vehicle_pose

    def _not_localized(self) -> NotLocalizedError:
        return NotLocalizedError(
            f"the answer is {self.status} (confidence {self.confidence or 0:.3f}), so it has no pose; send a prior or more frames, "
            "or turn the camera (the hypotheses of the answer are not confirmed)",
            answer=self,
        )


class MapEntry(BaseModel):
    """A mounted map."""

    name: str
    version: str = Field(description="hash of the map's content")
    made_at: str = Field(description="time of the build, RFC 3339")
    places: int
    views: int
    streets: int
    spacing_m: float
    encoder_sha256: str
    georeferenced: bool
    licence: str
    versions: list[str] = Field(description="open versions, the newest first. A request may name one as name@version")
    tiles: int = Field(0, description="number of tiles of a tiled map; 0 for a map of one bundle")
    open_tiles: int = Field(
        0, description="tiles that the answering process has open. A query opens those that it needs"
    )


class ServeVersion(_Strict):
    """The version of a map that shall serve."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"version": "3f9c2a7be01d4586"}]})

    version: str = Field(max_length=64, description="hash of the map's content; one of the map's open versions")


class MapList(BaseModel):
    """All mounted maps."""

    maps: list[MapEntry]


class Version(BaseModel):
    """The running service: its version, resources and maps."""

    version: str
    api: Literal["v1"] = "v1"
    threads: int = Field(description="number of requests that the service works on at once")
    cores: int = Field(
        description="number of cores that this process may use, by its affinity and the quota of its container"
    )
    pools: dict[str, int] = Field(
        description="threads of each native pool. Whole requests run in parallel, so each pool has one thread"
    )
    maps: list[MapVersion]


class Health(BaseModel):
    """Liveness or readiness of the service."""

    status: Literal["ok"] = "ok"


class RefusedBundle(BaseModel):
    """A map bundle in a maps folder that is not mounted."""

    bundle: str = Field(description="name of the folder")
    reason: str


class Readiness(BaseModel):
    """The service is ready. `refused` lists the map bundles that it could not mount."""

    status: Literal["ok"] = "ok"
    refused: list[RefusedBundle] = Field(
        description="map bundles that are not mounted, as this process found them. At most 20; the log lists all"
    )
    open_tiles: int = Field(
        0,
        description="tiles of tiled maps that this process has open; 0 without a tiled map. The first query in a closed tile is slower. "
        "The metric `streetfix_open_tiles` counts those of all workers",
    )
    cached_tiles: int = Field(
        0,
        description="tiles of maps in object storage that are in the cache on the disk, which all workers share; 0 without such a map",
    )


class Truth(_Strict):
    """Ground truth of an image pair, for people who compare an answer with it."""

    position: Position = Field(description="position of the camera, map frame")
    heading_deg: float | None = Field(
        None, ge=-360, le=360, description="heading of the optical axis, counter-clockwise from map x"
    )


class SamplePair(BaseModel):
    """A sample image pair, stored beside the maps, to try the service with."""

    name: str
    rgb: str = Field(description="address of the image, relative to the address of this list")
    depth: str = Field(description="address of the image, relative to the address of this list")
    request: LocalizeRequest
    truth: Truth | None = Field(description="ground truth, if known")


class SampleList(BaseModel):
    """All sample image pairs."""

    samples: list[SamplePair]


Base64 = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]


class QueryPointCloud(BaseModel):
    """Points of the query, placed by the best guess of the pose.

    The best guess is the answer's pose if the answer is LOCALIZED. Otherwise, the best guess is not confirmed.
    """

    origin: Vector = Field(description="map frame. The points are relative to this origin")
    count: int
    data: Base64 = Field(
        description="for each point x, y, z as little-endian float32 (metres), then red, green, blue and an unused byte"
    )


class Explanation(BaseModel):
    """An answer and its intermediate results as PNG images."""

    answer: LocalizeAnswer
    depth: Base64 = Field(
        description="depth image of the query without its estimated scale error. Turbo colours: near is red, far (40 m) is blue"
    )
    fused: Base64 = Field(description="query view on the view grid, with colour, and with range in place of intensity")
    view: Base64 | None = Field(
        description="map view from the most similar place, on the view grid. Null if the map has no cloud"
    )
    map_depth: Base64 | None = Field(
        description="depth image of the map, rendered for this camera at the best guess, coloured as `depth`. "
        "Null if the map has no cloud"
    )
    points: QueryPointCloud


class LastAnswer(BaseModel):
    """Figures of an answer that the service gave. They hold no image data."""

    number: int = Field(description="number of the answer since the process started")
    at: str = Field(description="time of the answer, UTC")
    map: MapVersion
    status: Literal["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"]
    confidence: float | None
    street: str | None = Field(description="name of the street. Null unless LOCALIZED")
    position: Vector | None = Field(description="position of the camera, map frame, metres. Null unless LOCALIZED")
    heading_deg: HeadingDeg | None = Field(description="heading of the camera. Null unless LOCALIZED")
    frames: int = Field(description="number of image pairs that the answer uses")
    total_ms: float


class LastAnswers(BaseModel):
    """The last answers of the process that took the request, the newest first."""

    answers: list[LastAnswer]
