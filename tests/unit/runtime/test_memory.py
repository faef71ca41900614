"""The size of the memory budget."""

from pathlib import Path
from typing import Any

import pytest

from service.errors import RequestError, TooLargeError
from service.imaging.picture_headers import ImageLimits, require_pixels
from service.imaging.rectify import TABLES_BYTES
from service.runtime import memory
from service.runtime.admission import MIB
from service.runtime.memory import budget_of, memory_limit
from service.runtime.settings import Settings

GIB = 2**30
UNLIMITED = "9223372036854771712\n"


def groups(tmp_path: Path, own: str, files: dict[str, str]) -> tuple[Path, Path]:
    for name, text in files.items():
        path = tmp_path / "cgroup" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "own").write_text(own)
    return tmp_path / "cgroup", tmp_path / "own"


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"memory.max": "2097152\n"}, 2 * MIB),
        ("0::/\n", {"memory.max": "max\n"}, None),
        ("0::/a/b\n", {"a/b/memory.max": "max\n", "a/memory.max": "3145728\n", "memory.max": "max\n"}, 3 * MIB),
        ("0::/a/b\n", {"a/b/memory.max": "1048576\n", "a/memory.max": "3145728\n"}, MIB),
        ("0::/../../pod\n", {"memory.max": "2097152\n"}, 2 * MIB),
        ("4:memory:/docker/x\n0::/\n", {"memory/memory.limit_in_bytes": "2097152\n"}, 2 * MIB),
        (
            "4:cpu,memory:/x\n",
            {"memory/x/memory.limit_in_bytes": "1048576\n", "memory/memory.limit_in_bytes": UNLIMITED},
            MIB,
        ),
        ("4:memory:/x\n", {"memory/memory.limit_in_bytes": UNLIMITED}, None),
        ("0::/x\n", {"unified/x/memory.max": "1048576\n"}, MIB),
        ("nonsense", {"memory.max": "nonsense"}, None),
        ("", {}, None),
    ],
)
def test_the_least_limit_of_all_control_groups_counts(
    tmp_path: Path, own: str, files: dict[str, str], expected: int | None
) -> None:
    found = memory_limit(*groups(tmp_path, own, files))
    machine = memory_limit(tmp_path / "none", tmp_path / "none")
    assert found == (machine if expected is None else expected)
    assert machine > 64 * MIB


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> Any:
    def to(limit: int, anonymous: int = 0) -> None:
        monkeypatch.setattr(memory, "memory_limit", lambda: limit)
        monkeypatch.setattr(memory, "anonymous_bytes", lambda: anonymous)

    return to


def test_the_memory_of_process_and_maps_is_subtracted(limited: Any) -> None:
    limited(2 * GIB)
    settings = Settings()
    plain = budget_of(settings, threads=2).limit
    assert (
        plain == 2 * GIB * 5 // 8 - memory.PROCESS_BYTES - 2 * memory.THREAD_BYTES - TABLES_BYTES
    )  # an eighth is spare, a quarter is the maps'
    assert budget_of(settings, threads=6).limit == plain - 4 * memory.THREAD_BYTES
    limited(2 * GIB, anonymous=300 * MIB)
    assert budget_of(settings, threads=2).limit == plain - (300 * MIB - memory.PROCESS_BYTES)


def test_workers_share_it(limited: Any) -> None:
    limited(8 * GIB)
    one = budget_of(Settings(workers=1), threads=2)
    four = budget_of(Settings(workers=4), threads=2)
    fixed = memory.PROCESS_BYTES + 2 * memory.THREAD_BYTES + TABLES_BYTES
    assert 4 * (four.limit + fixed) == pytest.approx(one.limit + fixed, abs=4)
    assert budget_of(Settings(workers=4, request_memory_mib=800), threads=2).limit == 200 * MIB


def test_messages_that_grpc_reads_are_taken_off(limited: Any) -> None:
    limited(2 * GIB)
    without, with_ = (budget_of(Settings(grpc_port=port), threads=2) for port in (None, 50051))
    assert without.messages == 0
    assert with_.messages >= 4
    assert with_.limit + with_.messages * 16 * MIB < without.limit


@pytest.mark.parametrize("settings", [{}, {"request_memory_mib": 100}, {"workers": 8, "request_memory_mib": 800}])
def test_too_little_memory_is_reported_with_the_remedy(limited: Any, settings: dict[str, Any]) -> None:
    limited(300 * MIB)
    with pytest.raises(RequestError, match=r"request_memory_mib|memory limit") as refused:
        budget_of(Settings(**settings), threads=2)
    assert refused.value.field == "request_memory_mib"
    assert "max_request_bytes" in refused.value.message


def test_a_picture_is_reserved_when_its_header_is_read() -> None:
    told = list[tuple[str, int]]()
    limits = ImageLimits(max_pixels=100, reserve=lambda field, pixels: told.append((field, pixels)))
    require_pixels(10, 10, limits, field="rgb")
    with pytest.raises(TooLargeError):
        require_pixels(10, 11, limits, field="depth")
    assert told == [("rgb", 100)]
