"""Convert requests of the contract to protobuf messages, and protobuf answers to models of the contract."""

from typing import Any

from service.client.prepare import PreparedRequest
from service.client.stream_answer import StreamAnswer
from service.contract import schema
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb

#: Value of the gRPC enumeration for each kind of depth.
DEPTH_KINDS = {"z": pb.DEPTH_KIND_Z, "range": pb.DEPTH_KIND_RANGE, "disparity": pb.DEPTH_KIND_DISPARITY}
_LENSES = {
    "brown_conrady": pb.DISTORTION_MODEL_UNSPECIFIED,
    "kannala_brandt": pb.DISTORTION_MODEL_KANNALA_BRANDT,
}
_CALIBRATION = {pb.CALIBRATION_RANGE_IN_RANGE: "in_range", pb.CALIBRATION_RANGE_EXTRAPOLATED: "extrapolated"}
_STATUS_PREFIX, _SECTION_PREFIX, _ORIGIN_PREFIX = "LOCALIZATION_STATUS_", "STREET_SECTION_", "CAMERA_HEIGHT_ORIGIN_"


def request_message(prepared: PreparedRequest[schema.LocalizeRequest]) -> pb.LocalizeRequest:
    """Return the message for a single query.

    Args:
        prepared: the request and its encoded images.
    """
    return _pair(prepared.document, prepared.pictures[0])


def batch_message(prepared: PreparedRequest[schema.BatchRequest]) -> pb.LocalizeBatchRequest:
    """Return the message for a batch of independent queries.

    Args:
        prepared: the request and its encoded images.
    """
    pairs = zip(prepared.document.requests, prepared.pictures, strict=True)
    return pb.LocalizeBatchRequest(requests=[_pair(request, pictures) for request, pictures in pairs])


def sequence_message(prepared: PreparedRequest[schema.SequenceRequest]) -> pb.LocalizeSequenceRequest:
    """Return the message for a sequence.

    Args:
        prepared: the request and its encoded images.
    """
    request = prepared.document
    frames = [
        pb.SequenceFrame(
            rgb=rgb,
            depth=depth,
            camera=_camera(frame.camera),
            depth_format=_depth(frame.depth),
            gravity=_vector(frame.gravity),
            reference_from_camera=_transform(frame.T_reference_camera),
        )
        for frame, (rgb, depth) in zip(request.frames, prepared.pictures, strict=True)
    ]
    return pb.LocalizeSequenceRequest(
        map=request.map,
        frames=frames,
        vehicle_from_camera=_transform(request.T_vehicle_camera),
        prior=_prior(request.prior),
        options=_options(request.options),
        vehicle_base_on_ground=request.vehicle_base_on_ground,
        track=None if request.track is None else _track(request.track),
    )


def stream_message(prepared: PreparedRequest[schema.LocalizeRequest], *, begins: bool) -> pb.LocalizeStreamRequest:
    """Return the message for a frame of a stream.

    Args:
        prepared: the request and its encoded images. Its track has the odometry.
        begins: True for the first frame of a call. Its odometry is not sent, because it refers to a frame that the call does not have.
    """
    frame = prepared.document
    odometry = None if begins or frame.track is None else _track(frame.track)
    message = pb.LocalizeStreamRequest(frame=_pair(frame.model_copy(update={"track": None}), prepared.pictures[0]))
    if odometry is not None and odometry.HasField("previous_from_camera"):
        message.previous_from_camera.CopyFrom(odometry.previous_from_camera)
        if odometry.HasField("odometry_std"):
            message.odometry_std.CopyFrom(odometry.odometry_std)
    return message


def stream_answer_of(message: pb.LocalizeStreamResponse) -> StreamAnswer:
    """Convert the answer to a frame of a stream.

    Args:
        message: the response, whose outcome is an answer.

    Raises:
        ValueError: a value violates the contract.
    """
    return StreamAnswer.model_validate(_answer_content(message.outcome.answer) | {"frames": message.frames})


def answer_of(message: pb.LocalizeResponse) -> schema.LocalizeAnswer:
    """Convert an answer to the contract's model.

    Args:
        message: the answer.

    Raises:
        ValueError: a value violates the contract.
    """
    return schema.LocalizeAnswer.model_validate(_answer_content(message))


def _answer_content(message: pb.LocalizeResponse) -> dict[str, Any]:
    times = message.timings
    return {
        "status": pb.LocalizationStatus.Name(message.status).removeprefix(_STATUS_PREFIX),
        "confidence": message.confidence if message.HasField("confidence") else None,
        "street": _street_content(message.street) if message.HasField("street") else None,
        "pose": _pose_content(message.pose) if message.HasField("pose") else None,
        "vehicle_pose": _pose_content(message.vehicle_pose) if message.HasField("vehicle_pose") else None,
        "geopose": _geopose_content(message.geopose) if message.HasField("geopose") else None,
        "hypotheses": [
            {
                "confirmed": each.confirmed,
                "pose": _pose_content(each.pose),
                "share": each.share,
                "inliers": each.inliers,
                "similarity": each.similarity,
            }
            for each in message.hypotheses
        ],
        "spread": _spread_content(message.spread) if message.HasField("spread") else None,
        "reasons": [
            {"check": each.check, "evidence": dict(each.evidence), "remedy": each.remedy} for each in message.reasons
        ],
        "neighbours": [
            {
                "place": each.place,
                "distance": each.distance,
                "similarity": each.similarity,
                "street": each.street if each.HasField("street") else None,
                "position": _xyz(each.position),
                "heading_deg": each.heading_deg,
            }
            for each in message.neighbours
        ],
        "camera_height": _height_content(message.camera_height) if message.HasField("camera_height") else None,
        "calibration": _CALIBRATION.get(message.calibration),
        "extrapolated": dict(message.extrapolated),
        "threshold": {
            "confidence": message.threshold.confidence,
            "false_accept_rate": message.threshold.false_accept_rate,
        }
        if message.HasField("threshold")
        else None,
        "rig_correction": message.rig_correction if message.HasField("rig_correction") else None,
        "belief": _belief_content(message.belief) if message.HasField("belief") else None,
        "map": {"name": message.map.name, "version": message.map.version},
        "timings_ms": {
            stage: getattr(times, f"{stage}_ms")
            for stage in ("decode", "fuse", "encode", "search", "register", "total")
        },
    }


