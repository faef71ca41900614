from collections.abc import Iterator
from contextlib import closing

import pytest

from service.runtime.serving_table import SharedMemory


class Memory(SharedMemory):
    """A serving table shared by objects of one process. The test declares which workers are alive."""

    def __init__(self) -> None:
        super().__init__()
        self.living: set[int] = set()

    def live(self, number: int) -> None:
        self.living.add(number)

    def lives(self, number: int) -> bool:
        return number in self.living


@pytest.fixture
def memory() -> Iterator[Memory]:
    with closing(Memory()) as made:
        yield made


@pytest.fixture
def other_memory() -> Iterator[Memory]:
    with closing(Memory()) as made:
        yield made
