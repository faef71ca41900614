from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class CameraModel(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CAMERA_MODEL_UNSPECIFIED: _ClassVar[CameraModel]
    CAMERA_MODEL_PINHOLE: _ClassVar[CameraModel]

class DistortionModel(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DISTORTION_MODEL_UNSPECIFIED: _ClassVar[DistortionModel]
    DISTORTION_MODEL_BROWN_CONRADY: _ClassVar[DistortionModel]
    DISTORTION_MODEL_KANNALA_BRANDT: _ClassVar[DistortionModel]

class DepthKind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_KIND_UNSPECIFIED: _ClassVar[DepthKind]
    DEPTH_KIND_Z: _ClassVar[DepthKind]
    DEPTH_KIND_RANGE: _ClassVar[DepthKind]
    DEPTH_KIND_DISPARITY: _ClassVar[DepthKind]

class DepthEncoding(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DEPTH_ENCODING_UNSPECIFIED: _ClassVar[DepthEncoding]
    DEPTH_ENCODING_CARLA: _ClassVar[DepthEncoding]
    DEPTH_ENCODING_COMPRESSED_DEPTH: _ClassVar[DepthEncoding]

class CalibrationRange(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CALIBRATION_RANGE_UNSPECIFIED: _ClassVar[CalibrationRange]
    CALIBRATION_RANGE_IN_RANGE: _ClassVar[CalibrationRange]
    CALIBRATION_RANGE_EXTRAPOLATED: _ClassVar[CalibrationRange]

class CameraHeightOrigin(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    CAMERA_HEIGHT_ORIGIN_UNSPECIFIED: _ClassVar[CameraHeightOrigin]
    CAMERA_HEIGHT_ORIGIN_GIVEN: _ClassVar[CameraHeightOrigin]
    CAMERA_HEIGHT_ORIGIN_ESTIMATED: _ClassVar[CameraHeightOrigin]
    CAMERA_HEIGHT_ORIGIN_ASSUMED: _ClassVar[CameraHeightOrigin]

class LocalizationStatus(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    LOCALIZATION_STATUS_UNSPECIFIED: _ClassVar[LocalizationStatus]
    LOCALIZATION_STATUS_LOCALIZED: _ClassVar[LocalizationStatus]
    LOCALIZATION_STATUS_AMBIGUOUS: _ClassVar[LocalizationStatus]
    LOCALIZATION_STATUS_OUT_OF_MAP: _ClassVar[LocalizationStatus]

class StreetSection(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    STREET_SECTION_UNSPECIFIED: _ClassVar[StreetSection]
    STREET_SECTION_BEGINNING: _ClassVar[StreetSection]
    STREET_SECTION_END: _ClassVar[StreetSection]
CAMERA_MODEL_UNSPECIFIED: CameraModel
CAMERA_MODEL_PINHOLE: CameraModel
DISTORTION_MODEL_UNSPECIFIED: DistortionModel
DISTORTION_MODEL_BROWN_CONRADY: DistortionModel
DISTORTION_MODEL_KANNALA_BRANDT: DistortionModel
DEPTH_KIND_UNSPECIFIED: DepthKind
DEPTH_KIND_Z: DepthKind
DEPTH_KIND_RANGE: DepthKind
DEPTH_KIND_DISPARITY: DepthKind
DEPTH_ENCODING_UNSPECIFIED: DepthEncoding
DEPTH_ENCODING_CARLA: DepthEncoding
DEPTH_ENCODING_COMPRESSED_DEPTH: DepthEncoding
CALIBRATION_RANGE_UNSPECIFIED: CalibrationRange
CALIBRATION_RANGE_IN_RANGE: CalibrationRange
CALIBRATION_RANGE_EXTRAPOLATED: CalibrationRange
CAMERA_HEIGHT_ORIGIN_UNSPECIFIED: CameraHeightOrigin
CAMERA_HEIGHT_ORIGIN_GIVEN: CameraHeightOrigin
CAMERA_HEIGHT_ORIGIN_ESTIMATED: CameraHeightOrigin
CAMERA_HEIGHT_ORIGIN_ASSUMED: CameraHeightOrigin
LOCALIZATION_STATUS_UNSPECIFIED: LocalizationStatus
LOCALIZATION_STATUS_LOCALIZED: LocalizationStatus
LOCALIZATION_STATUS_AMBIGUOUS: LocalizationStatus
LOCALIZATION_STATUS_OUT_OF_MAP: LocalizationStatus
STREET_SECTION_UNSPECIFIED: StreetSection
STREET_SECTION_BEGINNING: StreetSection
STREET_SECTION_END: StreetSection

class LocalizeRequest(_message.Message):
    __slots__ = ("map", "rgb", "depth", "camera", "depth_format", "gravity", "vehicle_from_camera", "options", "prior", "vehicle_base_on_ground", "track")
    MAP_FIELD_NUMBER: _ClassVar[int]
    RGB_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FORMAT_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    PRIOR_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_BASE_ON_GROUND_FIELD_NUMBER: _ClassVar[int]
    TRACK_FIELD_NUMBER: _ClassVar[int]
    map: str
    rgb: bytes
    depth: bytes
    camera: Camera
    depth_format: DepthFormat
    gravity: Vector3
    vehicle_from_camera: RigidTransform
    options: Options
    prior: Prior
    vehicle_base_on_ground: bool
    track: Track
    def __init__(self, map: _Optional[str] = ..., rgb: _Optional[bytes] = ..., depth: _Optional[bytes] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ..., depth_format: _Optional[_Union[DepthFormat, _Mapping]] = ..., gravity: _Optional[_Union[Vector3, _Mapping]] = ..., vehicle_from_camera: _Optional[_Union[RigidTransform, _Mapping]] = ..., options: _Optional[_Union[Options, _Mapping]] = ..., prior: _Optional[_Union[Prior, _Mapping]] = ..., vehicle_base_on_ground: _Optional[bool] = ..., track: _Optional[_Union[Track, _Mapping]] = ...) -> None: ...

class Track(_message.Message):
    __slots__ = ("belief", "previous_from_camera", "odometry_std")
    BELIEF_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    ODOMETRY_STD_FIELD_NUMBER: _ClassVar[int]
    belief: str
    previous_from_camera: RigidTransform
    odometry_std: OdometryStd
    def __init__(self, belief: _Optional[str] = ..., previous_from_camera: _Optional[_Union[RigidTransform, _Mapping]] = ..., odometry_std: _Optional[_Union[OdometryStd, _Mapping]] = ...) -> None: ...

class OdometryStd(_message.Message):
    __slots__ = ("position_m", "angle_deg")
    POSITION_M_FIELD_NUMBER: _ClassVar[int]
    ANGLE_DEG_FIELD_NUMBER: _ClassVar[int]
    position_m: float
    angle_deg: float
    def __init__(self, position_m: _Optional[float] = ..., angle_deg: _Optional[float] = ...) -> None: ...

class LocalizeBatchRequest(_message.Message):
    __slots__ = ("requests",)
    REQUESTS_FIELD_NUMBER: _ClassVar[int]
    requests: _containers.RepeatedCompositeFieldContainer[LocalizeRequest]
    def __init__(self, requests: _Optional[_Iterable[_Union[LocalizeRequest, _Mapping]]] = ...) -> None: ...

class LocalizeBatchResponse(_message.Message):
    __slots__ = ("outcomes",)
    OUTCOMES_FIELD_NUMBER: _ClassVar[int]
    outcomes: _containers.RepeatedCompositeFieldContainer[Outcome]
    def __init__(self, outcomes: _Optional[_Iterable[_Union[Outcome, _Mapping]]] = ...) -> None: ...

class Outcome(_message.Message):
    __slots__ = ("answer", "problem")
    ANSWER_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    answer: LocalizeResponse
    problem: Problem
    def __init__(self, answer: _Optional[_Union[LocalizeResponse, _Mapping]] = ..., problem: _Optional[_Union[Problem, _Mapping]] = ...) -> None: ...

class Problem(_message.Message):
    __slots__ = ("code", "title", "detail", "field")
    CODE_FIELD_NUMBER: _ClassVar[int]
    TITLE_FIELD_NUMBER: _ClassVar[int]
    DETAIL_FIELD_NUMBER: _ClassVar[int]
    FIELD_FIELD_NUMBER: _ClassVar[int]
    code: str
    title: str
    detail: str
    field: str
    def __init__(self, code: _Optional[str] = ..., title: _Optional[str] = ..., detail: _Optional[str] = ..., field: _Optional[str] = ...) -> None: ...

class LocalizeSequenceRequest(_message.Message):
    __slots__ = ("map", "frames", "vehicle_from_camera", "prior", "options", "vehicle_base_on_ground", "track")
    MAP_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    PRIOR_FIELD_NUMBER: _ClassVar[int]
    OPTIONS_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_BASE_ON_GROUND_FIELD_NUMBER: _ClassVar[int]
    TRACK_FIELD_NUMBER: _ClassVar[int]
    map: str
    frames: _containers.RepeatedCompositeFieldContainer[SequenceFrame]
    vehicle_from_camera: RigidTransform
    prior: Prior
    options: Options
    vehicle_base_on_ground: bool
    track: Track
    def __init__(self, map: _Optional[str] = ..., frames: _Optional[_Iterable[_Union[SequenceFrame, _Mapping]]] = ..., vehicle_from_camera: _Optional[_Union[RigidTransform, _Mapping]] = ..., prior: _Optional[_Union[Prior, _Mapping]] = ..., options: _Optional[_Union[Options, _Mapping]] = ..., vehicle_base_on_ground: _Optional[bool] = ..., track: _Optional[_Union[Track, _Mapping]] = ...) -> None: ...

class SequenceFrame(_message.Message):
    __slots__ = ("rgb", "depth", "camera", "depth_format", "gravity", "reference_from_camera")
    RGB_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FIELD_NUMBER: _ClassVar[int]
    CAMERA_FIELD_NUMBER: _ClassVar[int]
    DEPTH_FORMAT_FIELD_NUMBER: _ClassVar[int]
    GRAVITY_FIELD_NUMBER: _ClassVar[int]
    REFERENCE_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    rgb: bytes
    depth: bytes
    camera: Camera
    depth_format: DepthFormat
    gravity: Vector3
    reference_from_camera: RigidTransform
    def __init__(self, rgb: _Optional[bytes] = ..., depth: _Optional[bytes] = ..., camera: _Optional[_Union[Camera, _Mapping]] = ..., depth_format: _Optional[_Union[DepthFormat, _Mapping]] = ..., gravity: _Optional[_Union[Vector3, _Mapping]] = ..., reference_from_camera: _Optional[_Union[RigidTransform, _Mapping]] = ...) -> None: ...

class LocalizeSequenceResponse(_message.Message):
    __slots__ = ("answer",)
    ANSWER_FIELD_NUMBER: _ClassVar[int]
    answer: LocalizeResponse
    def __init__(self, answer: _Optional[_Union[LocalizeResponse, _Mapping]] = ...) -> None: ...

class LocalizeStreamRequest(_message.Message):
    __slots__ = ("frame", "previous_from_camera", "odometry_std")
    FRAME_FIELD_NUMBER: _ClassVar[int]
    PREVIOUS_FROM_CAMERA_FIELD_NUMBER: _ClassVar[int]
    ODOMETRY_STD_FIELD_NUMBER: _ClassVar[int]
    frame: LocalizeRequest
    previous_from_camera: RigidTransform
    odometry_std: OdometryStd
    def __init__(self, frame: _Optional[_Union[LocalizeRequest, _Mapping]] = ..., previous_from_camera: _Optional[_Union[RigidTransform, _Mapping]] = ..., odometry_std: _Optional[_Union[OdometryStd, _Mapping]] = ...) -> None: ...

class LocalizeStreamResponse(_message.Message):
    __slots__ = ("outcome", "frames")
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    outcome: Outcome
    frames: int
    def __init__(self, outcome: _Optional[_Union[Outcome, _Mapping]] = ..., frames: _Optional[int] = ...) -> None: ...

class ListMapsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListMapsResponse(_message.Message):
    __slots__ = ("maps",)
    MAPS_FIELD_NUMBER: _ClassVar[int]
    maps: _containers.RepeatedCompositeFieldContainer[MapEntry]
    def __init__(self, maps: _Optional[_Iterable[_Union[MapEntry, _Mapping]]] = ...) -> None: ...

class MapEntry(_message.Message):
    __slots__ = ("name", "version", "made_at", "places", "views", "streets", "spacing_m", "encoder_sha256", "georeferenced", "licence", "versions", "tiles", "open_tiles")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    MADE_AT_FIELD_NUMBER: _ClassVar[int]
    PLACES_FIELD_NUMBER: _ClassVar[int]
    VIEWS_FIELD_NUMBER: _ClassVar[int]
    STREETS_FIELD_NUMBER: _ClassVar[int]
    SPACING_M_FIELD_NUMBER: _ClassVar[int]
    ENCODER_SHA256_FIELD_NUMBER: _ClassVar[int]
    GEOREFERENCED_FIELD_NUMBER: _ClassVar[int]
    LICENCE_FIELD_NUMBER: _ClassVar[int]
    VERSIONS_FIELD_NUMBER: _ClassVar[int]
    TILES_FIELD_NUMBER: _ClassVar[int]
    OPEN_TILES_FIELD_NUMBER: _ClassVar[int]
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
    versions: _containers.RepeatedScalarFieldContainer[str]
    tiles: int
    open_tiles: int
    def __init__(self, name: _Optional[str] = ..., version: _Optional[str] = ..., made_at: _Optional[str] = ..., places: _Optional[int] = ..., views: _Optional[int] = ..., streets: _Optional[int] = ..., spacing_m: _Optional[float] = ..., encoder_sha256: _Optional[str] = ..., georeferenced: _Optional[bool] = ..., licence: _Optional[str] = ..., versions: _Optional[_Iterable[str]] = ..., tiles: _Optional[int] = ..., open_tiles: _Optional[int] = ...) -> None: ...

class GetStreetsRequest(_message.Message):
    __slots__ = ("map",)
    MAP_FIELD_NUMBER: _ClassVar[int]
    map: str
    def __init__(self, map: _Optional[str] = ...) -> None: ...

class GetStreetsResponse(_message.Message):
    __slots__ = ("geojson",)
    GEOJSON_FIELD_NUMBER: _ClassVar[int]
    geojson: bytes
    def __init__(self, geojson: _Optional[bytes] = ...) -> None: ...

class GetCoverageRequest(_message.Message):
    __slots__ = ("map",)
    MAP_FIELD_NUMBER: _ClassVar[int]
    map: str
    def __init__(self, map: _Optional[str] = ...) -> None: ...

class GetCoverageResponse(_message.Message):
    __slots__ = ("geojson",)
    GEOJSON_FIELD_NUMBER: _ClassVar[int]
    geojson: bytes
    def __init__(self, geojson: _Optional[bytes] = ...) -> None: ...

class Prior(_message.Message):
    __slots__ = ("position", "wgs84", "heading_deg", "heading_std_deg")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    WGS84_FIELD_NUMBER: _ClassVar[int]
    HEADING_DEG_FIELD_NUMBER: _ClassVar[int]
    HEADING_STD_DEG_FIELD_NUMBER: _ClassVar[int]
    position: PriorPosition
    wgs84: PriorWgs84
    heading_deg: float
    heading_std_deg: float
    def __init__(self, position: _Optional[_Union[PriorPosition, _Mapping]] = ..., wgs84: _Optional[_Union[PriorWgs84, _Mapping]] = ..., heading_deg: _Optional[float] = ..., heading_std_deg: _Optional[float] = ...) -> None: ...

class PriorPosition(_message.Message):
    __slots__ = ("x", "y", "std_m")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    STD_M_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    std_m: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., std_m: _Optional[float] = ...) -> None: ...

class PriorWgs84(_message.Message):
    __slots__ = ("latitude_deg", "longitude_deg", "std_m")
    LATITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    STD_M_FIELD_NUMBER: _ClassVar[int]
    latitude_deg: float
    longitude_deg: float
    std_m: float
    def __init__(self, latitude_deg: _Optional[float] = ..., longitude_deg: _Optional[float] = ..., std_m: _Optional[float] = ...) -> None: ...

class Camera(_message.Message):
    __slots__ = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion", "height_m", "height_std_m", "distortion_model")
    MODEL_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_FIELD_NUMBER: _ClassVar[int]
    FX_FIELD_NUMBER: _ClassVar[int]
    FY_FIELD_NUMBER: _ClassVar[int]
    CX_FIELD_NUMBER: _ClassVar[int]
    CY_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_M_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_STD_M_FIELD_NUMBER: _ClassVar[int]
    DISTORTION_MODEL_FIELD_NUMBER: _ClassVar[int]
    model: CameraModel
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: _containers.RepeatedScalarFieldContainer[float]
    height_m: float
    height_std_m: float
    distortion_model: DistortionModel
    def __init__(self, model: _Optional[_Union[CameraModel, str]] = ..., width: _Optional[int] = ..., height: _Optional[int] = ..., fx: _Optional[float] = ..., fy: _Optional[float] = ..., cx: _Optional[float] = ..., cy: _Optional[float] = ..., distortion: _Optional[_Iterable[float]] = ..., height_m: _Optional[float] = ..., height_std_m: _Optional[float] = ..., distortion_model: _Optional[_Union[DistortionModel, str]] = ...) -> None: ...

class DepthFormat(_message.Message):
    __slots__ = ("scale_m", "kind", "encoding", "max_range_m", "baseline_m")
    SCALE_M_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    MAX_RANGE_M_FIELD_NUMBER: _ClassVar[int]
    BASELINE_M_FIELD_NUMBER: _ClassVar[int]
    scale_m: float
    kind: DepthKind
    encoding: DepthEncoding
    max_range_m: float
    baseline_m: float
    def __init__(self, scale_m: _Optional[float] = ..., kind: _Optional[_Union[DepthKind, str]] = ..., encoding: _Optional[_Union[DepthEncoding, str]] = ..., max_range_m: _Optional[float] = ..., baseline_m: _Optional[float] = ...) -> None: ...

class Options(_message.Message):
    __slots__ = ("neighbours", "refine", "false_accept_rate")
    NEIGHBOURS_FIELD_NUMBER: _ClassVar[int]
    REFINE_FIELD_NUMBER: _ClassVar[int]
    FALSE_ACCEPT_RATE_FIELD_NUMBER: _ClassVar[int]
    neighbours: int
    refine: bool
    false_accept_rate: float
    def __init__(self, neighbours: _Optional[int] = ..., refine: _Optional[bool] = ..., false_accept_rate: _Optional[float] = ...) -> None: ...

class LocalizeResponse(_message.Message):
    __slots__ = ("status", "confidence", "street", "pose", "vehicle_pose", "geopose", "neighbours", "map", "timings", "hypotheses", "spread", "reasons", "camera_height", "calibration", "extrapolated", "threshold", "belief", "rig_correction")
    class ExtrapolatedEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    STATUS_FIELD_NUMBER: _ClassVar[int]
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    STREET_FIELD_NUMBER: _ClassVar[int]
    POSE_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_POSE_FIELD_NUMBER: _ClassVar[int]
    GEOPOSE_FIELD_NUMBER: _ClassVar[int]
    NEIGHBOURS_FIELD_NUMBER: _ClassVar[int]
    MAP_FIELD_NUMBER: _ClassVar[int]
    TIMINGS_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_FIELD_NUMBER: _ClassVar[int]
    SPREAD_FIELD_NUMBER: _ClassVar[int]
    REASONS_FIELD_NUMBER: _ClassVar[int]
    CAMERA_HEIGHT_FIELD_NUMBER: _ClassVar[int]
    CALIBRATION_FIELD_NUMBER: _ClassVar[int]
    EXTRAPOLATED_FIELD_NUMBER: _ClassVar[int]
    THRESHOLD_FIELD_NUMBER: _ClassVar[int]
    BELIEF_FIELD_NUMBER: _ClassVar[int]
    RIG_CORRECTION_FIELD_NUMBER: _ClassVar[int]
    status: LocalizationStatus
    confidence: float
    street: Street
    pose: Pose
    vehicle_pose: Pose
    geopose: GeoPose
    neighbours: _containers.RepeatedCompositeFieldContainer[Neighbour]
    map: MapVersion
    timings: Timings
    hypotheses: _containers.RepeatedCompositeFieldContainer[Hypothesis]
    spread: Spread
    reasons: _containers.RepeatedCompositeFieldContainer[Reason]
    camera_height: CameraHeight
    calibration: CalibrationRange
    extrapolated: _containers.ScalarMap[str, float]
    threshold: AcceptanceThreshold
    belief: Belief
    rig_correction: str
    def __init__(self, status: _Optional[_Union[LocalizationStatus, str]] = ..., confidence: _Optional[float] = ..., street: _Optional[_Union[Street, _Mapping]] = ..., pose: _Optional[_Union[Pose, _Mapping]] = ..., vehicle_pose: _Optional[_Union[Pose, _Mapping]] = ..., geopose: _Optional[_Union[GeoPose, _Mapping]] = ..., neighbours: _Optional[_Iterable[_Union[Neighbour, _Mapping]]] = ..., map: _Optional[_Union[MapVersion, _Mapping]] = ..., timings: _Optional[_Union[Timings, _Mapping]] = ..., hypotheses: _Optional[_Iterable[_Union[Hypothesis, _Mapping]]] = ..., spread: _Optional[_Union[Spread, _Mapping]] = ..., reasons: _Optional[_Iterable[_Union[Reason, _Mapping]]] = ..., camera_height: _Optional[_Union[CameraHeight, _Mapping]] = ..., calibration: _Optional[_Union[CalibrationRange, str]] = ..., extrapolated: _Optional[_Mapping[str, float]] = ..., threshold: _Optional[_Union[AcceptanceThreshold, _Mapping]] = ..., belief: _Optional[_Union[Belief, _Mapping]] = ..., rig_correction: _Optional[str] = ...) -> None: ...

class Belief(_message.Message):
    __slots__ = ("epoch", "modes", "elsewhere", "outside", "token")
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    MODES_FIELD_NUMBER: _ClassVar[int]
    ELSEWHERE_FIELD_NUMBER: _ClassVar[int]
    OUTSIDE_FIELD_NUMBER: _ClassVar[int]
    TOKEN_FIELD_NUMBER: _ClassVar[int]
    epoch: int
    modes: _containers.RepeatedCompositeFieldContainer[Mode]
    elsewhere: float
    outside: float
    token: str
    def __init__(self, epoch: _Optional[int] = ..., modes: _Optional[_Iterable[_Union[Mode, _Mapping]]] = ..., elsewhere: _Optional[float] = ..., outside: _Optional[float] = ..., token: _Optional[str] = ...) -> None: ...

class Mode(_message.Message):
    __slots__ = ("pose", "weight", "number", "unseen")
    POSE_FIELD_NUMBER: _ClassVar[int]
    WEIGHT_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    UNSEEN_FIELD_NUMBER: _ClassVar[int]
    pose: Pose
    weight: float
    number: int
    unseen: int
    def __init__(self, pose: _Optional[_Union[Pose, _Mapping]] = ..., weight: _Optional[float] = ..., number: _Optional[int] = ..., unseen: _Optional[int] = ...) -> None: ...

class AcceptanceThreshold(_message.Message):
    __slots__ = ("confidence", "false_accept_rate")
    CONFIDENCE_FIELD_NUMBER: _ClassVar[int]
    FALSE_ACCEPT_RATE_FIELD_NUMBER: _ClassVar[int]
    confidence: float
    false_accept_rate: float
    def __init__(self, confidence: _Optional[float] = ..., false_accept_rate: _Optional[float] = ...) -> None: ...

class CameraHeight(_message.Message):
    __slots__ = ("height_m", "origin")
    HEIGHT_M_FIELD_NUMBER: _ClassVar[int]
    ORIGIN_FIELD_NUMBER: _ClassVar[int]
    height_m: float
    origin: CameraHeightOrigin
    def __init__(self, height_m: _Optional[float] = ..., origin: _Optional[_Union[CameraHeightOrigin, str]] = ...) -> None: ...

class Reason(_message.Message):
    __slots__ = ("check", "evidence", "remedy")
    class EvidenceEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: float
        def __init__(self, key: _Optional[str] = ..., value: _Optional[float] = ...) -> None: ...
    CHECK_FIELD_NUMBER: _ClassVar[int]
    EVIDENCE_FIELD_NUMBER: _ClassVar[int]
    REMEDY_FIELD_NUMBER: _ClassVar[int]
    check: str
    evidence: _containers.ScalarMap[str, float]
    remedy: str
    def __init__(self, check: _Optional[str] = ..., evidence: _Optional[_Mapping[str, float]] = ..., remedy: _Optional[str] = ...) -> None: ...

class Spread(_message.Message):
    __slots__ = ("mean", "covariance", "heading_std_deg", "hypotheses_weight")
    MEAN_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    HEADING_STD_DEG_FIELD_NUMBER: _ClassVar[int]
    HYPOTHESES_WEIGHT_FIELD_NUMBER: _ClassVar[int]
    mean: Vector3
    covariance: _containers.RepeatedScalarFieldContainer[float]
    heading_std_deg: float
    hypotheses_weight: float
    def __init__(self, mean: _Optional[_Union[Vector3, _Mapping]] = ..., covariance: _Optional[_Iterable[float]] = ..., heading_std_deg: _Optional[float] = ..., hypotheses_weight: _Optional[float] = ...) -> None: ...

class Hypothesis(_message.Message):
    __slots__ = ("pose", "share", "inliers", "similarity", "confirmed")
    POSE_FIELD_NUMBER: _ClassVar[int]
    SHARE_FIELD_NUMBER: _ClassVar[int]
    INLIERS_FIELD_NUMBER: _ClassVar[int]
    SIMILARITY_FIELD_NUMBER: _ClassVar[int]
    CONFIRMED_FIELD_NUMBER: _ClassVar[int]
    pose: Pose
    share: float
    inliers: float
    similarity: float
    confirmed: bool
    def __init__(self, pose: _Optional[_Union[Pose, _Mapping]] = ..., share: _Optional[float] = ..., inliers: _Optional[float] = ..., similarity: _Optional[float] = ..., confirmed: _Optional[bool] = ...) -> None: ...

class Street(_message.Message):
    __slots__ = ("id", "name", "street", "section", "class_index", "vote")
    ID_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    STREET_FIELD_NUMBER: _ClassVar[int]
    SECTION_FIELD_NUMBER: _ClassVar[int]
    CLASS_INDEX_FIELD_NUMBER: _ClassVar[int]
    VOTE_FIELD_NUMBER: _ClassVar[int]
    id: str
    name: str
    street: str
    section: StreetSection
    class_index: int
    vote: float
    def __init__(self, id: _Optional[str] = ..., name: _Optional[str] = ..., street: _Optional[str] = ..., section: _Optional[_Union[StreetSection, str]] = ..., class_index: _Optional[int] = ..., vote: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("position", "orientation", "heading_deg", "covariance")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_FIELD_NUMBER: _ClassVar[int]
    HEADING_DEG_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    position: Vector3
    orientation: Quaternion
    heading_deg: float
    covariance: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, position: _Optional[_Union[Vector3, _Mapping]] = ..., orientation: _Optional[_Union[Quaternion, _Mapping]] = ..., heading_deg: _Optional[float] = ..., covariance: _Optional[_Iterable[float]] = ...) -> None: ...

class GeoPose(_message.Message):
    __slots__ = ("latitude_deg", "longitude_deg", "height_m", "orientation")
    LATITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    LONGITUDE_DEG_FIELD_NUMBER: _ClassVar[int]
    HEIGHT_M_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_FIELD_NUMBER: _ClassVar[int]
    latitude_deg: float
    longitude_deg: float
    height_m: float
    orientation: Quaternion
    def __init__(self, latitude_deg: _Optional[float] = ..., longitude_deg: _Optional[float] = ..., height_m: _Optional[float] = ..., orientation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class Neighbour(_message.Message):
    __slots__ = ("place", "distance", "similarity", "street", "position", "heading_deg")
    PLACE_FIELD_NUMBER: _ClassVar[int]
    DISTANCE_FIELD_NUMBER: _ClassVar[int]
    SIMILARITY_FIELD_NUMBER: _ClassVar[int]
    STREET_FIELD_NUMBER: _ClassVar[int]
    POSITION_FIELD_NUMBER: _ClassVar[int]
    HEADING_DEG_FIELD_NUMBER: _ClassVar[int]
    place: int
    distance: float
    similarity: float
    street: str
    position: Vector3
    heading_deg: float
    def __init__(self, place: _Optional[int] = ..., distance: _Optional[float] = ..., similarity: _Optional[float] = ..., street: _Optional[str] = ..., position: _Optional[_Union[Vector3, _Mapping]] = ..., heading_deg: _Optional[float] = ...) -> None: ...

class MapVersion(_message.Message):
    __slots__ = ("name", "version")
    NAME_FIELD_NUMBER: _ClassVar[int]
    VERSION_FIELD_NUMBER: _ClassVar[int]
    name: str
    version: str
    def __init__(self, name: _Optional[str] = ..., version: _Optional[str] = ...) -> None: ...

class Timings(_message.Message):
    __slots__ = ("decode_ms", "fuse_ms", "encode_ms", "search_ms", "register_ms", "total_ms")
    DECODE_MS_FIELD_NUMBER: _ClassVar[int]
    FUSE_MS_FIELD_NUMBER: _ClassVar[int]
    ENCODE_MS_FIELD_NUMBER: _ClassVar[int]
    SEARCH_MS_FIELD_NUMBER: _ClassVar[int]
    REGISTER_MS_FIELD_NUMBER: _ClassVar[int]
    TOTAL_MS_FIELD_NUMBER: _ClassVar[int]
    decode_ms: float
    fuse_ms: float
    encode_ms: float
    search_ms: float
    register_ms: float
    total_ms: float
    def __init__(self, decode_ms: _Optional[float] = ..., fuse_ms: _Optional[float] = ..., encode_ms: _Optional[float] = ..., search_ms: _Optional[float] = ..., register_ms: _Optional[float] = ..., total_ms: _Optional[float] = ...) -> None: ...

class RigidTransform(_message.Message):
    __slots__ = ("position", "orientation")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_FIELD_NUMBER: _ClassVar[int]
    position: Vector3
    orientation: Quaternion
    def __init__(self, position: _Optional[_Union[Vector3, _Mapping]] = ..., orientation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class Vector3(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("x", "y", "z", "w")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    W_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    w: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., w: _Optional[float] = ...) -> None: ...
