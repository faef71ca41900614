"""Every request has its own stage times. The fake clock advances by a second at every reading.

Registration counts twice: up to the decision, and the reasons and the spread afterwards.
"""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from service import timing
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import transform_from
from service.localization.answer import Timings
from service.runtime.engine import EncodedQuery, Engine
from service.runtime.settings import Settings
from service.runtime.stream import Stream

#: The camera moved 1 m along its optical axis.
AHEAD = transform_from(np.eye(3), np.array([0.0, 0.0, 1.0]))
ONE = Timings(decode_ms=1e3, fuse_ms=1e3, encode_ms=1e3, search_ms=2e3, register_ms=2e3, total_ms=7e3)


@pytest.fixture
def engine(bundle_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    monkeypatch.setattr(timing, "perf_counter", itertools.count().__next__)
    yield engine
    engine.close()


@pytest.fixture
def encoded(parts_of: Callable[..., dict[str, bytes]]) -> EncodedQuery:
    parts = parts_of()
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    return EncodedQuery(rgb=parts["rgb"], depth=parts["depth"], camera=camera, scale_m=1.0)


def test_the_map_is_searched_per_frame_and_ranked_once_per_request(engine: Engine, encoded: EncodedQuery) -> None:
    assert engine.localize(encoded).answer.timings == ONE


def test_frames_of_a_sequence_add_up(engine: Engine, encoded: EncodedQuery) -> None:
    located = engine.localize_sequence((encoded, encoded), (np.eye(4), np.eye(4)))
    assert located.answer.timings == Timings(
        decode_ms=2e3, fuse_ms=2e3, encode_ms=2e3, search_ms=3e3, register_ms=2e3, total_ms=1.1e4
    )


def test_a_frame_that_a_stream_keeps_counts_in_its_own_request_only(engine: Engine, encoded: EncodedQuery) -> None:
    stream = Stream(engine)
    for frames in (1, 2, 3):
        located, used = stream.localize(encoded, AHEAD)
        assert (located.answer.timings, used) == (ONE, frames)
