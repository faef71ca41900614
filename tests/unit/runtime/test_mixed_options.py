"""Frames of one stream or sequence with mixed options. Each answer is finite and consistent."""

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from service.confidence.features import FEATURES
from service.contract.convert import answer_from
from service.errors import NotFiniteError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import rotation_y, transform_from
from service.grpc.messages import answer_message
from service.localization import localizer as localizer_module
from service.localization.answer import Answer, require_finite
from service.localization.localizer import Localizer
from service.maps.map import Map
from service.maps.writer import write_bundle
from service.retrieval.prior import Prior
from service.retrieval.query import Query
from service.runtime.engine import EncodedQuery, Engine, Located
from service.runtime.settings import Settings
from service.runtime.stream import Stream

FAR = 1e7
EXAMPLES = 20


@pytest.fixture(scope="module")
def engine(content_of: Any, calibration_json: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    """Return an engine with a calibrated map whose confidence depends on every feature."""
    document = calibration_json()
    weights = np.random.default_rng(1).normal(0, 0.05, len(FEATURES))
    for name in ("right", "known"):
        document[name]["terms"] = [
            {"feature": feature, "knots": [-4.0, 4.0], "log_odds": [-4 * weight, 4 * weight]}
            for feature, weight in zip(FEATURES, weights, strict=True)
        ]
    folder = tmp_path_factory.mktemp("mixed") / "tiny"
    write_bundle(folder, content_of(calibration=document))
    engine = Engine.open(Settings(maps=(folder,), threads=1))
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def localizer(engine: Engine) -> Localizer:
    return engine.registry.get("tiny")


def depths_of(depth_m: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    noise = np.random.default_rng(2).normal(0, 3e-3, depth_m.shape)
    few = np.zeros_like(depth_m)
    few[20:23, 20:24] = depth_m[20:23, 20:24]
    return {
        "exact": depth_m,
        "noisy": (1 / np.maximum(1 / depth_m + noise, 1e-2)).astype(np.float32),
        "millimetres": (np.round(depth_m, 3)).astype(np.float32),
        "constant": np.full_like(depth_m, 4.0),
        "too few": few,
    }


priors = st.one_of(
    st.none(),
    st.builds(
        lambda x, y, std_m: Prior(position_m=np.array([x, y]), position_std_m=std_m),
        st.floats(-FAR, FAR),
        st.floats(-FAR, FAR),
        st.floats(1e-3, 1e6),
    ),
    st.builds(
        lambda heading, std: Prior(heading_rad=heading, heading_std_rad=std),
        st.floats(-2 * math.pi, 2 * math.pi),
        st.floats(math.radians(1e-3), 2 * math.pi),
    ),
)
options = st.fixed_dictionaries(
    {
        "refine": st.booleans(),
        "neighbours": st.integers(1, 50),
        "false_accept_rate": st.floats(0.001, 0.999),
        "prior": priors,
        "baseline_m": st.one_of(st.none(), st.floats(1e-3, 100)),
        "down_camera": st.one_of(
            st.none(), st.just(np.array([0.0, 1.0, 0.0])), st.just(np.array([0.1, 0.9, 0.2]) / math.sqrt(0.86))
        ),
        "T_vehicle_camera": st.one_of(st.none(), st.just(transform_from(rotation_y(0.5), np.array([1e5, -1e5, 2.0])))),
    }
)
depth_names = st.sampled_from(["exact", "noisy", "millimetres", "constant", "too few"])
odometry = st.one_of(
    st.none(),
    st.builds(
        lambda x, z, turn: transform_from(rotation_y(turn), np.array([x, 0.0, z])),
        st.floats(-3, 3),
        st.floats(-1e5, 1e5),
        st.floats(-math.pi, math.pi),
    ),
)


def require_consistent(answer: Answer, query: Any, bundle: Map) -> None:
    """Check that an answer is finite and that its parts are consistent."""
    require_finite(answer)
    assert bundle.calibration is not None
    registered = answer.covariance is not None
    assert registered == (answer.candidates is not None) == (answer.evidence is not None)
    assert (answer.confidence is not None) == query.refine
    assert registered <= query.refine
    if answer.confidence is None:
        assert answer.status == "LOCALIZED"
    else:
        assert 0 <= answer.confidence <= 1
        if answer.status == "LOCALIZED":
            assert registered
            assert answer.confidence >= bundle.calibration.threshold(query.false_accept_rate)
    if answer.covariance is not None:
        np.testing.assert_allclose(answer.covariance, answer.covariance.T)
        assert np.linalg.eigvalsh(answer.covariance).min() > 0
    rotation = answer.T_map_camera_guess[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert (answer.spread is None) == (answer.status == "LOCALIZED")
    located = answer_from(Located(answer, bundle))
    assert (located.pose is None) == (answer.status != "LOCALIZED")
    json.loads(located.model_dump_json(by_alias=True), parse_constant=lambda name: pytest.fail(name))
    assert "nan" not in str(answer_message(located)).lower()


@given(st.lists(st.tuples(options, depth_names, odometry, st.integers(0, 20)), min_size=1, max_size=6))
@settings(
    max_examples=EXAMPLES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
def test_frames_as_a_stream_keeps_them_and_as_a_sequence(localizer: Localizer, pictures: Any, drawn: list[Any]) -> None:
    rgb, depth_m, camera = pictures
    depths = depths_of(depth_m)
    frames: list[Any] = []
    queries, moved = [], []
    for given_options, name, T, ranked in drawn:
        query = Query(rgb=rgb, depth_m=depths[name], camera=camera, ranked=ranked, **given_options)
        frames = [
            localizer.encode_and_search(query),
            *(replace(each, T_reference_camera=np.eye(4)) for each in frames),
        ][:5]
        require_consistent(localizer.answer(tuple(frames)), query, localizer.bundle)
        queries.append(query)
        moved.append(np.eye(4) if T is None or not moved else T)
    answer = localizer.localize_frames(tuple(queries), tuple(moved))
    require_consistent(answer, queries[0], localizer.bundle)


@given(st.lists(st.tuples(options, odometry), min_size=1, max_size=7))
@settings(
    max_examples=EXAMPLES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
)
def test_a_stream_of_an_engine(engine: Engine, parts_of: Callable[..., dict[str, bytes]], drawn: list[Any]) -> None:
    parts, stream = parts_of(), Stream(engine)
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    for given_options, T in drawn:
        encoded = EncodedQuery(rgb=parts["rgb"], depth=parts["depth"], camera=camera, scale_m=1.0, **given_options)
        located, frames = stream.localize(encoded, T)
        assert located.answer.frames == frames
        require_consistent(located.answer, encoded, located.bundle)


@pytest.mark.parametrize("first", [{"refine": False}, {"refine": False, "neighbours": 50}, {"neighbours": 1}])
def test_options_of_one_frame_do_not_change_the_next_answer(
    engine: Engine, parts_of: Callable[..., dict[str, bytes]], first: dict[str, Any]
) -> None:
    parts, answers = parts_of(), []
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    frame = EncodedQuery(rgb=parts["rgb"], depth=parts["depth"], camera=camera, scale_m=1.0)
    for changed in ({}, first):
        stream = Stream(engine)
        stream.localize(replace(frame, **changed), None)
        answers.append(stream.localize(frame, np.eye(4))[0].answer)
    expected, found = answers
    # A frame without registration leaves no belief. So the next registration has no starts from it, and another start may win.
    refined = first.get("refine", True)
    assert found.T_map_camera_guess is not None
    assert expected.T_map_camera_guess is not None
    np.testing.assert_allclose(found.T_map_camera_guess, expected.T_map_camera_guess, atol=0 if refined else 0.05)
    assert (found.status, len(found.neighbours)) == (expected.status, len(expected.neighbours))
    if refined:
        np.testing.assert_array_equal(found.covariance, expected.covariance)
        np.testing.assert_array_equal(found.evidence, expected.evidence)
    else:
        assert found.confidence == pytest.approx(expected.confidence, abs=0.02)


def test_an_answer_that_is_not_finite_does_not_leave_the_core(
    localizer: Localizer, pictures: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Holds for any field. The error names the first one, and does not blame the request."""
    rgb, depth_m, camera = pictures
    good = localizer.localize(Query(rgb=rgb, depth_m=depth_m, camera=camera, T_vehicle_camera=np.eye(4)))
    assert good.covariance is not None
    assert good.candidates is not None
    broken_covariance = good.covariance.copy()
    broken_covariance[5, 5] = np.nan
    first = good.candidates[0]
    for path, broken in {
        "covariance": replace(good, covariance=broken_covariance),
        "confidence": replace(good, confidence=math.nan),
        "candidates.0.registered.scale": replace(
            good, candidates=(replace(first, registered=replace(first.registered, scale=math.inf)),)
        ),
        "candidates.0.scores.similarity": replace(
            good, candidates=(replace(first, scores={**first.scores, "similarity": math.nan}),)
        ),
        "neighbours.1.position_m": replace(
            good, neighbours=(good.neighbours[0], replace(good.neighbours[1], position_m=np.array([0, np.inf, 0])))
        ),
        "timings.encode_ms": replace(good, timings=replace(good.timings, encode_ms=math.nan)),
        "vote.shares.0.1": replace(
            good, vote=None if good.vote is None else replace(good.vote, shares=((0, math.nan),))
        ),
    }.items():
        with pytest.raises(NotFiniteError, match=rf"^{path} of the answer is not finite"):
            require_finite(broken)
    monkeypatch.setattr(localizer_module, "evidence_of", lambda *_: np.full(len(FEATURES), np.nan))
    with pytest.raises(NotFiniteError, match=r"^confidence of the answer"):
        localizer.localize(Query(rgb=rgb, depth_m=depth_m, camera=camera))


def test_large_finite_numbers_are_no_defect(localizer: Localizer, pictures: Any) -> None:
    """The sum of an array may overflow although all its numbers are finite."""
    rgb, depth_m, camera = pictures
    answer = localizer.localize(Query(rgb=rgb, depth_m=depth_m, camera=camera))
    with np.errstate(over="ignore"):
        require_finite(replace(answer, covariance=np.full((6, 6), 1e308)))
