"""Prometheus' own parser reads the metrics of the service."""

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from service.contract.convert import parsed, query_from
from service.contract.schema import LocalizeRequest
from service.runtime.engine import Engine
from service.runtime.map_registry import Refused
from service.runtime.settings import Settings

Parts = Callable[..., dict[str, bytes]]


@pytest.fixture
def engine(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, queue=2))
    yield engine
    engine.close()


def values(engine: Engine) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Return every sample by its name and labels."""
    families = text_string_to_metric_families(engine.metrics.text().decode())
    return {
        (each.name, tuple(sorted(each.labels.items()))): each.value for family in families for each in family.samples
    }


def test_an_answer_is_counted_with_its_stages(engine: Engine, parts_of: Parts) -> None:
    parts = parts_of()
    query = query_from(parsed(parts["request"], LocalizeRequest), rgb=parts["rgb"], depth=parts["depth"])
    located = engine.localize(query)
    engine.localize(replace(query, refine=False))
    found = values(engine)
    assert found["streetfix_answers_total", (("map", "tiny"), ("status", "LOCALIZED"))] == 2
    assert found["streetfix_frames_sum", ()] == 2
    for stage in ("decode", "fuse", "encode", "search", "register"):
        assert found["streetfix_stage_seconds_count", (("stage", stage),)] == 2, stage
    register = found["streetfix_stage_seconds_sum", (("stage", "register"),)]
    assert register == pytest.approx(located.answer.timings.register_ms / 1e3)  # the second did not register
    assert not any(name.startswith("streetfix_confidence") for name, _ in found)  # this map is not calibrated


def test_features_out_of_the_range_of_the_calibration_are_counted(engine: Engine, parts_of: Parts) -> None:
    parts = parts_of()
    located = engine.localize(
        query_from(parsed(parts["request"], LocalizeRequest), rgb=parts["rgb"], depth=parts["depth"])
    )
    for outside in ((("front", 5.0), ("points", -4.5)), (("front", 4.1),), ()):
        engine.metrics.answered(replace(located.answer, extrapolated=outside), located.bundle, frames=1)
    found = values(engine)
    assert found["streetfix_extrapolated_total", (("feature", "front"), ("map", "tiny"))] == 2
    assert found["streetfix_extrapolated_total", (("feature", "points"), ("map", "tiny"))] == 1


def test_an_error_is_no_answer(engine: Engine, parts_of: Parts) -> None:
    parts = parts_of()
    query = query_from(parsed(parts["request"], LocalizeRequest), rgb=b"nothing", depth=parts["depth"])
    with pytest.raises(Exception, match="rgb"):
        engine.localize(query)
    assert not any(name == "streetfix_answers_total" for name, _ in values(engine))


def test_requests_are_counted_by_outcome(engine: Engine) -> None:
    for seconds, code in ((0.003, "200"), (0.05, "200"), (0.001, "503")):
        engine.metrics.requested("rest", "localize", code, seconds)
    found = values(engine)
    labels = (("face", "rest"), ("method", "localize"))
    assert found["streetfix_requests_total", (("code", "200"), *labels)] == 2
    assert found["streetfix_requests_total", (("code", "503"), *labels)] == 1
    assert found["streetfix_request_seconds_sum", labels] == pytest.approx(0.054)
    assert found["streetfix_request_seconds_bucket", (*labels[:1], ("le", "0.004"), *labels[1:])] == 2


def test_the_queue_is_seen_as_it_is(engine: Engine) -> None:
    release, running = threading.Event(), threading.Event()

    def hold() -> None:
        running.set()
        release.wait(30)

    first = engine.admission.submit(hold)
    assert running.wait(30)
    second = engine.admission.submit(lambda: None)
    found = values(engine)
    names = ("streetfix_working", "streetfix_waiting", "streetfix_capacity")
    assert [found[name, ()] for name in names] == [1, 1, 3]
    release.set()
    first.result(30)
    second.result(30)
    found = values(engine)
    assert [found[name, ()] for name in names] == [0, 0, 3]


def test_the_maps_and_the_process_are_named(engine: Engine) -> None:
    found = values(engine)
    (localizer,) = engine.registry
    manifest = localizer.bundle.manifest
    assert found["streetfix_map", (("map", "tiny"), ("version", manifest.version))] == manifest.counts.places
    assert found["process_resident_memory_bytes", ()] > 1e7


def test_bundles_that_are_not_mounted_are_counted_and_the_first_are_named(engine: Engine) -> None:
    assert values(engine)["streetfix_bundles_refused", ()] == 0
    engine.registry.refused = tuple(Refused(f"m{number:02}" + 300 * "x", "damaged") for number in range(25))
    found = values(engine)
    assert found["streetfix_bundles_refused", ()] == 25
    named = [dict(labels)["bundle"] for name, labels in found if name == "streetfix_bundle_refused"]
    assert (len(named), max(map(len, named))) == (20, 200)
    engine.registry.refused = ()
