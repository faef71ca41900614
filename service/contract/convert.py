"""Convert between the contract and the types of the core, for REST and gRPC. The only arithmetic is degrees to radians."""

import base64
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from service.confidence.reasons import Reason
from service.confidence.spread import Spread
from service.contract import schema
from service.contract.invalid import invalid
from service.errors import RequestError, StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import (
    heading_of_body,
    heading_of_camera,
    quaternion_xyzw_from,
    rotation_from_quaternion_xyzw,
    transform_from,
)
from service.geometry.uncertainty import covariance_at
from service.imaging.level import GivenHeight
from service.localization.answer import Answer
from service.localization.belief import Belief, OdometryStd
from service.localization.localizer import Localizer
from service.maps.map import Map
from service.option_limits import LEAST_HEIGHT_M, MOST_HEIGHT_M, VEHICLE_HEIGHT_STD_M
from service.retrieval.knn import Neighbour
from service.retrieval.prior import POSITION_STD_M, Prior
from service.runtime.engine import CarriedTrack, EncodedQuery, Located
from service.runtime.last_answers import LastAnswer
from service.scoring.candidates import distinct_candidates, shares_of

M = TypeVar("M", bound=BaseModel)
#: A camera of a sequence that is at most so far from the first one, metres, is on the same ground as the vehicle. The slope of a
#: street makes the height of a farther camera unknown.
SAME_GROUND_M = 2.0


def parsed(document: bytes, model: type[M]) -> M:
    """Parse JSON to a model of the contract.

    Args:
        document: JSON, encoded.
        model: class of the model.

    Raises:
        RequestError: the document is not JSON, or a field is invalid.
    """
    try:
        return model.model_validate_json(document)
    except ValidationError as error:
        raise invalid(error) from error


def checked(content: dict[str, Any], model: type[M]) -> M:
    """Validate a dictionary as a model of the contract.

    Args:
        content: fields by name.
        model: class of the model.

    Raises:
        RequestError: a field is invalid.
    """
    try:
        return model.model_validate(content)
    except ValidationError as error:
        raise invalid(error) from error


def query_from(request: schema.LocalizeRequest, *, rgb: bytes, depth: bytes) -> EncodedQuery:
    """Build the query of the core.

    Args:
        request: checked against the contract.
        rgb: encoded RGB image.
        depth: encoded depth image.

    Raises:
        RequestError: a field contradicts other fields.
    """
    T_vehicle_camera = (
        None if request.T_vehicle_camera is None else transform_of(request.T_vehicle_camera, "T_vehicle_camera")
    )
    over_base = height_over_base(T_vehicle_camera) if request.vehicle_base_on_ground else None
    return EncodedQuery(
        rgb=rgb,
        depth=depth,
        map_name=request.map,
        camera=camera_of(request.camera),
        depth_encoding=request.depth.encoding,
        depth_kind=request.depth.kind,
        scale_m=request.depth.scale_m,
        baseline_m=request.depth.baseline_m,
        max_range_m=request.depth.max_range_m,
        down_camera=None if request.gravity is None else _down(request.gravity),
        camera_height=_given_height(request.camera) or over_base,
        T_vehicle_camera=T_vehicle_camera,
        neighbours=request.options.neighbours,
        refine=request.options.refine,
        prior=None if request.prior is None else _prior(request.prior),
        prior_wgs84=_wgs84(request.prior),
        false_accept_rate=request.options.false_accept_rate,
        track=None if request.track is None else _track(request.track),
    )


def _track(track: schema.Track) -> CarriedTrack:
    T = track.T_previous_camera
    return CarriedTrack(
        None if track.belief is None else _token_bytes(track.belief),
        None if T is None else transform_of(T, "track.T_previous_camera"),
        odometry_std_of(track.odometry_std, "track.odometry_std", known=T is not None),
    )


def odometry_std_of(std: schema.OdometryStd | None, field: str, *, known: bool) -> OdometryStd | None:
    """Return the standard deviations of an odometry step.

    Args:
        std: as received; None if the client did not send it.
        field: name of the field, for errors.
        known: whether the request has the odometry itself.

    Raises:
        RequestError: it was sent without the odometry.
    """
    if std is None:
        return None
    if not known:
        raise RequestError(
            f"{field}: the request has no odometry (T_previous_camera, in gRPC previous_from_camera); send it, or omit odometry_std",
            field=field,
        )
    return OdometryStd(std.position_m, float(np.deg2rad(std.angle_deg)))


