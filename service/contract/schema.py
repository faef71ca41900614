"""The contract as REST says it in JSON and gRPC in messages: requests and answers. Degrees here, radians inside."""

import math
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationInfo, field_validator, model_validator

from service.errors import NotLocalizedError, RequestError
from service.localization.query import LEAST_FALSE_ACCEPT_RATE, MOST_NEIGHBOURS

#: Of a focal length, in widths or heights of the picture: 175 and 0.6 degrees of view. What is less or more was given in another unit
#: than pixels.
LEAST_FOCAL, MOST_FOCAL = 0.02, 100.0
#: Sides of a picture, pixels, and how many times longer than the other one of them may be: memory goes with the longer one.
LEAST_SIDE, MOST_SIDE, MOST_ASPECT = 2, 32768, 16
#: Components of a vector whose length does not matter: an accelerometer may count in m/s2, in thousandths of g or in its own steps.
MOST_COMPONENT = 1e6


class _Strict(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Vector(_Strict):
    """Three numbers."""

    x: float
    y: float
    z: float


class Direction(_Strict):
    """Three numbers of which only the direction counts."""

    x: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    y: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    z: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)


class Quaternion(_Strict):
    """A rotation; of any length but zero when sent, of length 1 when answered."""

    x: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    y: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    z: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)
    w: float = Field(ge=-MOST_COMPONENT, le=MOST_COMPONENT)


class Position(_Strict):
    """Metres; between parts of a robot, or places that it passed."""

    x: float = Field(ge=-1e5, le=1e5)
    y: float = Field(ge=-1e5, le=1e5)
    z: float = Field(ge=-1e5, le=1e5)


class RigidTransform(_Strict):
    """Takes coordinates of the second frame of its name to the first."""

    position: Position
    orientation: Quaternion


class Camera(_Strict):
    """Intrinsics of the rectified colour picture, pixels; the centre of the first pixel is (0, 0)."""

    model: Literal["PINHOLE"] = Field(
        "PINHOLE", description="what the pictures are after rectification; any other model is refused, not misread"
    )
    width: int = Field(ge=LEAST_SIDE, le=MOST_SIDE)
    height: int = Field(
        ge=LEAST_SIDE, le=MOST_SIDE, description=f"neither side is longer than {MOST_ASPECT} times the other"
    )
    fx: float = Field(
        ge=LEAST_FOCAL * LEAST_SIDE, le=MOST_FOCAL * MOST_SIDE,
        description=f"pixels, {LEAST_FOCAL} to {MOST_FOCAL:g} of the width",
    )  # fmt: skip
    fy: float = Field(
        ge=LEAST_FOCAL * LEAST_SIDE, le=MOST_FOCAL * MOST_SIDE,
        description=f"pixels, {LEAST_FOCAL} to {MOST_FOCAL:g} of the height",
    )  # fmt: skip
    cx: float = Field(ge=-2 * MOST_SIDE, le=2 * MOST_SIDE)
    cy: float = Field(ge=-2 * MOST_SIDE, le=2 * MOST_SIDE)
    distortion: list[Annotated[float, Field(ge=-1e3, le=1e3)]] = Field(
        default_factory=list,
        max_length=14,
        description="of the pictures as sent: empty or zero; others are refused, not misread: rectify first",
    )

    @field_validator("model", mode="before")
    @classmethod
    def _is_rectified(cls, model: object) -> object:
        if model != "PINHOLE":
            raise ValueError("only PINHOLE is read; rectify both pictures and send the rectified pictures' intrinsics")
        return model

    @field_validator("fx", "fy")
    @classmethod
    def _is_in_pixels(cls, focal: float, info: ValidationInfo) -> float:
        side = info.data.get("width" if info.field_name == "fx" else "height")  # None: refused itself
        if side is not None and not LEAST_FOCAL * side <= focal <= MOST_FOCAL * side:
            seen_deg = 2 * math.degrees(math.atan(0.5 * side / focal))
            raise ValueError(
                f"{focal:g} px for a side of {side} px would see {seen_deg:.3g} degrees; give it in pixels"
            )
        return focal

    @field_validator("height")
    @classmethod
    def _is_no_strip(cls, height: int, info: ValidationInfo) -> int:
        width = info.data.get("width")  # None: refused itself
        if width is not None and max(width, height) > MOST_ASPECT * min(width, height):
            raise ValueError(
                f"a picture of {width} x {height} px is a strip; no side may be more than {MOST_ASPECT} times the other"
            )
        return height


