from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import faiss
import numpy as np
import pytest

from service.errors import (
    BundleError,
    DecodeError,
    ImageSizeError,
    NotReadyError,
    RequestError,
    TooLargeError,
    UnknownMapError,
)
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, transform_from
from service.localization.belief import Belief, Mode
from service.localization.tracker import Track
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.retrieval.prior import Prior
from service.runtime.engine import CarriedTrack, EncodedQuery, Engine, expect_next, prior_in
from service.runtime.settings import Limits, Settings

Parts = Callable[..., dict[str, bytes]]


@pytest.fixture
def engine(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=2))
    yield engine
    engine.close()


@pytest.fixture
def encoded(parts_of: Parts) -> EncodedQuery:
    parts = parts_of()
    return EncodedQuery(
        rgb=parts["rgb"], depth=parts["depth"], camera=PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5), scale_m=1.0
    )


def test_encoded_pictures_get_the_same_answer_as_arrays(engine: Engine, encoded: EncodedQuery) -> None:
    located = engine.localize(encoded)
    assert located.bundle.name == "tiny"
    assert located.answer.neighbours[0].place == 8
    assert located.answer.neighbours[0].similarity == pytest.approx(1, abs=1e-5)


def test_decoding_is_timed_and_in_the_total(engine: Engine, encoded: EncodedQuery) -> None:
    times = engine.localize(encoded).answer.timings
    assert times.decode_ms > 0
    stages = times.decode_ms + times.fuse_ms + times.encode_ms + times.search_ms + times.register_ms
    assert times.total_ms == pytest.approx(stages)


def test_an_unknown_map_is_refused_before_anything_is_decoded(engine: Engine, encoded: EncodedQuery) -> None:
    with pytest.raises(UnknownMapError):
        engine.localize(replace(encoded, map_name="west", rgb=b""))


def test_an_undecodable_picture_is_refused(engine: Engine, encoded: EncodedQuery) -> None:
    with pytest.raises(DecodeError):
        engine.localize(replace(encoded, rgb=encoded.rgb[:60]))


def test_a_picture_of_another_aspect_is_refused(engine: Engine, encoded: EncodedQuery) -> None:
    with pytest.raises(ImageSizeError):
        engine.localize(replace(encoded, camera=PinholeCamera(64, 36, 32.0, 32.0, 31.5, 17.5)))


def test_a_picture_beyond_the_limit_is_refused(bundle_path: Path, encoded: EncodedQuery) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, limits=Limits(max_pixels=1000)))
    with pytest.raises(TooLargeError):
        engine.localize(encoded)
    engine.close()


def test_every_worker_runs_native_code_on_one_thread(engine: Engine) -> None:
    faiss.omp_set_num_threads(2)
    assert engine.admission.submit(faiss.omp_get_max_threads).result(30) == 1
    assert cv2.getNumThreads() == 1


@pytest.fixture
def twins(twin_map: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(twin_map,), threads=1))
    yield engine
    engine.close()


@pytest.mark.parametrize("y", [0.0, 90.0])
def test_a_prior_in_degrees_decides_between_two_streets_like_one_in_metres(
    twins: Engine, encoded: EncodedQuery, y: float
) -> None:
    earth = MapBundle.open(twins.registry.get(None).bundle.path).earth
    assert earth is not None
    known = (
        replace(encoded, prior=Prior(position_m=np.array([20.0, y]), position_std_m=10.0)),
        replace(encoded, prior=Prior(position_std_m=10.0), prior_wgs84=earth.to_earth(np.array([20.0, y, 0.0]))[:2]),
    )
    in_metres, in_degrees = (twins.localize(each).answer for each in known)
    np.testing.assert_allclose(in_metres.T_map_camera_guess[:2, 3], [20, y], atol=0.3)
    np.testing.assert_allclose(in_degrees.T_map_camera_guess, in_metres.T_map_camera_guess, atol=1e-6)


def test_a_prior_in_degrees_keeps_what_else_is_known(twins: Engine, encoded: EncodedQuery) -> None:
    """0.01 degrees north and east of the centre of Berlin: 1112.7 m and 678.6 m."""
    prior = Prior(position_std_m=7.0, heading_rad=1.25, heading_std_rad=0.5)
    bundle = twins.registry.get(None).bundle
    found = prior_in(replace(encoded, prior=prior, prior_wgs84=(52.53, 13.415)), bundle)
    assert found is not None
    assert found.position_m is not None
    np.testing.assert_allclose(found.position_m, [678.6, 1112.7], atol=0.3)
    assert (found.position_std_m, found.heading_rad, found.heading_std_rad) == (7.0, 1.25, 0.5)
    assert prior_in(replace(encoded, prior=prior), bundle) is prior
    assert prior_in(encoded, bundle) is None


def test_a_prior_in_degrees_is_refused_where_the_map_does_not_know_where_it_lies(
    engine: Engine, encoded: EncodedQuery
) -> None:
    asked = replace(encoded, prior=Prior(), prior_wgs84=(52.52, 13.405))
    with pytest.raises(RequestError, match=r"the map 'tiny' is not georeferenced; send prior\.position") as error:
        engine.localize(asked)
    assert error.value.field == "prior.wgs84"


