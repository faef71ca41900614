import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from service.confidence.spread import Spread
from service.contract import convert, schema
from service.contract.convert import answer_from, parsed, query_from, sequence_from
from service.contract.schema import LocalizeRequest, SequenceRequest
from service.errors import RequestError
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.imaging.level import GivenHeight
from service.localization.localizer import Localizer
from service.maps.calibration import Threshold
from service.maps.reader import MapBundle
from service.registration.register import Registered
from service.retrieval.prior import Prior
from service.retrieval.query import Query
from service.runtime.engine import Located
from service.scoring.candidates import Candidate

BOTH = {"position": {"x": 1, "y": 2}, "wgs84": {"latitude_deg": 0, "longitude_deg": 0}}


@pytest.fixture
def camera_document():
    return {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}


def query_of(parts):
    return query_from(parsed(parts["request"], LocalizeRequest), rgb=parts["rgb"], depth=parts["depth"])


@pytest.fixture
def prior_of(parts_of):
    """Return the prior that the JSON of a request describes, and its degrees."""

    def made(prior):
        encoded = query_of(parts_of(prior=prior))
        return encoded.prior, encoded.prior_wgs84

    return made


@pytest.mark.parametrize("far", [1.1e5, 1.7e308])
def test_a_transform_beyond_any_robot_is_refused(parts_of, far):
    T = {"position": {"x": far, "y": 0, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    with pytest.raises(RequestError) as caught:
        query_of(parts_of(T_vehicle_camera=T))
    assert caught.value.field == "T_vehicle_camera.position.x"


@pytest.mark.parametrize(
    ("field", "focal", "degrees"), [("fx", 0.5, 178), ("fy", 0.95, 175), ("fy", 0.05, 180), ("fx", 1.27, 175)]
)
def test_a_focal_length_that_is_not_in_pixels_is_refused(camera_document, field, focal, degrees):
    with pytest.raises(
        RequestError, match=f"field of view of {degrees} degrees; send the focal length in pixels"
    ) as caught:
        parsed(json.dumps({"camera": camera_document | {field: focal}}).encode(), LocalizeRequest)
    assert caught.value.field == f"camera.{field}"


def test_a_camera_of_nearly_175_degrees_is_taken(camera_document):
    wide = parsed(json.dumps({"camera": camera_document | {"fx": 1.28, "fy": 0.96}}).encode(), LocalizeRequest)
    assert (wide.camera.fx, wide.camera.fy) == (1.28, 0.96)


def test_a_refused_width_is_the_only_error(camera_document):
    with pytest.raises(RequestError) as caught:
        parsed(json.dumps({"camera": camera_document | {"width": 0}}).encode(), LocalizeRequest)
    assert caught.value.field == "camera.width"


@pytest.mark.parametrize(
    ("angle", "expected"),
    [(np.pi, 180.0), (-np.pi, 180.0), (np.nextafter(np.pi, 4), 180.0), (0.0, 0.0), (3 * np.pi / 2, -90.0)],
)
def test_headings_end_at_180(angle, expected):
    found = convert._degrees(angle)
    assert found == pytest.approx(expected)
    assert -180 < found <= 180


def test_a_request_without_a_prior_has_none(parts_of):
    encoded = query_of(parts_of())
    assert (encoded.prior, encoded.prior_wgs84, encoded.false_accept_rate) == (None, None, None)


def test_a_position_and_a_heading_are_taken_in_metres_and_radians(prior_of):
    prior, wgs84 = prior_of(
        {"position": {"x": 12, "y": -40, "std_m": 5}, "heading_deg": 90, "heading_std_deg": 18},
    )
    np.testing.assert_array_equal(prior.position_m, [12, -40])
    assert (prior.position_std_m, prior.heading_rad, prior.heading_std_rad) == pytest.approx((5, np.pi / 2, np.pi / 10))
    assert wgs84 is None


@pytest.mark.parametrize("given", [{"position": {"x": 1, "y": 2}}, {"heading_deg": 0}])
def test_missing_fields_of_a_prior_have_defaults(prior_of, given):
    prior, _ = prior_of(given)
    unsaid = Prior()
    assert (prior.position_std_m, prior.heading_std_rad) == pytest.approx(
        (unsaid.position_std_m, unsaid.heading_std_rad)
    )
    assert (prior.position_m is None) == ("position" not in given)
    assert (prior.heading_rad is None) == ("heading_deg" not in given)


def test_degrees_on_the_earth_wait_for_the_map(prior_of):
    prior, wgs84 = prior_of({"wgs84": {"latitude_deg": 52.5, "longitude_deg": 13.25, "std_m": 3}, "heading_deg": 180})
    assert wgs84 == (52.5, 13.25)
    assert (prior.position_m, prior.position_std_m, prior.heading_rad) == (None, 3.0, np.pi)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (BOTH, "prior: position and wgs84 exclude each other; send one of them"),
        (BOTH | {"heading_deg": 0}, "prior: position and wgs84 exclude each other; send one of them"),
        ({}, "prior: it is empty; send position, wgs84 or heading_deg, or omit prior"),
        ({"heading_std_deg": 3}, "prior: it is empty; send position, wgs84 or heading_deg, or omit prior"),
        (
            {"position": None, "heading_deg": None},
            "prior: it is empty; send position, wgs84 or heading_deg, or omit prior",
        ),
    ],
)
def test_an_overcomplete_or_empty_prior_is_refused(prior_of, prior, message):
    with pytest.raises(RequestError) as error:
        prior_of(prior)
    assert (error.value.message, error.value.field) == (message, "prior")