class Depth(_Strict):
    """How the depth picture is to be read."""

    scale_m: float | None = Field(
        None,
        ge=1e-6,
        le=1e4,
        description="metres for each stored unit (disparity: pixels); default 0.001 for integers, 1 for floats",
    )
    kind: Literal["z", "range", "disparity"] = Field(
        "z", description="along the optical axis, along the ray, or disparity"
    )
    encoding: Literal["auto", "carla", "compressed_depth"] = Field(
        "auto",
        description="carla: depth in the 24 bits of a colour PNG; compressed_depth: data of a ROS compressedDepth message, PNG or RVL",
    )
    max_range_m: float | None = Field(None, ge=0.01, le=1e5, description="what lies beyond is no measurement")
    baseline_m: float | None = Field(
        None, ge=1e-3, le=100, description="of the stereo rig; needed for disparity; the rig's disparity offset is then estimated too"
    )  # fmt: skip


class PriorPosition(_Strict):
    """Where the camera is believed to be, in the map frame, metres."""

    x: float = Field(ge=-1e7, le=1e7)
    y: float = Field(ge=-1e7, le=1e7)
    std_m: float = Field(20.0, ge=1e-3, le=1e6, description="standard deviation of each coordinate")


class PriorWgs84(_Strict):
    """Where the camera is believed to be on the Earth; only where the map is georeferenced."""

    latitude_deg: float = Field(ge=-90, le=90)
    longitude_deg: float = Field(ge=-180, le=180)
    std_m: float = Field(20.0, ge=1e-3, le=1e6, description="standard deviation of each horizontal coordinate")


class Prior(_Strict):
    """What is known of the camera's pose beforehand. It narrows the search; the pictures may still contradict it."""

    position: PriorPosition | None = None
    wgs84: PriorWgs84 | None = None
    heading_deg: float | None = Field(
        None, ge=-360, le=360, description="of the optical axis, counter-clockwise from map x"
    )
    heading_std_deg: float = Field(20.0, ge=1e-3, le=360)


class Options(_Strict):
    """What to answer."""

    neighbours: int = Field(5, ge=1, le=MOST_NEIGHBOURS, description="k: distinct places that vote and are answered")
    refine: bool = Field(
        True,
        description="register the depth picture on the map's cloud; false: the pose of retrieval alone, covariance and confidence null",
    )
    false_accept_rate: float | None = Field(
        None, ge=LEAST_FALSE_ACCEPT_RATE, lt=1,
        description="share of the queries taken outside the map that one can live with being LOCALIZED; less than the map's calibration "
        "measured is refused; default: the service's setting",
    )  # fmt: skip


class LocalizeRequest(_Strict):
    """The JSON part of a request."""

    model_config = ConfigDict(
        title="LocalizeRequest",
        json_schema_extra={
            "examples": [
                {
                    "map": "paper-city",
                    "camera": {
                        "model": "PINHOLE",
                        "width": 640,
                        "height": 480,
                        "fx": 320,
                        "fy": 320,
                        "cx": 319.5,
                        "cy": 239.5,
                    },
                    "depth": {"scale_m": 0.001, "kind": "z", "max_range_m": 80},
                    "gravity": {"x": 0.01, "y": 0.999, "z": 0.02},
                    "prior": {"position": {"x": 12.0, "y": -40.0, "std_m": 20.0}, "heading_deg": 90.0},
                    "options": {"neighbours": 5},
                }
            ]
        },
    )

    map: str | None = Field(None, max_length=64, description="optional where one map is mounted")
    camera: Camera
    depth: Depth = Depth()
    gravity: Direction | None = Field(None, description="down in the camera frame, any length but zero, from an IMU")
    T_vehicle_camera: RigidTransform | None = Field(
        None, description="where the camera sits: the vehicle's pose is answered too"
    )
    prior: Prior | None = Field(None, description="a position, a heading, or both")
    options: Options = Options()


MOST_FRAMES = 16


class BatchRequest(_Strict):
    """The JSON part of a batch: request k goes with the parts rgbK and depthK."""

    requests: list[LocalizeRequest] = Field(min_length=1, max_length=MOST_FRAMES)


