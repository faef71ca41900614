"""Convert between protobuf messages and the models of the contract.

The models check limits and meanings once for REST and gRPC.
"""

from typing import Any

from google.protobuf.message import Message

from service.contract import schema
from service.contract.convert import checked
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb

_KINDS = {
    pb.DEPTH_KIND_UNSPECIFIED: "z",
    pb.DEPTH_KIND_Z: "z",
    pb.DEPTH_KIND_RANGE: "range",
    pb.DEPTH_KIND_DISPARITY: "disparity",
}
_ENCODINGS = {
    pb.DEPTH_ENCODING_UNSPECIFIED: "auto",
    pb.DEPTH_ENCODING_CARLA: "carla",
    pb.DEPTH_ENCODING_COMPRESSED_DEPTH: "compressed_depth",
}
_MODELS = {pb.CAMERA_MODEL_UNSPECIFIED: "PINHOLE", pb.CAMERA_MODEL_PINHOLE: "PINHOLE"}
_LENSES = {
    pb.DISTORTION_MODEL_UNSPECIFIED: "brown_conrady",
    pb.DISTORTION_MODEL_BROWN_CONRADY: "brown_conrady",
    pb.DISTORTION_MODEL_KANNALA_BRANDT: "kannala_brandt",
}
#: One more than the contract allows. So too many coefficients are refused, and a message with millions does not become a large list.
_MOST_COEFFICIENTS = 15
_STATUS = {
    "LOCALIZED": pb.LOCALIZATION_STATUS_LOCALIZED,
    "AMBIGUOUS": pb.LOCALIZATION_STATUS_AMBIGUOUS,
    "OUT_OF_MAP": pb.LOCALIZATION_STATUS_OUT_OF_MAP,
}
_CALIBRATION = {
    None: None,
    "in_range": pb.CALIBRATION_RANGE_IN_RANGE,
    "extrapolated": pb.CALIBRATION_RANGE_EXTRAPOLATED,
}
_ORIGINS = {
    "given": pb.CAMERA_HEIGHT_ORIGIN_GIVEN,
    "estimated": pb.CAMERA_HEIGHT_ORIGIN_ESTIMATED,
    "assumed": pb.CAMERA_HEIGHT_ORIGIN_ASSUMED,
}
_SECTIONS = {
    None: pb.STREET_SECTION_UNSPECIFIED,
    "beginning": pb.STREET_SECTION_BEGINNING,
    "end": pb.STREET_SECTION_END,
}


def request_from(message: pb.LocalizeRequest) -> schema.LocalizeRequest:
    """Convert the request of one image pair, without the images.

    Args:
        message: as received.

    Raises:
        RequestError: a field is invalid.
    """
    content = _of_pair(message) | _of_all(message) | _sub(message, "track", "track", _track)
    return checked(content, schema.LocalizeRequest)


def sequence_request_from(message: pb.LocalizeSequenceRequest) -> schema.SequenceRequest:
    """Convert the request of a sequence, without the images.

    Args:
        message: as received.

    Raises:
        RequestError: a field is invalid.
    """
    frames = [
        _of_pair(frame) | _sub(frame, "reference_from_camera", "T_reference_camera", transform_content)
        for frame in message.frames
    ]
    content = _of_all(message) | {"frames": frames} | _sub(message, "track", "track", _track)
    return checked(content, schema.SequenceRequest)


def transform_from(message: pb.RigidTransform) -> schema.RigidTransform:
    """Convert a single transform.

    Args:
        message: as received.

    Raises:
        RequestError: a number is invalid.
    """
    return checked(transform_content(message), schema.RigidTransform)


def _track(message: pb.Track) -> dict[str, Any]:
    return (
        _given(message, "belief")
        | _sub(message, "previous_from_camera", "T_previous_camera", transform_content)
        | _sub(message, "odometry_std", "odometry_std", _odometry_std)
    )


def _odometry_std(message: pb.OdometryStd) -> dict[str, Any]:
    return {"position_m": message.position_m, "angle_deg": message.angle_deg}


def odometry_std_from(message: pb.OdometryStd) -> schema.OdometryStd:
    """Convert standard deviations of odometry.

    Args:
        message: as received.

    Raises:
        RequestError: a number is invalid.
    """
    return checked(_odometry_std(message), schema.OdometryStd)


def _of_all(message: pb.LocalizeRequest | pb.LocalizeSequenceRequest) -> dict[str, Any]:
    """Fields that a single pair and a sequence share."""
    return (
        _given(message, "map")
        | _sub(message, "vehicle_from_camera", "T_vehicle_camera", transform_content)
        | {"vehicle_base_on_ground": message.vehicle_base_on_ground}
        | _sub(message, "prior", "prior", _prior)
        | _sub(message, "options", "options", lambda m: _given(m, "neighbours", "refine", "false_accept_rate"))
    )


def _of_pair(message: pb.LocalizeRequest | pb.SequenceFrame) -> dict[str, Any]:
    """Fields of one image pair."""
    return (
        _sub(message, "camera", "camera", _camera)
        | _sub(message, "depth_format", "depth", _depth)
        | _sub(message, "gravity", "gravity", _vector)
    )


