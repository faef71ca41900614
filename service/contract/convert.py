"""Between the REST contract and the core's types; no arithmetic but degrees."""

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from service.errors import NotYetSupportedError, RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import (
    heading_of_body,
    heading_of_camera,
    quaternion_xyzw_from,
    rotation_from_quaternion_xyzw,
    transform_from,
)
from service.http import schema
from service.http.problems import request_error_from
from service.localization.answer import Answer
from service.localization.evidence import distinct_candidates
from service.localization.prior import Prior
from service.localization.search import Neighbour
from service.maps.reader import MapBundle
from service.runtime.engine import EncodedQuery, Located

_PARTS = ("rgb", "depth", "request")


def query_from_parts(parts: dict[str, bytes]) -> EncodedQuery:
    """Check the parts and the JSON among them.

    Raises:
        RequestError: a part is missing or unknown, or a field of the JSON makes no sense.
        NotYetSupportedError: a field that this release cannot use.
    """
    for name in _PARTS:
        if name not in parts:
            raise RequestError(f"the part {name!r} is missing; send the parts rgb, depth and request", field=name)
    if unknown := sorted(set(parts) - set(_PARTS)):
        raise RequestError(
            f"the part {unknown[0]!r} is unknown; send the parts rgb, depth and request", field=unknown[0]
        )
    try:
        request = schema.LocalizeRequest.model_validate_json(parts["request"])
    except ValidationError as error:
        raise request_error_from(error.errors(include_url=False, include_input=False, include_context=False)) from error
    _require_supported(request)
    return EncodedQuery(
        rgb=parts["rgb"],
        depth=parts["depth"],
        map_name=request.map,
        camera=_camera(request.camera),
        depth_encoding=request.depth.encoding,
        depth_kind=request.depth.kind,
        scale_m=request.depth.scale_m,
        baseline_m=request.depth.baseline_m,
        max_range_m=request.depth.max_range_m,
        down_camera=None if request.gravity is None else _down(request.gravity),
        T_vehicle_camera=None if request.T_vehicle_camera is None else _transform(request.T_vehicle_camera),
        neighbours=request.options.neighbours,
        refine=request.options.refine,
        prior=None if request.prior is None else _prior(request.prior),
        prior_wgs84=_wgs84(request.prior),
        false_accept_rate=request.options.false_accept_rate,
    )


def answer_from(located: Located) -> schema.LocalizeAnswer:
    """The answer as the contract says it."""
    answer, bundle = located.answer, located.bundle
    times = answer.timings
    return schema.LocalizeAnswer(
        status=answer.status,
        confidence=answer.confidence,
        street=_street(answer, bundle),
        pose=_pose(answer.T_map_camera, heading_of_camera(answer.T_map_camera), answer.covariance),
        vehicle_pose=None
        if answer.T_map_vehicle is None
        else _pose(answer.T_map_vehicle, heading_of_body(answer.T_map_vehicle), None),
        geopose=None,
        hypotheses=_hypotheses(answer),
        neighbours=[_neighbour(each, bundle) for each in answer.neighbours],
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


def map_entry_from(bundle: MapBundle) -> schema.MapEntry:
    """A mounted map as the contract says it."""
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
    )


def _require_supported(request: schema.LocalizeRequest) -> None:
    if any(request.camera.distortion):
        raise NotYetSupportedError(
            "camera.distortion: this release reads rectified pictures only; rectify both and send no distortion",
            field="camera.distortion",
        )


def _camera(camera: schema.Camera) -> PinholeCamera:
    return PinholeCamera(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def _prior(prior: schema.Prior) -> Prior:
    if prior.position is not None and prior.wgs84 is not None:
        raise RequestError("prior: position and wgs84 say the same thing; send one of them", field="prior")
    if prior.position is None and prior.wgs84 is None and prior.heading_deg is None:
        raise RequestError(
            "prior: it says nothing; send position, wgs84 or heading_deg, or leave it out", field="prior"
        )
    position = prior.position
    std_m = next((known.std_m for known in (position, prior.wgs84) if known is not None), 20.0)
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
    if not candidates:
        return []
    support = np.array([candidate.support for candidate in candidates])
    shares = np.exp(support - support.max())
    shares /= shares.sum()
    return [
        schema.HypothesisOfPose(
            pose=_pose(each.T_map_camera, heading_of_camera(each.T_map_camera), None), share=float(share),
            inliers=each.registered.inliers, similarity=each.similarity,
        )
        for each, share in zip(candidates, shares, strict=True)
    ]  # fmt: skip


def _direction(vector: schema.Vector, field: str) -> NDArray[np.float64]:
    direction = np.array([vector.x, vector.y, vector.z])
    length = float(np.linalg.norm(direction))
    if not 1e-6 < length < 1e9:
        raise RequestError(
            f"{field}: a vector of length {length:g} has no direction; send the accelerometer's", field=field
        )
    return direction / length


def _down(gravity: schema.Vector) -> NDArray[np.float64]:
    """Gravity's direction; along the optical axis it leaves no heading to localize."""
    down = _direction(gravity, "gravity")
    if abs(down[2]) > np.cos(np.deg2rad(20.0)):
        raise RequestError(
            f"gravity: ({down[0]:.2f}, {down[1]:.2f}, {down[2]:.2f}) says that the camera looks straight up or down; "
            "send it in the camera frame: x right, y down, z forward", field="gravity",
        )  # fmt: skip
    return down


def _transform(transform: schema.RigidTransform) -> NDArray[np.float64]:
    q, p = transform.orientation, transform.position
    quaternion = np.array([q.x, q.y, q.z, q.w])
    length = float(np.linalg.norm(quaternion))
    if not 1e-6 < length < 1e9:
        field = "T_vehicle_camera.orientation"
        raise RequestError(f"{field}: a quaternion of length {length:g} is no rotation; send a unit one", field=field)
    return transform_from(rotation_from_quaternion_xyzw(quaternion), np.array([p.x, p.y, p.z]))


def _street(answer: Answer, bundle: MapBundle) -> schema.Street | None:
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


def _pose(T: NDArray[np.float64], heading_rad: float, covariance: NDArray[np.float64] | None) -> schema.Pose:
    x, y, z, w = quaternion_xyzw_from(T[:3, :3]).tolist()
    return schema.Pose(
        position=_vector(T[:3, 3]),
        orientation=schema.Quaternion(x=x, y=y, z=z, w=w),
        heading_deg=_degrees(heading_rad),
        covariance=None if covariance is None else covariance.reshape(-1).tolist(),
    )


def _neighbour(neighbour: Neighbour, bundle: MapBundle) -> schema.Neighbour:
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
    """In (-180, 180]."""
    return 180.0 - (180.0 - math.degrees(angle_rad)) % 360.0