class SequenceFrame(_Strict):
    """A pair of pictures of a sequence: frame k goes with the parts rgbK and depthK."""

    camera: Camera
    depth: Depth = Depth()
    gravity: Direction | None = Field(None, description="down in the camera frame, any length but zero, from an IMU")
    T_reference_camera: RigidTransform | None = Field(
        None, description="where this camera stood against the first frame's; null in the first frame"
    )


class SequenceRequest(_Strict):
    """The JSON part of a sequence: frames of a drive, or the cameras of a rig at one instant; the first one's pose is answered."""

    map: str | None = Field(None, max_length=64, description="optional where one map is mounted")
    frames: list[SequenceFrame] = Field(min_length=1, max_length=MOST_FRAMES)
    T_vehicle_camera: RigidTransform | None = Field(None, description="where the first frame's camera sits")
    prior: Prior | None = Field(None, description="of the first frame's camera")
    options: Options = Options()


class Street(BaseModel):
    """The street under the registered position; without registration that of the heaviest cluster of similar places."""

    id: str
    name: str = Field(examples=["End of street 4"])
    street: str = Field(examples=["4"])
    section: Literal["beginning", "end"] | None
    class_index: int = Field(description="0 to 15 in the paper's city")
    vote: float = Field(description="this street's share of the nearest places' similarity-weighted votes, 0 to 1")


HeadingDeg = Annotated[
    float,
    Field(gt=-180, le=180, description="of the optical axis (or of the vehicle's x), counter-clockwise from map x"),
]


class Pose(BaseModel):
    """In the map frame: metres; the camera frame is x right, y down, z forward."""

    position: Vector
    orientation: Quaternion
    heading_deg: HeadingDeg
    covariance: list[float] | None = Field(
        description="6x6, row by row, translation first, map axes, about this frame's origin; null: not known without registration"
    )


class GeoPosition(BaseModel):
    """On the WGS-84 ellipsoid, as OGC GeoPose spells it."""

    lat: float = Field(description="degrees")
    lon: float = Field(description="degrees")
    h: float = Field(description="metres above the ellipsoid")


class GeoPose(BaseModel):
    """OGC GeoPose 1.0, Basic-Quaternion: from east, north, up at the position to the axes of what is posed.

    That is the vehicle (x forward, y left, z up) where T_vehicle_camera was sent, else the camera (x right, y down, z forward).
    """

    position: GeoPosition
    quaternion: Quaternion


class Neighbour(BaseModel):
    """One of the most similar places of the map."""

    place: int
    distance: float = Field(description="Euclidean distance of the descriptors, 0 to 2")
    similarity: float = Field(description="cosine of the descriptors")
    street: str | None = Field(description="id of the street it lies in")
    position: Vector
    heading_deg: HeadingDeg


class HypothesisOfPose(BaseModel):
    """A place where the pictures may have been taken."""

    confirmed: bool = Field(
        description="true for the first hypothesis of a LOCALIZED answer alone: it is the answer's pose. false: do not use it as a pose"
    )
    pose: Pose = Field(
        description="T_map_camera; its covariance holds only if this hypothesis is right, and is null for the others of a LOCALIZED answer"
    )
    share: float = Field(
        description="of the support of all hypotheses, 0 to 1; LOCALIZED needs more than a half for the first"
    )
    inliers: float = Field(description="share of the depth's weight that lies on the map, 0 to 1")
    similarity: float = Field(description="of the pictures to the places around, cosine")


class Spread(BaseModel):
    """Where the camera may be, over all hypotheses and the rest of the map. It is not a pose: its mean is usually between the hypotheses.

    Each hypothesis counts with the probability that it is right, the whole map with the rest. The covariance is that of the mixture
    (law of total covariance): hypotheses that are metres apart give metres, and a single hypothesis that is probably wrong gives the
    size of the map. Of an OUT_OF_MAP answer the camera may be outside the map as well, which no covariance can say.
    """

    mean: Vector = Field(description="metres, map frame; not a position of the camera")
    covariance: list[float] = Field(description="3x3, row by row, of the position, map axes, m^2")
    heading_std_deg: float = Field(
        description="circular standard deviation of the heading; 103.9 where nothing is known of it"
    )
    hypotheses_weight: float = Field(description="probability that one of the hypotheses is right, 0 to 1")