def _belief_content(message: pb.Belief) -> dict[str, Any]:
    return {
        "epoch": message.epoch,
        "modes": [
            {"pose": _pose_content(each.pose), "weight": each.weight, "number": each.number, "unseen": each.unseen}
            for each in message.modes
        ],
        "elsewhere": message.elsewhere,
        "outside": message.outside,
        "token": message.token if message.HasField("token") else None,
    }


def map_of(message: pb.MapEntry) -> schema.MapEntry:
    """Convert an entry of the list of maps to the contract's model.

    Args:
        message: the entry.

    Raises:
        ValueError: a value violates the contract.
    """
    content = {name: getattr(message, name) for name in schema.MapEntry.model_fields if name != "versions"}
    return schema.MapEntry.model_validate(content | {"versions": list(message.versions)})


def _pair(request: schema.LocalizeRequest, pictures: tuple[bytes, bytes]) -> pb.LocalizeRequest:
    rgb, depth = pictures
    return pb.LocalizeRequest(
        map=request.map,
        rgb=rgb,
        depth=depth,
        camera=_camera(request.camera),
        depth_format=_depth(request.depth),
        gravity=_vector(request.gravity),
        vehicle_from_camera=_transform(request.T_vehicle_camera),
        options=_options(request.options),
        prior=_prior(request.prior),
        vehicle_base_on_ground=request.vehicle_base_on_ground,
        track=None if request.track is None else _track(request.track),
    )


def _track(track: schema.Track) -> pb.Track:
    std = track.odometry_std
    return pb.Track(
        belief=track.belief,
        previous_from_camera=_transform(track.T_previous_camera),
        odometry_std=None if std is None else pb.OdometryStd(position_m=std.position_m, angle_deg=std.angle_deg),
    )


def _camera(camera: schema.Camera) -> pb.Camera:
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion")}
    if camera.height_m is not None:
        numbers |= {"height_m": camera.height_m, "height_std_m": camera.height_std_m}
    return pb.Camera(model=pb.CAMERA_MODEL_PINHOLE, distortion_model=_LENSES[camera.distortion_model], **numbers)


def _depth(depth: schema.Depth) -> pb.DepthFormat:
    return pb.DepthFormat(
        scale_m=depth.scale_m, kind=DEPTH_KINDS[depth.kind], max_range_m=depth.max_range_m, baseline_m=depth.baseline_m
    )


def _options(options: schema.Options) -> pb.Options:
    return pb.Options(**options.model_dump(exclude_unset=True))


def _prior(prior: schema.Prior | None) -> pb.Prior | None:
    if prior is None:
        return None
    position, wgs84 = prior.position, prior.wgs84
    return pb.Prior(
        position=None if position is None else pb.PriorPosition(**position.model_dump()),
        wgs84=None if wgs84 is None else pb.PriorWgs84(**wgs84.model_dump()),
        heading_deg=prior.heading_deg,
        heading_std_deg=prior.heading_std_deg,
    )


def _vector(vector: schema.Direction | None) -> pb.Vector3 | None:
    return None if vector is None else pb.Vector3(x=vector.x, y=vector.y, z=vector.z)


def _transform(transform: schema.RigidTransform | None) -> pb.RigidTransform | None:
    if transform is None:
        return None
    p, q = transform.position, transform.orientation
    return pb.RigidTransform(
        position=pb.Vector3(x=p.x, y=p.y, z=p.z), orientation=pb.Quaternion(x=q.x, y=q.y, z=q.z, w=q.w)
    )


def _xyz(message: pb.Vector3) -> dict[str, float]:
    return {"x": message.x, "y": message.y, "z": message.z}


def _xyzw(message: pb.Quaternion) -> dict[str, float]:
    return {"x": message.x, "y": message.y, "z": message.z, "w": message.w}


def _pose_content(message: pb.Pose) -> dict[str, Any]:
    return {
        "position": _xyz(message.position),
        "orientation": _xyzw(message.orientation),
        "heading_deg": message.heading_deg,
        "covariance": list(message.covariance) or None,
    }


def _height_content(message: pb.CameraHeight) -> dict[str, Any]:
    origin = pb.CameraHeightOrigin.Name(message.origin).removeprefix(_ORIGIN_PREFIX).lower()
    return {"height_m": message.height_m, "origin": origin}


def _spread_content(message: pb.Spread) -> dict[str, Any]:
    return {
        "mean": _xyz(message.mean),
        "covariance": list(message.covariance),
        "heading_std_deg": message.heading_std_deg,
        "hypotheses_weight": message.hypotheses_weight,
    }


def _geopose_content(message: pb.GeoPose) -> dict[str, Any]:
    position = {"lat": message.latitude_deg, "lon": message.longitude_deg, "h": message.height_m}
    return {"position": position, "quaternion": _xyzw(message.orientation)}


def _street_content(message: pb.Street) -> dict[str, Any]:
    section = pb.StreetSection.Name(message.section).removeprefix(_SECTION_PREFIX).lower()
    return {
        "id": message.id,
        "name": message.name,
        "street": message.street,
        "class_index": message.class_index,
        "section": None if section == "unspecified" else section,
        "vote": message.vote,
    }