def _token_bytes(token: str) -> bytes:
    try:
        return base64.urlsafe_b64decode(token + "=" * (-len(token) % 4))
    except ValueError as error:
        raise RequestError(
            "track.belief: it is not a token of this service; send belief.token of the answer before, or omit track.belief to begin again",
            field="track.belief",
        ) from error


def sequence_from(
    request: schema.SequenceRequest, pictures: Sequence[tuple[bytes, bytes]]
) -> tuple[tuple[EncodedQuery, ...], tuple[NDArray[np.float64], ...]]:
    """Build the queries of the core, the reference first, and ``T_reference_camera`` of each camera.

    Args:
        request: checked against the contract.
        pictures: RGB and depth image of each frame, encoded.

    Raises:
        RequestError: a field contradicts other fields.
    """
    queries, transforms = [], []
    T_vehicle_reference = None
    if request.vehicle_base_on_ground:
        given = request.T_vehicle_camera
        T_vehicle_reference = None if given is None else transform_of(given, "T_vehicle_camera")
        height_over_base(T_vehicle_reference)  # refuses the request here, where the field has its own name
    for number, (frame, (rgb, depth)) in enumerate(zip(request.frames, pictures, strict=True)):
        where = f"frames.{number}"
        if (frame.T_reference_camera is None) != (number == 0):
            why = "missing; send the pose of this camera in the frame of the first camera"
            if number == 0:
                why = "the first frame is the reference; omit T_reference_camera here"
            raise RequestError(f"{where}.T_reference_camera: {why}", field=f"{where}.T_reference_camera")
        alone = schema.LocalizeRequest(
            map=request.map,
            camera=frame.camera,
            depth=frame.depth,
            gravity=frame.gravity,
            options=request.options,
            T_vehicle_camera=None if number else request.T_vehicle_camera,
            prior=None if number else request.prior,
        )
        with fields_under(where):
            query = query_from(alone, rgb=rgb, depth=depth)
            T = frame.T_reference_camera
            transforms.append(np.eye(4) if T is None else transform_of(T, "T_reference_camera"))
        if query.camera_height is None and T_vehicle_reference is not None:
            query = replace(query, camera_height=_height_on_same_ground(T_vehicle_reference, transforms[-1]))
        queries.append(query)
    if request.track is not None:
        queries[0] = replace(queries[0], track=_track(request.track))
    return tuple(queries), tuple(transforms)


def height_over_base(T_vehicle_camera: NDArray[np.float64] | None) -> GivenHeight:
    """Return the height of a camera over the origin of a vehicle frame that lies on the ground.

    Args:
        T_vehicle_camera: from the camera frame to the vehicle frame (z up), (4, 4), metres; None if it was not sent.

    Raises:
        RequestError: the transform was not sent, or its height is out of bounds.
    """
    if T_vehicle_camera is None:
        raise RequestError(
            "vehicle_base_on_ground: T_vehicle_camera is missing, and the camera height follows from it; send it, or send "
            "camera.height_m instead",
            field="vehicle_base_on_ground",
        )
    height_m = float(T_vehicle_camera[2, 3])
    if not LEAST_HEIGHT_M <= height_m <= MOST_HEIGHT_M:
        raise RequestError(
            f"T_vehicle_camera.position.z: with vehicle_base_on_ground, the camera would be {height_m:g} m above the ground, "
            f"outside {LEAST_HEIGHT_M:g} to {MOST_HEIGHT_M:g} m; send T_vehicle_camera of a frame on the ground (z up, "
            "metres), or send camera.height_m without vehicle_base_on_ground",
            field="T_vehicle_camera.position.z",
        )
    return GivenHeight(height_m, VEHICLE_HEIGHT_STD_M)


def _height_on_same_ground(
    T_vehicle_reference: NDArray[np.float64], T_reference_camera: NDArray[np.float64]
) -> GivenHeight | None:
    """Return the height of a camera of a sequence over the ground of the vehicle; None if that ground may not be under it."""
    height_m = float((T_vehicle_reference @ T_reference_camera)[2, 3])
    near = math.dist(T_reference_camera[:3, 3], (0.0, 0.0, 0.0)) <= SAME_GROUND_M
    if not near or not LEAST_HEIGHT_M <= height_m <= MOST_HEIGHT_M:
        return None
    return GivenHeight(height_m, VEHICLE_HEIGHT_STD_M)