class Reason(BaseModel):
    """What may be wrong with the question or the map. It is read off the evidence, so it is a place to look, not a finding."""

    check: str = Field(
        description="intrinsics, depth unit, field of view or depth range, baseline, traffic in the map, calibration; depth: too few "
        "pixels have one"
    )
    evidence: dict[str, FiniteFloat] = Field(
        description="evidence out of the range that calibration saw: name, and distance from calibration's mean in standard deviations"
    )
    remedy: str = Field(description="what to do")


class MapVersion(BaseModel):
    """Which map answered."""

    name: str
    version: str = Field(description="hash of the map's content")


class TimingsMs(BaseModel):
    """Milliseconds of each stage; register is 0 where nothing was registered."""

    decode: float
    fuse: float
    encode: float
    search: float
    register_: float = Field(alias="register")
    total: float


class LocalizeAnswer(BaseModel):
    """Where the pictures were taken. Only a LOCALIZED answer has a pose, a vehicle's pose, a geopose and a street.

    An answer that is not LOCALIZED says in `hypotheses` and `spread` where the camera may be. None of that is confirmed.
    """

    status: Literal["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"] = Field(
        description="LOCALIZED: act on it; AMBIGUOUS: in the map, but not sure where; OUT_OF_MAP: the map does not show what "
        "the pictures do. Always LOCALIZED where confidence is null"
    )
    confidence: float | None = Field(
        description="probability that the position of the first hypothesis is within 1 m; null: not calibrated, or nothing was to be "
        "registered"
    )
    street: Street | None = Field(
        description="null unless LOCALIZED, and where the map has no streets or the position lies in none"
    )
    pose: Pose | None = Field(description="T_map_camera; null unless LOCALIZED")
    vehicle_pose: Pose | None = Field(
        description="T_map_vehicle, where T_vehicle_camera was sent; null unless LOCALIZED"
    )
    geopose: GeoPose | None = Field(
        description="the vehicle's where T_vehicle_camera was sent, else the camera's; null unless LOCALIZED, and where the map is not "
        "georeferenced"
    )
    hypotheses: list[HypothesisOfPose] = Field(
        description="distinct poses that were registered, the best supported first; unconfirmed unless LOCALIZED; empty without "
        "registration"
    )
    spread: Spread | None = Field(description="where the camera may be; null for a LOCALIZED answer")
    reasons: list[Reason] = Field(
        default_factory=list,  # an earlier service sends none
        description="why it may not be LOCALIZED, the likeliest first; empty for a LOCALIZED answer. Empty in another answer: all "
        "evidence lies in the range that calibration saw, so the place may be outside the map, or look like another",
    )
    neighbours: list[Neighbour] = Field(
        description="k distinct places: those nearest to the registered poses first, the best supported pose's before all, then the most "
        "similar ones; by similarity alone without registration"
    )
    map: MapVersion
    timings_ms: TimingsMs

    @model_validator(mode="after")
    def _no_pose_unless_localized(self) -> Self:
        """No answer of another kind can be made or read, whatever made it."""
        localized = self.status == "LOCALIZED"
        if localized != (self.pose is not None) or localized != (self.spread is None):
            raise ValueError("a LOCALIZED answer has a pose and no spread, every other one a spread and no pose")
        if not localized and (self.vehicle_pose, self.geopose, self.street) != (None, None, None):
            raise ValueError("an answer that is not LOCALIZED has no vehicle_pose, geopose or street")
        if localized and self.reasons:
            raise ValueError("a LOCALIZED answer has no reasons for not being LOCALIZED")
        if any(each.confirmed != (localized and number == 0) for number, each in enumerate(self.hypotheses)):
            raise ValueError("only the first hypothesis of a LOCALIZED answer is confirmed")
        return self

    def require_pose(self) -> Pose:
        """The camera's pose.

        Raises:
            NotLocalizedError: the answer is not LOCALIZED; the error carries the answer.
        """
        if self.pose is None:
            raise self._not_localized()
        return self.pose

    def require_vehicle_pose(self) -> Pose:
        """The vehicle's pose.

        Raises:
            NotLocalizedError: the answer is not LOCALIZED; the error carries the answer.
            RequestError: T_vehicle_camera was not sent.
        """
        if self.status != "LOCALIZED":
            raise self._not_localized()
        if self.vehicle_pose is None:
            raise RequestError(
                "vehicle_pose: the request did not say where the camera sits; send T_vehicle_camera", field="T_vehicle_camera"
            )  # fmt: skip
        return self.vehicle_pose

    def _not_localized(self) -> NotLocalizedError:
        return NotLocalizedError(
            f"the answer is {self.status} (confidence {self.confidence or 0:.3f}), so it has no pose; look at its hypotheses, which "
            "are not confirmed, send a prior or more frames, or look another way", answer=self,
        )  # fmt: skip


