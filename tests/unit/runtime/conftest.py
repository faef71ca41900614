from collections.abc import Iterator
from contextlib import closing

import pytest

from service.runtime.serving_table import SharedMemory


class Memory(SharedMemory):
    """Shared by objects of one process instead of processes, so it is told who lives."""

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