def _camera(message: pb.Camera) -> dict[str, Any]:
    numbers = {name: getattr(message, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    return (
        numbers
        | _given(message, "height_m", "height_std_m")
        | {
            "model": _MODELS.get(message.model, message.model),
            "distortion_model": _LENSES.get(message.distortion_model, message.distortion_model),
            "distortion": list(message.distortion[:_MOST_COEFFICIENTS]),
        }
    )


def _depth(message: pb.DepthFormat) -> dict[str, Any]:
    named = {
        "kind": _KINDS.get(message.kind, message.kind),
        "encoding": _ENCODINGS.get(message.encoding, message.encoding),
    }
    return named | _given(message, "scale_m", "max_range_m", "baseline_m")


def _prior(message: pb.Prior) -> dict[str, Any]:
    return (
        _given(message, "heading_deg", "heading_std_deg")
        | _sub(message, "position", "position", lambda m: {"x": m.x, "y": m.y} | _given(m, "std_m"))
        | _sub(
            message,
            "wgs84",
            "wgs84",
            lambda m: {"latitude_deg": m.latitude_deg, "longitude_deg": m.longitude_deg} | _given(m, "std_m"),
        )
    )


def transform_content(message: pb.RigidTransform) -> dict[str, Any]:
    """Return a transform as a dictionary for the contract model.

    A missing quaternion becomes all zeros. The model refuses it later, because it is no rotation.

    Args:
        message: as received.
    """
    q = message.orientation
    return {"position": _vector(message.position), "orientation": {"x": q.x, "y": q.y, "z": q.z, "w": q.w}}


def _vector(message: pb.Vector3) -> dict[str, float]:
    return {"x": message.x, "y": message.y, "z": message.z}


def _given(message: Message, *names: str) -> dict[str, Any]:
    """Return the optional fields that were sent."""
    return {name: getattr(message, name) for name in names if message.HasField(name)}


def _sub(message: Message, field: str, name: str, content: Any) -> dict[str, Any]:
    """Convert a nested message if it was sent."""
    return {name: content(getattr(message, field))} if message.HasField(field) else {}


def answer_message(answer: schema.LocalizeAnswer) -> pb.LocalizeResponse:
    """Convert an answer of the contract to a message.

    Args:
        answer: to send.
    """
    times = answer.timings_ms
    message = pb.LocalizeResponse(
        status=_STATUS[answer.status],
        confidence=answer.confidence,
        street=None if answer.street is None else _street(answer.street),
        pose=None if answer.pose is None else _pose(answer.pose),
        vehicle_pose=None if answer.vehicle_pose is None else _pose(answer.vehicle_pose),
        geopose=None if answer.geopose is None else _geopose(answer.geopose),
        neighbours=[
            pb.Neighbour(
                place=each.place,
                distance=each.distance,
                similarity=each.similarity,
                street=each.street,
                position=_vector3(each.position),
                heading_deg=each.heading_deg,
            )
            for each in answer.neighbours
        ],
        camera_height=None if answer.camera_height is None else _camera_height(answer.camera_height),
        map=pb.MapVersion(name=answer.map.name, version=answer.map.version),
        timings=pb.Timings(
            decode_ms=times.decode,
            fuse_ms=times.fuse,
            encode_ms=times.encode,
            search_ms=times.search,
            register_ms=times.register_,
            total_ms=times.total,
        ),
        hypotheses=[
            pb.Hypothesis(
                pose=_pose(each.pose),
                share=each.share,
                inliers=each.inliers,
                similarity=each.similarity,
                confirmed=each.confirmed,
            )
            for each in answer.hypotheses
        ],
        spread=None if answer.spread is None else _spread(answer.spread),
        reasons=[pb.Reason(check=each.check, evidence=each.evidence, remedy=each.remedy) for each in answer.reasons],
        calibration=_CALIBRATION[answer.calibration],
        extrapolated=answer.extrapolated,
        threshold=None
        if answer.threshold is None
        else pb.AcceptanceThreshold(
            confidence=answer.threshold.confidence, false_accept_rate=answer.threshold.false_accept_rate
        ),
        rig_correction=answer.rig_correction,
        belief=None if answer.belief is None else _belief(answer.belief),
    )
    return message


def map_message(entry: schema.MapEntry) -> pb.MapEntry:
    """Convert the entry of a mounted map to a message.

    Args:
        entry: of the map.
    """
    return pb.MapEntry(**entry.model_dump())


def _belief(belief: schema.Belief) -> pb.Belief:
    return pb.Belief(
        epoch=belief.epoch,
        modes=[
            pb.Mode(pose=_pose(each.pose), weight=each.weight, number=each.number, unseen=each.unseen)
            for each in belief.modes
        ],
        elsewhere=belief.elsewhere,
        outside=belief.outside,
        token=belief.token,
    )


def _camera_height(height: schema.CameraHeight) -> pb.CameraHeight:
    return pb.CameraHeight(height_m=height.height_m, origin=_ORIGINS[height.origin])


def _geopose(geopose: schema.GeoPose) -> pb.GeoPose:
    at, q = geopose.position, geopose.quaternion
    return pb.GeoPose(
        latitude_deg=at.lat, longitude_deg=at.lon, height_m=at.h, orientation=pb.Quaternion(x=q.x, y=q.y, z=q.z, w=q.w)
    )


def _street(street: schema.Street) -> pb.Street:
    return pb.Street(
        id=street.id,
        name=street.name,
        street=street.street,
        section=_SECTIONS[street.section],
        class_index=street.class_index,
        vote=street.vote,
    )


def _pose(pose: schema.Pose) -> pb.Pose:
    q = pose.orientation
    return pb.Pose(
        position=_vector3(pose.position),
        orientation=pb.Quaternion(x=q.x, y=q.y, z=q.z, w=q.w),
        heading_deg=pose.heading_deg,
        covariance=pose.covariance or (),
    )


def _spread(spread: schema.Spread) -> pb.Spread:
    return pb.Spread(
        mean=_vector3(spread.mean),
        covariance=spread.covariance,
        heading_std_deg=spread.heading_std_deg,
        hypotheses_weight=spread.hypotheses_weight,
    )


def _vector3(vector: schema.Vector) -> pb.Vector3:
    return pb.Vector3(x=vector.x, y=vector.y, z=vector.z)