class MapEntry(BaseModel):
    """A mounted map."""

    name: str
    version: str
    made_at: str
    places: int
    views: int
    streets: int
    spacing_m: float
    encoder_sha256: str
    georeferenced: bool
    licence: str
    versions: list[str] = Field(description="open ones, the newest first; a request may name one as name@version")


class ServeVersion(_Strict):
    """Which version of a map is to serve."""

    version: str = Field(max_length=64)


class MapList(BaseModel):
    """All mounted maps."""

    maps: list[MapEntry]


class Version(BaseModel):
    """What runs here."""

    version: str
    api: Literal["v1"] = "v1"
    threads: int = Field(description="requests worked on at once")
    cores: int = Field(description="that this process may use, by affinity and by its container's quota")
    pools: dict[str, int] = Field(
        description="threads of each native pool: whole requests run side by side, so one each"
    )
    maps: list[MapVersion]


class Health(BaseModel):
    """Whether the service lives, or is ready."""

    status: Literal["ok"] = "ok"


class RefusedBundle(BaseModel):
    """A bundle in a maps folder that is not mounted."""

    bundle: str = Field(description="the folder's name")
    reason: str


class Readiness(BaseModel):
    """The service is ready; what it could not mount all the same."""

    status: Literal["ok"] = "ok"
    refused: list[RefusedBundle] = Field(
        description="bundles that are not mounted, as this process found them; at most 20, the log has all"
    )


class Truth(_Strict):
    """Where a pair of pictures was really taken: for people who compare."""

    position: Position = Field(description="of the camera, map frame")
    heading_deg: float | None = Field(
        None, ge=-360, le=360, description="of the optical axis, counter-clockwise from map x"
    )


class SamplePair(BaseModel):
    """A pair of pictures that lies beside the maps, to try the service with."""

    name: str
    rgb: str = Field(description="address of the picture, relative to this list's")
    depth: str = Field(description="address of the picture, relative to this list's")
    request: LocalizeRequest
    truth: Truth | None


class SampleList(BaseModel):
    """All sample pairs."""

    samples: list[SamplePair]


Base64 = Annotated[str, Field(json_schema_extra={"contentEncoding": "base64"})]


class QueryPointCloud(BaseModel):
    """The query's points where the best guess puts them: the answer's pose if it is LOCALIZED, else it is not confirmed."""

    origin: Vector = Field(description="map frame; the points count from it")
    count: int
    data: Base64 = Field(
        description="of each point x, y, z as little-endian float32 (metres), then red, green, blue and an unused byte"
    )


class Explanation(BaseModel):
    """An answer and what the machine saw on the way to it, as PNG."""

    answer: LocalizeAnswer
    depth: Base64 = Field(
        description="the query's depth, its estimated scale error taken out; Turbo colours, near red, far (40 m) blue"
    )
    fused: Base64 = Field(description="the query on the view grid: range in the place of intensity, colour kept")
    view: Base64 | None = Field(
        description="the map from the most similar place, on the view grid; null without a cloud"
    )
    map_depth: Base64 | None = Field(
        description="the map as this camera would see it from the best guess, coloured as `depth`; null without a cloud"
    )
    points: QueryPointCloud


class LastAnswer(BaseModel):
    """An answer that the service gave; nothing of its pictures."""

    number: int = Field(description="counted since the process started")
    at: str = Field(description="when, UTC")
    map: MapVersion
    status: Literal["LOCALIZED", "AMBIGUOUS", "OUT_OF_MAP"]
    confidence: float | None
    street: str | None = Field(description="name of the street; null unless LOCALIZED")
    position: Vector | None = Field(description="null unless LOCALIZED")
    heading_deg: HeadingDeg | None = Field(description="null unless LOCALIZED")
    frames: int = Field(description="picture pairs that it rests on")
    total_ms: float


class LastAnswers(BaseModel):
    """The last answers of the process that was asked, the newest first."""

    answers: list[LastAnswer]