def _given_height(camera: schema.Camera) -> GivenHeight | None:
    return None if camera.height_m is None else GivenHeight(camera.height_m, camera.height_std_m)


@contextmanager
def fields_under(where: str) -> Iterator[None]:
    """Prefix the field of an error with the path of the enclosing message.

    Args:
        where: dotted path of the enclosing message.
    """
    try:
        yield
    except StreetfixError as error:
        error.field = f"{where}.{error.field}" if error.field else where
        error.message = f"{where}: {error.message}"
        raise


def answer_from(located: Located) -> schema.LocalizeAnswer:
    """Convert an answer to the contract. Only a LOCALIZED answer gets a pose, a geopose and a street.

    Args:
        located: answer of the core, with its map.
    """
    answer, bundle = located.answer, located.bundle
    times, spread = answer.timings, answer.spread
    localized = answer.status == "LOCALIZED"
    T_map_camera = answer.T_map_camera_guess
    T_map_posed = T_map_camera if answer.T_map_vehicle_guess is None else answer.T_map_vehicle_guess
    return schema.LocalizeAnswer(
        status=answer.status,
        confidence=answer.confidence,
        street=_street(answer, bundle) if localized else None,
        pose=_pose(T_map_camera, heading_of_camera(T_map_camera), answer.covariance) if localized else None,
        vehicle_pose=_vehicle_pose(answer) if localized else None,
        geopose=geopose_of(T_map_posed, bundle) if localized else None,
        hypotheses=_hypotheses(answer),
        spread=None if spread is None else _spread(spread),
        reasons=[_reason(each) for each in answer.reasons],
        neighbours=[_neighbour(each, bundle) for each in answer.neighbours],
        camera_height=schema.CameraHeight(height_m=answer.height_m, origin=answer.height_origin),
        calibration=_calibration_range(answer),
        extrapolated=dict(answer.extrapolated),
        threshold=None
        if answer.threshold is None
        else schema.AcceptanceThreshold(
            confidence=answer.threshold.confidence, false_accept_rate=answer.threshold.false_accept_rate
        ),
        rig_correction=answer.rig_correction,
        belief=None if answer.belief is None else _belief(answer.belief, answer.epoch, located.sealed_belief),
        map=schema.MapVersion(name=bundle.name, version=bundle.manifest.version),
        timings_ms=schema.TimingsMs(
            decode=times.decode_ms,
            fuse=times.fuse_ms,
            encode=times.encode_ms,
            search=times.search_ms,
            register=times.register_ms,
            total=times.total_ms,
        ),
    )


def _calibration_range(answer: Answer) -> Literal["in_range", "extrapolated"] | None:
    if answer.confidence is None or answer.evidence is None:
        return None
    return "extrapolated" if answer.extrapolated else "in_range"


def geopose_of(T_map_body: NDArray[np.float64], bundle: Map) -> schema.GeoPose | None:
    """Convert a pose in the map frame to a GeoPose; None if the map is not georeferenced.

    Args:
        T_map_body: pose of the vehicle or of the camera.
        bundle: the map.
    """
    earth = bundle.earth
    if earth is None:
        return None
    latitude_deg, longitude_deg, height_m = earth.to_earth(T_map_body[:3, 3])
    x, y, z, w = quaternion_xyzw_from(earth.R_enu_map(T_map_body[:3, 3]) @ T_map_body[:3, :3]).tolist()
    return schema.GeoPose(
        position=schema.GeoPosition(lat=latitude_deg, lon=longitude_deg, h=height_m),
        quaternion=schema.Quaternion(x=x, y=y, z=z, w=w),
    )


def last_answer_from(answer: LastAnswer) -> schema.LastAnswer:
    """Convert a kept answer to the contract.

    Args:
        answer: as kept.
    """
    return schema.LastAnswer(
        number=answer.number,
        at=answer.at.isoformat(timespec="milliseconds"),
        map=schema.MapVersion(name=answer.map_name, version=answer.map_version),
        status=answer.status,
        confidence=answer.confidence,
        street=answer.street,
        position=None if answer.position_m is None else _vector(answer.position_m),
        heading_deg=None if answer.heading_rad is None else _degrees(answer.heading_rad),
        frames=answer.frames,
        total_ms=answer.total_ms,
    )


