from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from service.confidence.features import FEATURES
from service.confidence.reasons import reasons_of
from service.errors import BundleError, NoDepthError, RequestError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import heading_of_camera, transform_from
from service.localization.localizer import Localizer
from service.maps.content import BundleContent
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.retrieval.encoder import Encoder
from service.retrieval.knn import StreetVote, distinct_places, search_views
from service.retrieval.prior import Prior
from service.retrieval.query import Query

Pictures = tuple[NDArray[np.uint8], NDArray[np.float32], PinholeCamera]


@pytest.fixture(scope="module")
def localizer(bundle_path: Path) -> Localizer:
    return Localizer.open(MapBundle.open(bundle_path))


@pytest.fixture
def query(pictures: Pictures) -> Query:
    rgb, depth_m, camera = pictures
    return Query(rgb=rgb, depth_m=depth_m, camera=camera)


def test_a_query_finds_the_place_where_it_was_taken(localizer: Localizer, query: Query) -> None:
    answer = localizer.localize(query)
    assert answer.neighbours[0].place == 8
    assert answer.neighbours[0].similarity == pytest.approx(1, abs=1e-5)
    assert answer.neighbours[0].distance == pytest.approx(0, abs=5e-3)
    assert answer.vote is not None
    assert (answer.status, answer.vote.street) == ("LOCALIZED", 2)


def test_without_registration_the_pose_stands_at_the_place_at_the_cameras_own_height(
    localizer: Localizer, query: Query
) -> None:
    answer = localizer.localize(replace(query, refine=False))
    assert (answer.covariance, answer.candidates, answer.evidence, answer.timings.register_ms) == (
        None,
        None,
        None,
        0.0,
    )
    assert answer.street == answer.hypotheses[0].street == 2
    # The place's LiDAR is at (20, 100, 2), 1.8 m above the ground; the camera 1.5 m.
    np.testing.assert_allclose(answer.T_map_camera_guess[:3, 3], [20, 100, 0.2 + answer.height_m], atol=0.05)
    assert answer.height_m == pytest.approx(1.5, abs=0.05)
    assert np.rad2deg(heading_of_camera(answer.T_map_camera_guess)) == pytest.approx(90, abs=1)


def test_with_registration_the_pose_is_where_the_picture_was_taken(localizer: Localizer, query: Query) -> None:
    answer = localizer.localize(query)
    assert answer.candidates is not None
    assert answer.covariance is not None
    assert answer.candidates[0].registered.inliers > 0.8
    np.testing.assert_array_equal(answer.candidates[0].T_map_camera, answer.T_map_camera_guess)
    np.testing.assert_allclose(answer.T_map_camera_guess[:3, 3], [20, 100, 1.7], atol=0.3)
    assert np.rad2deg(heading_of_camera(answer.T_map_camera_guess)) == pytest.approx(90, abs=1)
    np.testing.assert_allclose(answer.covariance, answer.covariance.T)
    assert (np.linalg.eigvalsh(answer.covariance) > 0).all()


def test_the_registered_position_determines_the_street(
    content_of: Callable[..., BundleContent], content: BundleContent, tmp_path: Path, query: Query
) -> None:
    """All places are in street 0. The position of the query is in street 2."""
    write_bundle(tmp_path / "m", content_of(place_street=np.zeros(12, np.int32)))
    localizer = Localizer.open(MapBundle.open(tmp_path / "m"))
    registered, voted = (localizer.localize(replace(query, refine=refine)) for refine in (True, False))
    assert (registered.street, voted.street) == (2, 0)