def test_a_rate_of_false_accepts_is_passed_on(parts_of):
    assert query_of(parts_of(options={"false_accept_rate": 0.02})).false_accept_rate == 0.02


@pytest.fixture(scope="module")
def localized(bundle_path, pictures):
    bundle = MapBundle.open(bundle_path)
    rgb, depth_m, camera = pictures
    return Located(Localizer.open(bundle).localize(Query(rgb=rgb, depth_m=depth_m, camera=camera)), bundle)


def candidate(support, *, xyz, heading_deg=0.0):
    R, at = rotation_z(np.deg2rad(heading_deg)), np.array(xyz, np.float64)
    registered = Registered(R, at, 1.0, 0.0, 0.7, np.eye(8), 0)
    return Candidate(transform_from(R @ R_BODY_OPTICAL, at), registered, {"similarity": 0.8}, support)


def hypotheses_of(localized, *candidates, frames=1):
    answer = replace(localized.answer, candidates=candidates or None, frames=frames)
    return answer_from(replace(localized, answer=answer)).hypotheses


def test_shares_follow_from_the_supports(localized):
    """Supports log 5, log 3 and log 2 plus any constant give shares of 0.5, 0.3 and 0.2."""
    for added in (0.0, -700.0, 1e4):
        several = [candidate(np.log(k) + added, xyz=(100 * k, 0, 1.5)) for k in (5, 3, 2)]
        found = hypotheses_of(localized, *several)
        assert [each.share for each in found] == pytest.approx([0.5, 0.3, 0.2])
        assert [each.pose.position.x for each in found] == [500, 300, 200]


def test_shares_of_several_frames_are_those_that_the_status_follows_from(localized):
    """The mean of four frames has half the noise, so the odds count twice: 5 : 3 becomes 25 : 9."""
    several = [candidate(np.log(k), xyz=(100 * k, 0, 1.5)) for k in (5, 3)]
    found = hypotheses_of(localized, *several, frames=4)
    assert [each.share for each in found] == pytest.approx([25 / 34, 9 / 34])


def test_a_hypothesis_has_its_registered_pose(localized):
    (found,) = hypotheses_of(localized, candidate(3.0, xyz=(1, 2, 1.5), heading_deg=-90))
    assert (found.share, found.inliers, found.similarity) == (1.0, 0.7, 0.8)
    assert found.pose.heading_deg == pytest.approx(-90)
    assert found.pose.covariance is None
    assert found.confirmed


def test_candidates_of_one_place_are_one_hypothesis_the_best_supported_of_it(localized):
    """A candidate at 2.9 m and 29 degrees is the same place. The next one, 2.9 m further, is another place."""
    several = [
        candidate(9.0, xyz=(0, 0, 1.5)),
        candidate(8.9, xyz=(2.9, 0, 1.5), heading_deg=29),
        candidate(8.0, xyz=(5.8, 0, 1.5)),
        candidate(7.5, xyz=(6.0, 0, 1.5)),
        candidate(7.0, xyz=(0, 0, 1.5), heading_deg=180),
    ]
    found = hypotheses_of(localized, *several)
    assert [(each.pose.position.x, round(each.pose.heading_deg)) for each in found] == [(0, 0), (5.8, 0), (0, 180)]
    weights = np.exp([9.0, 8.0, 7.0])
    assert [each.share for each in found] == pytest.approx((weights / weights.sum()).tolist())


def test_without_registration_there_are_no_hypotheses(localized):
    assert hypotheses_of(localized) == []


