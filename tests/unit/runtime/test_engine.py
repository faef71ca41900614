from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import faiss
import pytest

from service.errors import DecodeError, ImageSizeError, TooLargeError, UnknownMapError
from service.geometry.camera import PinholeCamera
from service.runtime.engine import EncodedQuery, Engine
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