def test_without_registration_the_heaviest_cluster_determines_the_street(
    localizer: Localizer, query: Query, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Places on both sides of a street border disagree. A cluster lies on one side."""
    outvoted = StreetVote(street=1, share=0.6, shares=((1, 0.6), (2, 0.4)))
    monkeypatch.setattr("service.retrieval.retrieve.vote", lambda *_: outvoted)
    answer = localizer.localize(replace(query, refine=False))
    assert answer.vote is outvoted
    assert answer.street == answer.hypotheses[0].street == 2


def test_a_map_without_a_cloud_answers_by_retrieval(
    content_of: Callable[..., BundleContent], tmp_path: Path, query: Query
) -> None:
    write_bundle(tmp_path / "m", content_of(cloud=None))
    answer = Localizer.open(MapBundle.open(tmp_path / "m")).localize(query)
    assert answer.covariance is None
    assert answer.neighbours[0].place == 8


def test_the_camera_axis_lies_level_where_the_camera_is_level(localizer: Localizer, query: Query) -> None:
    R_map_camera = localizer.localize(query).T_map_camera_guess[:3, :3]
    np.testing.assert_allclose(R_map_camera.T @ R_map_camera, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(R_map_camera[:, 1], [0, 0, -1], atol=0.02)


def test_the_vehicles_pose_follows_from_where_the_camera_sits(localizer: Localizer, query: Query) -> None:
    T_vehicle_camera = transform_from(np.eye(3), np.array([1.0, 0.0, 0.5]))
    answer = localizer.localize(replace(query, T_vehicle_camera=T_vehicle_camera))
    assert answer.T_map_vehicle_guess is not None
    np.testing.assert_allclose(answer.T_map_vehicle_guess @ T_vehicle_camera, answer.T_map_camera_guess, atol=1e-9)
    assert localizer.localize(query).T_map_vehicle_guess is None


@pytest.mark.parametrize("k", [1, 5, 12])
def test_neighbours_are_distinct_places_the_best_first(localizer: Localizer, query: Query, k: int) -> None:
    neighbours = localizer.localize(replace(query, neighbours=k, refine=False)).neighbours
    similarities = [each.similarity for each in neighbours]
    assert len({each.place for each in neighbours}) == k
    assert similarities == sorted(similarities, reverse=True)


def test_registered_places_come_first_and_no_place_is_lost(localizer: Localizer, query: Query) -> None:
    retrieved = localizer.localize(replace(query, neighbours=12, refine=False)).neighbours
    answer = localizer.localize(replace(query, neighbours=12))
    away = [np.hypot(*(each.position_m[:2] - answer.T_map_camera_guess[:2, 3])) for each in answer.neighbours]
    assert away[0] == min(away)
    assert {each.place for each in answer.neighbours} == {each.place for each in retrieved}


def test_more_neighbours_than_places_gives_every_place(localizer: Localizer, query: Query) -> None:
    assert len(localizer.localize(replace(query, neighbours=50)).neighbours) == 12


def test_distinct_places_agree_with_a_slow_loop(localizer: Localizer, query: Query) -> None:
    bundle = localizer.bundle
    descriptor = np.random.default_rng(5).normal(size=16).astype(np.float32)
    matches = search_views(
        bundle, (descriptor / np.linalg.norm(descriptor))[None], turns_rad=(0.0,), places=7, fewest=1
    )
    slow: list[int] = []
    for place in matches.place.tolist():
        if place not in slow:
            slow.append(place)
    assert [each.place for each in distinct_places(matches, 7)] == slow[:7]


def test_a_map_without_streets_has_no_vote(
    content_of: Callable[..., BundleContent], tmp_path: Path, query: Query
) -> None:
    write_bundle(tmp_path / "m", content_of(streets=None, place_street=np.full(12, -1, np.int32)))
    assert Localizer.open(MapBundle.open(tmp_path / "m")).localize(query).vote is None


def test_another_encoder_is_refused(bundle_path: Path, encoder_of: Callable[..., bytes]) -> None:
    with pytest.raises(BundleError, match="use the encoder of the bundle"):
        Localizer(MapBundle.open(bundle_path), Encoder.open(encoder_of(seed=99)))


def test_an_encoder_of_another_view_grid_is_refused(
    content_of: Callable[..., BundleContent], content: BundleContent, tmp_path: Path
) -> None:
    taller = replace(content.grid, rows=9)
    write_bundle(tmp_path / "m", content_of(grid=taller, rows_seen=np.ones(9, np.bool_)))
    with pytest.raises(BundleError, match="reads views of 8 x 16 cells, but those of the map have 9 x 16"):
        Localizer.open(MapBundle.open(tmp_path / "m"))


def test_no_depth_is_an_error_of_its_own(localizer: Localizer, query: Query) -> None:
    with pytest.raises(NoDepthError):
        localizer.localize(replace(query, depth_m=np.zeros_like(query.depth_m)))


def test_the_stages_times_sum_to_the_total(localizer: Localizer, query: Query) -> None:
    times = localizer.localize(query).timings
    stages = (times.fuse_ms, times.encode_ms, times.search_ms, times.register_ms)
    assert sum(stages) == pytest.approx(times.total_ms)
    assert min(stages) > 0


def test_a_view_found_at_two_turns_is_kept_once_at_the_better_one_and_its_heading_less_that_turn(bundle_path):
    bundle = MapBundle.open(bundle_path)
    rng = np.random.default_rng(7)
    descriptors = rng.normal(size=(2, bundle.manifest.counts.descriptor_size)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    turns = (-0.1, 0.1)
    matches = search_views(bundle, descriptors, turns_rad=turns, places=3, fewest=bundle.manifest.counts.views)
    assert len(np.unique(matches.view)) == len(matches) == bundle.manifest.counts.views
    assert (np.diff(matches.similarity) <= 0).all()
    by_turn = bundle.view_index.vectors(np.arange(bundle.manifest.counts.views)) @ descriptors.T
    for view, similarity, heading in zip(matches.view, matches.similarity, matches.heading_rad, strict=True):
        each = by_turn[view].tolist()
        assert similarity == pytest.approx(max(each), abs=1e-6)
        assert heading == pytest.approx(float(bundle.view_heading_rad[view]) - turns[int(np.argmax(each))])


def test_the_evidence_has_a_number_for_every_feature(localizer: Localizer, query: Query) -> None:
    answer = localizer.localize(query)
    assert answer.evidence is not None
    assert answer.evidence.shape == (len(FEATURES),)
    assert np.isfinite(answer.evidence).all()
    assert answer.candidates is not None
    assert answer.evidence[FEATURES.index("inliers")] == answer.candidates[0].registered.inliers


def test_a_map_that_is_not_calibrated_answers_without_confidence(localizer: Localizer, query: Query) -> None:
    answer = localizer.localize(query)
    assert (answer.status, answer.confidence, answer.reasons) == ("LOCALIZED", None, ())


@pytest.mark.parametrize(("rate", "status"), [(0.01, "LOCALIZED"), (0.001, "AMBIGUOUS")])
def test_a_calibrated_map_says_how_sure_it_is_and_accepts_by_the_rate_asked_for(
    content_of: Callable[..., BundleContent],
    calibration_json: Callable[..., dict[str, Any]],
    tmp_path: Path,
    query: Query,
    rate: float,
    status: str,
) -> None:
    """All queries get 0.5: the threshold for a rate of 1 %, and below the 0.9 for 0.1 %."""
    write_bundle(tmp_path / "m", content_of(calibration=calibration_json()))
    localizer = Localizer.open(MapBundle.open(tmp_path / "m"))
    answer = localizer.localize(replace(query, false_accept_rate=rate))
    assert (answer.status, answer.confidence) == (status, 0.5)
    assert answer.evidence is not None
    assert localizer.bundle.calibration is not None
    out_of_range = reasons_of(localizer.bundle.calibration, answer.evidence)
    assert out_of_range  # of a calibration whose means are all 0
    assert answer.reasons == (() if status == "LOCALIZED" else out_of_range)
    retrieved = localizer.localize(replace(query, false_accept_rate=rate, refine=False))
    assert (retrieved.status, retrieved.confidence, retrieved.reasons) == ("LOCALIZED", None, ())


@pytest.fixture
def calibrated(
    content_of: Callable[..., BundleContent], calibration_json: Callable[..., dict[str, Any]], tmp_path: Path
) -> Localizer:
    """Return a map with a calibration that gives 0.5 for all features."""
    write_bundle(tmp_path / "m", content_of(calibration=calibration_json()))
    return Localizer.open(MapBundle.open(tmp_path / "m"))


def test_fewer_false_accepts_than_calibration_measured_are_not_promised(calibrated: Localizer, query: Query) -> None:
    assert calibrated.bundle.calibration is not None
    least = calibrated.bundle.calibration.least_false_accept_rate
    with pytest.raises(RequestError, match=rf"send {least:g} or more") as caught:
        calibrated.localize(replace(query, false_accept_rate=0.5 * least))
    assert caught.value.field == "options.false_accept_rate"
    assert calibrated.localize(replace(query, false_accept_rate=least)).confidence is not None
    # Without registration there is no confidence, so nothing is promised.
    assert calibrated.localize(replace(query, false_accept_rate=0.5 * least, refine=False)).confidence is None


def test_a_calibrated_map_believes_nothing_of_a_picture_that_is_too_empty_to_register(
    calibrated: Localizer, query: Query
) -> None:
    few = np.zeros_like(query.depth_m)
    few[20:23, 20:24] = query.depth_m[20:23, 20:24]
    answer = calibrated.localize(replace(query, depth_m=few))
    assert (answer.status, answer.confidence, answer.evidence, answer.candidates) == ("OUT_OF_MAP", 0.0, None, None)
    assert [reason.check for reason in answer.reasons] == ["depth"]


def test_one_frame_of_a_sequence_is_answered_like_a_single_query(localizer: Localizer, query: Query) -> None:
    alone, sequence = localizer.localize(query), localizer.localize_frames((query,), (np.eye(4),))
    np.testing.assert_array_equal(sequence.T_map_camera_guess, alone.T_map_camera_guess)
    np.testing.assert_array_equal(sequence.evidence, alone.evidence)


def test_a_sequence_is_answered_with_the_pose_of_its_first_frame(localizer: Localizer, query: Query) -> None:
    """The second frame was taken 5 m behind the first, at the same place. So the first is 5 m ahead."""
    behind = transform_from(np.eye(3), np.array([0.0, 0.0, -5.0]))
    few = np.zeros_like(query.depth_m)
    few[20:23, 20:24] = query.depth_m[20:23, 20:24]  # enough to be looked up, nothing to register
    answer = localizer.localize_frames((replace(query, depth_m=few), query), (np.eye(4), behind))
    np.testing.assert_allclose(localizer.localize(query).T_map_camera_guess[:2, 3], [20, 100], atol=0.3)
    np.testing.assert_allclose(answer.T_map_camera_guess[:2, 3], [20, 105], atol=0.3)


def test_a_sequence_needs_a_pose_for_every_frame(localizer: Localizer, query: Query) -> None:
    with pytest.raises(ValueError, match="zip"):
        localizer.localize_frames((query, query), (np.eye(4),))


def test_a_prior_that_is_wrong_does_not_move_a_pose_that_the_pictures_are_sure_of(
    localizer: Localizer, query: Query
) -> None:
    alone = localizer.localize(query)
    for wrong in (
        Prior(position_m=np.array([20.0, 0.0]), position_std_m=1.0, heading_rad=np.pi / 2),
        Prior(position_m=np.array([-1e6, 1e6]), position_std_m=0.1),
        Prior(heading_rad=-np.pi / 2, heading_std_rad=0.01),
    ):
        answer = localizer.localize(replace(query, prior=wrong))
        np.testing.assert_allclose(answer.T_map_camera_guess, alone.T_map_camera_guess, atol=1e-9)
        assert answer.covariance is not None
        assert alone.covariance is not None
        np.testing.assert_allclose(answer.covariance, alone.covariance, atol=1e-9)


@pytest.mark.parametrize("y", [0.0, 90.0])
def test_a_prior_decides_between_identical_streets(twin_map: Path, query: Query, y: float) -> None:
    localizer = Localizer.open(MapBundle.open(twin_map))
    known = Prior(position_m=np.array([15.0, y + 5.0]), position_std_m=10.0)
    answer = localizer.localize(replace(query, prior=known))
    np.testing.assert_allclose(answer.T_map_camera_guess[:3, 3], [20, y, 1.7], atol=0.3)


def test_a_prior_that_is_wrong_lends_a_wrong_pose_no_confidence(
    content_of: Callable[..., BundleContent],
    calibration_json: Callable[..., dict[str, Any]],
    tmp_path: Path,
    query: Query,
) -> None:
    """Confidence rises with the margin over rivals. A prior elsewhere changes neither the answer nor its confidence."""
    document = calibration_json()
    for part in ("right", "known"):
        document[part]["terms"] = [{"feature": "margin", "knots": [-4.0, 4.0], "log_odds": [-12.0, 12.0]}]
    write_bundle(tmp_path / "m", content_of(calibration=document))
    localizer = Localizer.open(MapBundle.open(tmp_path / "m"))
    alone = localizer.localize(query)
    assert alone.confidence is not None
    for position in ([20.0, 0.0], [60.0, 100.0], [-1e6, 1e6]):
        wrong = Prior(position_m=np.array(position), position_std_m=1.0, heading_rad=-np.pi / 2, heading_std_rad=0.1)
        answer = localizer.localize(replace(query, prior=wrong))
        np.testing.assert_allclose(answer.T_map_camera_guess, alone.T_map_camera_guess, atol=1e-9)
        assert answer.confidence is not None
        assert answer.confidence <= alone.confidence
        assert answer.status in (alone.status, "AMBIGUOUS", "OUT_OF_MAP")


@pytest.mark.parametrize("y", [0.0, 90.0])
def test_a_prior_decides_without_registration_too(twin_map: Path, query: Query, y: float) -> None:
    localizer = Localizer.open(MapBundle.open(twin_map))
    known = Prior(position_m=np.array([15.0, y + 5.0]), position_std_m=10.0)
    answer = localizer.localize(replace(query, prior=known, refine=False))
    np.testing.assert_allclose(answer.T_map_camera_guess[:2, 3], [20, y], atol=0.3)
    assert answer.street == answer.hypotheses[0].street
    apart = np.linalg.norm(answer.hypotheses[0].position_m[:2] - [20, y])
    assert apart < 1.0


def test_a_prior_far_from_everything_leaves_retrieval_as_it_was(localizer: Localizer, query: Query) -> None:
    alone = localizer.localize(replace(query, refine=False))
    lost = Prior(position_m=np.array([-1e6, 1e6]), position_std_m=0.1)
    answer = localizer.localize(replace(query, refine=False, prior=lost))
    np.testing.assert_array_equal(answer.T_map_camera_guess, alone.T_map_camera_guess)


@pytest.mark.parametrize("seed", [4, 6, 8, 10])
def test_a_prior_in_a_street_that_looks_the_same_but_measures_otherwise_does_not_win(
    streets_alike: Callable[..., Path], query: Query, seed: int
) -> None:
    """In the first street, 90 m away, at most half of the depth fits the map. At the true place, all depth fits."""
    localizer = Localizer.open(MapBundle.open(streets_alike(seed_of_first=seed)))
    for wrong in (None, Prior(position_m=np.array([20.0, 0.0]), position_std_m=10.0)):
        answer = localizer.localize(replace(query, prior=wrong))
        np.testing.assert_allclose(answer.T_map_camera_guess[:2, 3], [20, 90], atol=0.3)