def test_of_an_answer_the_first_hypothesis_is_its_pose_and_the_shares_are_one(localized):
    answer = answer_from(localized)
    assert answer.hypotheses[0].pose == answer.pose
    assert answer.pose.covariance is not None
    assert [each.confirmed for each in answer.hypotheses] == [True] + [False] * (len(answer.hypotheses) - 1)
    shares = [each.share for each in answer.hypotheses]
    assert sum(shares) == pytest.approx(1)
    assert shares == sorted(shares, reverse=True)


def test_two_equal_streets_are_two_hypotheses_with_equal_shares_without_a_prior(twin_map: Path, pictures):
    """A prior that excludes the other street leaves it the minimum share, e^-5."""
    rgb, depth_m, camera = pictures
    bundle = MapBundle.open(twin_map)
    localizer, query = Localizer.open(bundle), Query(rgb=rgb, depth_m=depth_m, camera=camera)
    alone = answer_from(Located(localizer.localize(query), bundle)).hypotheses
    assert sorted(round(each.pose.position.y / 90) for each in alone[:2]) == [0, 1]
    assert [each.share for each in alone[:2]] == pytest.approx([0.5, 0.5], abs=0.1)
    known = replace(query, prior=Prior(position_m=np.array([20.0, 90.0]), position_std_m=10.0))
    told = answer_from(Located(localizer.localize(known), bundle)).hypotheses
    assert told[0].pose.position.y == pytest.approx(90, abs=0.3)
    elsewhere = sum(each.share for each in told if each.pose.position.y < 45)
    assert elsewhere <= 1.5 * np.exp(-5)


def test_an_answer_is_json(localized):
    assert json.loads(answer_from(localized).model_dump_json(by_alias=True))["hypotheses"][0]["share"] <= 1


@pytest.mark.parametrize("size", [0.0, 1e-300])
def test_vectors_without_a_length_are_refused(size):
    vector = schema.Direction(x=size, y=size, z=size)
    with pytest.raises(RequestError, match="gravity"):
        convert._down(vector)
    quaternion = schema.Quaternion(x=size, y=0.0, z=0.0, w=size)
    origin = schema.Position(x=0.0, y=0.0, z=0.0)
    with pytest.raises(RequestError, match=r"orientation: a quaternion of length"):
        convert.transform_of(schema.RigidTransform(position=origin, orientation=quaternion), "T_vehicle_camera")


def at_height(z_m, x_m=0.0):
    return {"position": {"x": x_m, "y": 0, "z": z_m}, "orientation": {"x": -0.5, "y": 0.5, "z": -0.5, "w": 0.5}}


def test_a_camera_height_is_passed_on_with_its_deviation(parts_of, camera_document):
    assert query_of(parts_of()).camera_height is None
    assert query_of(parts_of(camera=camera_document | {"height_m": 0.3})).camera_height == GivenHeight(0.3, 0.05)
    precise = camera_document | {"height_m": 0.3, "height_std_m": 0.02}
    assert query_of(parts_of(camera=precise)).camera_height == GivenHeight(0.3, 0.02)


@pytest.mark.parametrize(
    "changed", [{"height_m": 0.04}, {"height_m": 31}, {"height_m": 1, "height_std_m": 0}, {"height_std_m": 2.1}]
)
def test_a_height_of_no_camera_is_refused(parts_of, camera_document, changed):
    with pytest.raises(RequestError) as caught:
        query_of(parts_of(camera=camera_document | changed))
    assert caught.value.field == f"camera.{list(changed)[-1]}"


def test_a_vehicle_frame_on_the_ground_gives_the_camera_height(parts_of, camera_document):
    T = at_height(0.42)
    assert query_of(parts_of(T_vehicle_camera=T)).camera_height is None
    assert query_of(parts_of(T_vehicle_camera=T, vehicle_base_on_ground=True)).camera_height == GivenHeight(0.42, 0.1)
    measured = camera_document | {"height_m": 0.45}
    both = parts_of(T_vehicle_camera=T, vehicle_base_on_ground=True, camera=measured)
    assert query_of(both).camera_height == GivenHeight(0.45, 0.05)


@pytest.mark.parametrize(
    ("changed", "field", "remedy"),
    [
        ({}, "vehicle_base_on_ground", "send it, or send camera.height_m instead"),
        (
            {"T_vehicle_camera": at_height(0.0)},
            "T_vehicle_camera.position.z",
            "send T_vehicle_camera of a frame on the ground",
        ),
        ({"T_vehicle_camera": at_height(-1.2)}, "T_vehicle_camera.position.z", "would be -1.2 m above the ground"),
        ({"T_vehicle_camera": at_height(30.5)}, "T_vehicle_camera.position.z", "outside 0.05 to 30 m"),
    ],
)
def test_a_vehicle_frame_without_a_height_is_refused(parts_of, changed, field, remedy):
    frame = make_frame()
    alone = json.dumps(frame | {"vehicle_base_on_ground": True} | changed).encode()
    together = json.dumps({"frames": [frame], "vehicle_base_on_ground": True} | changed).encode()
    for ask in (
        lambda: query_from(parsed(alone, LocalizeRequest), rgb=b"", depth=b""),
        lambda: sequence_from(parsed(together, SequenceRequest), [(b"", b"")]),
    ):
        with pytest.raises(RequestError) as caught:
            ask()
        assert caught.value.field == field
        assert remedy in caught.value.message