def vector_from(position_m: NDArray[np.float64]) -> schema.Vector:
    """Convert a position to the contract.

    Args:
        position_m: position, metres.
    """
    return _vector(position_m)


def map_entry_from(bundle: Map, versions: Sequence[Localizer]) -> schema.MapEntry:
    """Convert a mounted map to the contract.

    Args:
        bundle: the serving version.
        versions: all open versions, the newest first.
    """
    manifest = bundle.manifest
    return schema.MapEntry(
        name=manifest.name,
        version=manifest.version,
        made_at=manifest.made_at.isoformat(),
        places=manifest.counts.places,
        views=manifest.counts.views,
        streets=manifest.counts.streets,
        spacing_m=manifest.spacing_m,
        encoder_sha256=manifest.encoder_sha256,
        georeferenced=manifest.georeference is not None,
        licence=manifest.licence,
        versions=[each.bundle.manifest.version for each in versions],
        tiles=len(manifest.tiles),
        open_tiles=bundle.open_tiles,
    )


def require_camera(camera: PinholeCamera) -> None:
    """Check intrinsics and distortion that did not come by a request against the limits of the contract.

    Args:
        camera: the intrinsics and the distortion.

    Raises:
        RequestError: a number is out of its limits.
    """
    names = ("width", "height", "fx", "fy", "cx", "cy", "distortion_model")
    content = {name: getattr(camera, name) for name in names} | {"distortion": list(camera.distortion)}
    with fields_under("camera"):
        checked(content, schema.Camera)


def camera_of(camera: schema.Camera) -> PinholeCamera:
    """Convert intrinsics and lens. Coefficients that are all zero are no lens of Brown and Conrady.

    Args:
        camera: of a request.
    """
    plain = PinholeCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    if camera.distortion_model == "brown_conrady" and not any(camera.distortion):
        return plain
    return replace(plain, distortion=tuple(camera.distortion), distortion_model=camera.distortion_model)


def _prior(prior: schema.Prior) -> Prior:
    if prior.position is not None and prior.wgs84 is not None:
        raise RequestError("prior: position and wgs84 exclude each other; send one of them", field="prior")
    if prior.position is None and prior.wgs84 is None and prior.heading_deg is None:
        raise RequestError("prior: it is empty; send position, wgs84 or heading_deg, or omit prior", field="prior")
    position = prior.position
    std_m = next((known.std_m for known in (position, prior.wgs84) if known is not None), POSITION_STD_M)
    return Prior(
        position_m=None if position is None else np.array([position.x, position.y]),
        position_std_m=std_m,
        heading_rad=None if prior.heading_deg is None else math.radians(prior.heading_deg),
        heading_std_rad=math.radians(prior.heading_std_deg),
    )


def _wgs84(prior: schema.Prior | None) -> tuple[float, float] | None:
    return None if prior is None or prior.wgs84 is None else (prior.wgs84.latitude_deg, prior.wgs84.longitude_deg)


def _hypotheses(answer: Answer) -> list[schema.HypothesisOfPose]:
    candidates = distinct_candidates(answer.candidates or ())
    return [
        schema.HypothesisOfPose(
            confirmed=answer.status == "LOCALIZED" and number == 0,
            pose=_pose(each.T_map_camera, heading_of_camera(each.T_map_camera), each.covariance),
            share=float(share),
            inliers=each.registered.inliers,
            similarity=each.scores["similarity"],
        )
        for number, (each, share) in enumerate(zip(candidates, shares_of(candidates, answer.frames), strict=True))
    ]


def _belief(belief: Belief, epoch: int, sealed: bytes | None) -> schema.Belief:
    return schema.Belief(
        epoch=epoch,
        modes=[
            schema.Mode(
                pose=_pose(mode.T_map_camera, heading_of_camera(mode.T_map_camera), mode.covariance),
                weight=mode.weight,
                number=mode.number,
                unseen=mode.unseen,
            )
            for mode in belief.modes
        ],
        elsewhere=belief.elsewhere,
        outside=belief.outside,
        token=None if sealed is None else base64.urlsafe_b64encode(sealed).rstrip(b"=").decode(),
    )