@pytest.mark.parametrize(
    ("of_service", "of_query", "status"),
    [
        (0.01, None, "LOCALIZED"),
        (0.001, None, "AMBIGUOUS"),
        (0.001, 0.01, "LOCALIZED"),
        (0.01, 0.001, "AMBIGUOUS"),
    ],
)
def test_the_services_rate_of_false_accepts_holds_where_a_query_names_none(
    content_of: Callable[..., Any],
    calibration_json: Callable[..., Any],
    tmp_path: Path,
    encoded: EncodedQuery,
    of_service: float,
    of_query: float | None,
    status: str,
) -> None:
    """Confidence 0.5 is enough for a rate of 1 %, and not for 0.1 %."""
    write_bundle(tmp_path / "m", content_of(calibration=calibration_json()))
    engine = Engine.open(Settings(maps=(tmp_path / "m",), threads=1, false_accept_rate=of_service))
    assert engine.localize(replace(encoded, false_accept_rate=of_query)).answer.status == status
    engine.close()


@pytest.mark.parametrize("name", [None, "tiny"])
def test_an_empty_maps_folder_is_a_service_that_is_not_ready(
    tmp_path: Path, encoded: EncodedQuery, content_of: Callable[..., Any], name: str | None
) -> None:
    (tmp_path / "maps").mkdir()
    engine = Engine.open(Settings(maps=(tmp_path / "maps",), threads=1))
    assert not engine.is_ready
    with pytest.raises(NotReadyError, match="no map is mounted"):
        engine.localize(replace(encoded, map_name=name))
    write_bundle(tmp_path / "maps" / "m", content_of())
    engine.watcher.scan()
    assert engine.is_ready
    assert engine.localize(replace(encoded, map_name=name)).bundle.name == "tiny"
    engine.close()


def test_a_map_that_would_refuse_every_request_is_not_mounted(
    content_of: Callable[..., Any], calibration_json: Callable[..., Any], tmp_path: Path
) -> None:
    """Its calibration allows 0.1 % of false accepts, and the service requires less."""
    write_bundle(tmp_path / "calibrated", content_of(name="calibrated", calibration=calibration_json()))
    asked = (
        "false_accept_rate is 0.0005, but .* supports 0.001 or more.* set STREETFIX_FALSE_ACCEPT_RATE to 0.001 or more"
    )
    with pytest.raises(BundleError, match=asked) as error:
        Engine.open(Settings(maps=(tmp_path,), threads=1, false_accept_rate=0.0005))
    assert error.value.field == "false_accept_rate"
    write_bundle(tmp_path / "uncalibrated", content_of())
    engine = Engine.open(Settings(maps=(tmp_path,), threads=1, false_accept_rate=0.0005))
    assert [each.bundle.name for each in engine.registry] == ["tiny"]
    assert [each.bundle for each in engine.registry.refused] == ["calibrated"]
    engine.close()


def test_a_map_that_promises_less_than_the_default_is_mounted_if_the_setting_fits(
    content_of: Callable[..., Any], calibration_json: Callable[..., Any], tmp_path: Path
) -> None:
    thresholds = [{"false_accept_rate": 0.1, "confidence": 0.9}]
    write_bundle(tmp_path / "m", content_of(calibration=calibration_json(thresholds=thresholds)))
    engine = Engine.open(Settings(maps=(tmp_path / "m",), threads=1, false_accept_rate=0.1))
    assert engine.is_ready
    engine.close()


class Expecting:
    """A map that records what it is told."""

    def __init__(self) -> None:
        self.calls: list[list[list[float]]] = []

    def expect_next(self, xy_m: Any, before_m: Any) -> None:
        self.calls.append([xy_m.tolist(), before_m.tolist()])


def mode_at(x: float, y: float, weight: float = 0.9) -> Mode:
    """The camera looks along x of the map."""
    return Mode(transform_from(R_BODY_OPTICAL, np.array([x, y, 1.0])), np.eye(6), weight, 0, 0.6, 0.8)


#: The camera has moved 2 m along its optical axis.
T_FORWARD = transform_from(np.eye(3), np.array([0.0, 0.0, 2.0]))


@pytest.mark.parametrize(
    ("track", "T_previous_camera", "calls"),
    [
        (Track(last=mode_at(10.0, 5.0)), T_FORWARD, [[[10.0, 5.0], [8.0, 5.0]]]),
        (  # the likeliest mode counts, not the last LOCALIZED answer
            Track(belief=Belief((mode_at(-3.0, 7.0), mode_at(0.0, 0.0, 0.05)), 0.05, 0.0), last=mode_at(10.0, 5.0)),
            T_FORWARD,
            [[[-3.0, 7.0], [-5.0, 7.0]]],
        ),
        (Track(last=mode_at(10.0, 5.0)), None, []),  # it is unknown where the camera came from
        (Track(), T_FORWARD, []),
    ],
)
def test_a_map_is_told_where_a_robot_moves(track: Track, T_previous_camera: Any, calls: Any) -> None:
    bundle: Any = Expecting()
    expect_next(bundle, track, T_previous_camera)
    assert np.array(bundle.calls) == pytest.approx(np.array(calls))


def test_a_track_tells_its_map_where_it_moves_after_each_answer_but_the_first(
    encoded: EncodedQuery,
    content_of: Callable[..., Any],
    calibration_json: Callable[..., dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_bundle(tmp_path / "tiny", content_of(calibration=calibration_json()))
    told = Expecting()
    monkeypatch.setattr(MapBundle, "expect_next", lambda _, *both: told.expect_next(*both))
    engine = Engine.open(Settings(maps=(tmp_path,), threads=1))
    try:
        first = engine.localize(replace(encoded, track=CarriedTrack(None, None)))
        assert told.calls == []
        second = engine.localize(replace(encoded, track=CarriedTrack(first.sealed_belief, T_FORWARD)))
    finally:
        engine.close()
    ((xy_m, before_m),) = told.calls
    assert second.answer.belief is not None
    assert xy_m == second.answer.belief.modes[0].T_map_camera[:2, 3].tolist()
    assert 0.0 < np.hypot(*np.subtract(xy_m, before_m)) <= 2.0 + 1e-9
