"""The buffer of the last answers."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from service.contract import schema
from service.contract.convert import parsed, query_from
from service.runtime.engine import Engine
from service.runtime.last_answers import MOST, LastAnswers
from service.runtime.settings import Settings


@pytest.fixture
def engine(bundle_path: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1))
    yield engine
    engine.close()


def test_the_newest_comes_first_and_the_oldest_go(engine: Engine, parts_of: Callable[..., dict[str, bytes]]) -> None:
    parts = parts_of()
    encoded = query_from(parsed(parts["request"], schema.LocalizeRequest), rgb=parts["rgb"], depth=parts["depth"])
    located = engine.localize(encoded)
    (kept,) = engine.last_answers.newest(10)
    assert (kept.number, kept.status, kept.frames) == (1, located.answer.status, 1)
    assert located.answer.T_map_camera_guess is not None
    assert kept.position_m is not None
    assert kept.position_m.tolist() == located.answer.T_map_camera_guess[:3, 3].tolist()
    answers = LastAnswers()
    for _ in range(MOST + 5):
        answers.add(located.answer, located.bundle, frames=2)
    assert [each.number for each in answers.newest(3)] == [MOST + 5, MOST + 4, MOST + 3]
    assert len(answers.newest(10 * MOST)) == MOST