def _spread(spread: Spread) -> schema.Spread:
    return schema.Spread(
        mean=_vector(spread.mean_m),
        covariance=spread.covariance.reshape(-1).tolist(),
        heading_std_deg=math.degrees(spread.heading_std_rad),
        hypotheses_weight=spread.hypotheses_weight,
    )


def _reason(reason: Reason) -> schema.Reason:
    return schema.Reason(check=reason.check, evidence=dict(reason.evidence), remedy=reason.remedy)


def _direction(vector: schema.Direction, field: str) -> NDArray[np.float64]:
    direction = np.array([vector.x, vector.y, vector.z])
    length = math.hypot(*direction)
    if not 1e-6 < length < 1e9:
        raise RequestError(
            f"{field}: a vector of length {length:g} has no direction; send the vector of the accelerometer",
            field=field,
        )
    return direction / length


def _down(gravity: schema.Direction) -> NDArray[np.float64]:
    """Return the direction of gravity. If it lies along the optical axis, there is no heading to localize."""
    down = _direction(gravity, "gravity")
    if abs(down[2]) > np.cos(np.deg2rad(20.0)):
        raise RequestError(
            f"gravity: ({down[0]:.2f}, {down[1]:.2f}, {down[2]:.2f}) means that the camera looks straight up or down; "
            "send gravity in the camera frame: x right, y down, z forward",
            field="gravity",
        )
    return down


def transform_of(transform: schema.RigidTransform, name: str) -> NDArray[np.float64]:
    """Return a rigid transform as a 4x4 matrix, translation in metres.

    Args:
        transform: of the contract.
        name: path of its field, for the error.

    Raises:
        RequestError: the quaternion is not a rotation.
    """
    q, p = transform.orientation, transform.position
    quaternion = np.array([q.x, q.y, q.z, q.w])
    length = math.hypot(*quaternion)  # hypot does not overflow for components of 1e200
    if not 1e-6 < length < 1e9:
        field = f"{name}.orientation"
        raise RequestError(
            f"{field}: a quaternion of length {length:g} is not a valid rotation; send a unit quaternion", field=field
        )
    return transform_from(rotation_from_quaternion_xyzw(quaternion), np.array([p.x, p.y, p.z]))


def _street(answer: Answer, bundle: Map) -> schema.Street | None:
    if answer.vote is None or bundle.streets is None or answer.street < 0:
        return None
    street = bundle.streets[answer.street]
    voted = dict(answer.vote.shares).get(answer.street, 0.0)
    return schema.Street(
        id=street.id,
        name=street.name,
        street=street.street,
        section=street.section,
        class_index=street.class_index,
        vote=min(1.0, voted),
    )


def _vehicle_pose(answer: Answer) -> schema.Pose | None:
    T = answer.T_map_vehicle_guess
    if T is None:
        return None
    about_camera, camera_m = answer.covariance, answer.T_map_camera_guess[:3, 3]
    covariance = None if about_camera is None else covariance_at(about_camera, camera_m, T[:3, 3])
    return _pose(T, heading_of_body(T), covariance)


def _pose(T: NDArray[np.float64], heading_rad: float, covariance: NDArray[np.float64] | None) -> schema.Pose:
    x, y, z, w = quaternion_xyzw_from(T[:3, :3]).tolist()
    return schema.Pose(
        position=_vector(T[:3, 3]),
        orientation=schema.Quaternion(x=x, y=y, z=z, w=w),
        heading_deg=_degrees(heading_rad),
        covariance=None if covariance is None else covariance.reshape(-1).tolist(),
    )


def _neighbour(neighbour: Neighbour, bundle: Map) -> schema.Neighbour:
    named = bundle.streets is not None and neighbour.street >= 0
    return schema.Neighbour(
        place=neighbour.place,
        distance=neighbour.distance,
        similarity=neighbour.similarity,
        street=bundle.streets[neighbour.street].id if named and bundle.streets is not None else None,
        position=_vector(neighbour.position_m),
        heading_deg=_degrees(neighbour.heading_rad),
    )


def _vector(position: NDArray[np.float64]) -> schema.Vector:
    x, y, z = position.tolist()
    return schema.Vector(x=x, y=y, z=z)


def _degrees(angle_rad: float) -> float:
    """Convert radians to degrees in (-180, 180]."""
    found = 180.0 - (180.0 - math.degrees(angle_rad)) % 360.0
    return found if found > -180.0 else 180.0