def make_frame(**camera):
    return {"camera": {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5} | camera}


def heights_of(frames, **changed):
    document = json.dumps({"frames": frames} | changed).encode()
    queries, _ = sequence_from(parsed(document, SequenceRequest), [(b"", b"")] * len(frames))
    return [query.camera_height for query in queries]


def ahead(right_m, down_m, forward_m):
    position = {"x": right_m, "y": down_m, "z": forward_m}
    return {"T_reference_camera": {"position": position, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}}


def test_each_camera_of_a_sequence_has_its_own_height():
    frames = [make_frame(height_m=0.3), make_frame() | ahead(0, 0, 1), make_frame(height_m=2.0) | ahead(0, -1.7, 0)]
    assert heights_of(frames) == [GivenHeight(0.3, 0.05), None, GivenHeight(2.0, 0.05)]


def test_a_vehicle_frame_on_the_ground_gives_the_heights_of_near_cameras_only():
    """The second camera is 0.2 m below the first one and beside it. The others are too far ahead, or below the ground."""
    frames = [
        make_frame(),
        make_frame() | ahead(0.5, 0.2, 0.5),
        make_frame() | ahead(0, 0, 5),
        make_frame() | ahead(0, 0.5, 0),
    ]
    found = heights_of(frames, T_vehicle_camera=at_height(0.5), vehicle_base_on_ground=True)
    assert found[0] == GivenHeight(0.5, 0.1)
    assert (found[1].height_m, found[1].std_m) == pytest.approx((0.3, 0.1))
    assert found[2:] == [None, None]


def test_an_answer_of_any_status_contains_the_height_and_its_origin(localized):
    found = answer_from(localized).camera_height
    assert found is not None
    assert (found.height_m, found.origin) == (pytest.approx(1.5, abs=0.1), "estimated")
    answer = replace(
        localized.answer, height_m=0.3, height_origin="given", status="AMBIGUOUS", spread=spread_of(localized)
    )
    refused = answer_from(replace(localized, answer=answer))
    assert (refused.pose, refused.camera_height) == (None, schema.CameraHeight(height_m=0.3, origin="given"))


@pytest.mark.parametrize(
    ("confidence", "evidence", "outside", "said"),
    [
        (0.9, np.zeros(3), (), "in_range"),
        (0.9, np.zeros(3), (("front", 5.0),), "extrapolated"),
        (None, np.zeros(3), (), None),  # a map without calibration
        (0.0, None, (), None),  # too few points to register
    ],
)
def test_an_answer_says_whether_its_confidence_is_extrapolated(localized, confidence, evidence, outside, said):
    answer = replace(localized.answer, confidence=confidence, evidence=evidence, extrapolated=outside)
    found = answer_from(replace(localized, answer=answer))
    assert (found.calibration, found.extrapolated) == (said, dict(outside))


@pytest.mark.parametrize(
    ("said", "outside"), [("in_range", {"front": 5.0}), ("extrapolated", {}), (None, {"front": 5.0})]
)
def test_features_stand_with_an_extrapolated_confidence_and_with_no_other(localized, said, outside):
    content = answer_from(localized).model_dump(by_alias=True) | {"calibration": said, "extrapolated": outside}
    with pytest.raises(ValidationError, match="only then"):
        schema.LocalizeAnswer.model_validate(content)


def test_an_answer_states_the_threshold_that_decided(localized):
    assert answer_from(localized).threshold is None  # this map has no calibration
    answer = replace(localized.answer, confidence=0.95, threshold=Threshold(false_accept_rate=0.01, confidence=0.9))
    found = answer_from(replace(localized, answer=answer)).threshold
    assert found == schema.AcceptanceThreshold(confidence=0.9, false_accept_rate=0.01)


def test_an_answer_states_the_correction_for_its_rig(localized):
    assert answer_from(localized).rig_correction is None
    answer = replace(localized.answer, rig_correction="mule")
    assert answer_from(replace(localized, answer=answer)).rig_correction == "mule"


def spread_of(localized):
    return Spread(localized.answer.T_map_camera_guess[:3, 3], np.eye(3), 0.1, 0.5)
