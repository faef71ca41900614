"""Rules of the serving table, with workers as objects of one process, and with real processes that are killed."""

import mmap
import random
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from service.errors import BundleError, UnknownMapError
from service.runtime.serving_table import MapVersion, ServingTable, SharedServingTable

ROOT = Path(__file__).parents[3]


def version(number: int, name: str = "m") -> MapVersion:
    return MapVersion(name, f"v{number}", float(number))


V1, V2, V3, V4, V5 = map(version, range(1, 6))


def joined(memory: Any, number: int, *opened: MapVersion) -> SharedServingTable:
    table = SharedServingTable(memory, number)
    assert table.join(opened) == frozenset()
    return table


def mounted(table: ServingTable, name: str = "m") -> tuple[str, list[str]]:
    """Return the serving version, and the mounted versions."""
    known = table.read().maps[name]
    return known.serving, [each.version for each in known.versions]


def test_the_first_worker_mounts_what_it_has_and_the_newest_serves(memory: Any) -> None:
    table = joined(memory, 0, V1, V3, V2, version(1, "other"))
    assert mounted(table) == ("v3", ["v3", "v2", "v1"])
    assert mounted(table, "other") == ("v1", ["v1"])


def test_a_version_is_mounted_when_every_worker_has_it(memory: Any) -> None:
    tables = [joined(memory, number, V1) for number in range(3)]
    for table in tables[:2]:
        table.offer(V2)
        assert [mounted(each) for each in tables] == [("v1", ["v1"])] * 3
    assert tables[2].others_offer() == {V2}
    assert tables[0].others_offer() == frozenset()
    tables[2].offer(V2)
    assert [mounted(each) for each in tables] == [("v2", ["v2", "v1"])] * 3
    assert not any(tables[0].read().offers.values())


def test_a_worker_that_has_ended_does_not_count(memory: Any) -> None:
    tables = [joined(memory, number, V1) for number in range(2)]
    tables[0].offer(V2)
    memory.living.remove(1)
    tables[0].settle()
    assert mounted(tables[0]) == ("v2", ["v2", "v1"])


def test_a_choice_holds_for_all_until_a_newer_version_comes(memory: Any) -> None:
    tables = [joined(memory, number, V1, V2) for number in range(2)]
    tables[0].choose("m", "v1")
    assert [mounted(each)[0] for each in tables] == ["v1", "v1"]
    for table in tables:
        table.offer(V2)  # no news
    assert mounted(tables[1])[0] == "v1"
    for table in tables:
        table.offer(V3)
    assert [mounted(each)[0] for each in tables] == ["v3", "v3"]


def test_a_worker_that_is_started_again_takes_the_newer_version_not_the_old_choice(memory: Any) -> None:
    tables = [joined(memory, number, V1, V2) for number in range(2)]
    tables[0].choose("m", "v1")
    for table in tables:
        table.offer(V3)
    memory.living.remove(1)
    again = SharedServingTable(memory, 1)
    assert again.join([V1, V2]) == {V3}
    assert again.join([V1, V2, V3]) == frozenset()
    assert mounted(again) == mounted(tables[0]) == ("v3", ["v3", "v2", "v1"])


def test_and_keeps_a_choice_that_still_holds(memory: Any) -> None:
    tables = [joined(memory, number, V1, V2) for number in range(2)]
    tables[0].choose("m", "v1")
    memory.living.remove(1)
    assert mounted(joined(memory, 1, V1, V2))[0] == "v1"


def test_offers_of_an_ended_worker_do_not_count(memory: Any) -> None:
    tables = [joined(memory, number, V1) for number in range(2)]
    tables[1].offer(V2)
    again = SharedServingTable(memory, 1)  # nobody noticed that it had ended
    assert again.join([V1]) == frozenset()
    tables[0].offer(V2)
    assert mounted(tables[0])[0] == "v1"


def test_a_worker_that_cannot_open_the_serving_version_does_not_join(memory: Any) -> None:
    first = joined(memory, 0, V1, V2, V3)
    first.choose("m", "v1")
    late = SharedServingTable(memory, 1)
    assert late.join([V2, V3]) == {V1}
    assert late.join([V2, V3], given_up=[V1.key]) == {V1}
    assert late.number not in late.read().offers
    assert mounted(first) == ("v1", ["v3", "v2", "v1"])
    first.choose("m", "v2")  # the operator's remedy
    assert late.join([V2, V3], given_up=[V1.key]) == frozenset()
    assert mounted(first) == mounted(late) == ("v2", ["v3", "v2"])


def test_a_version_that_does_not_serve_and_cannot_be_opened_is_dropped_for_all(memory: Any) -> None:
    first = joined(memory, 0, V1, V2)
    late = SharedServingTable(memory, 1)
    assert late.join([V2]) == {V1}
    assert late.join([V2], given_up=[V1.key]) == frozenset()
    assert mounted(first) == ("v2", ["v2"])


def test_the_next_worker_after_all_have_ended_takes_over_what_it_can_open(memory: Any) -> None:
    joined(memory, 0, V1, V2, V3, version(1, "gone")).choose("m", "v2")
    memory.living.clear()
    table = SharedServingTable(memory, 1)
    assert table.join([V2, V3, V4]) == {V1, version(1, "gone")}
    assert table.join([V2, V3], given_up=[V1.key, ("gone", "v1")]) == frozenset()
    assert mounted(table) == ("v2", ["v3", "v2"])
    assert list(table.read().maps) == ["m"]
    memory.living.clear()
    table = SharedServingTable(memory, 0)
    assert table.join([V3, V5], given_up=[V2.key]) == frozenset()
    assert mounted(table) == ("v5", ["v5", "v3"])


def test_several_versions_are_removed_in_one_change(memory: Any) -> None:
    table = joined(memory, 0, V1, V2, V3)
    before = memory.counter
    table.remove([V3.key, V2.key, ("x", "v1")])
    assert mounted(table) == ("v1", ["v1"])
    assert memory.counter == before + 1
    table.remove([V1.key])
    assert table.read().maps == {}


def test_at_most_three_stay_and_the_one_that_serves_is_among_them(memory: Any) -> None:
    table = joined(memory, 0, V2, V3, V4)
    assert [each for each in (V1, V2, V5) if table.read().wants(each)] == [V5]
    assert not table.read().wants(V4, others=[V5])
    table.choose("m", "v2")
    table.offer(V1)
    assert mounted(table) == ("v2", ["v4", "v3", "v2"])
    assert not any(table.read().offers.values())
    table.remove([V4.key])
    table.choose("m", "v2")
    for each in (version(2, "n"), V5, V4):
        table.offer(each)
    assert mounted(table) == ("v5", ["v5", "v4", "v3"])


def test_a_copy_that_was_made_later_is_news_and_an_earlier_one_is_none(memory: Any) -> None:
    tables = [joined(memory, number, V1, V2) for number in range(2)]
    assert not tables[0].read().wants(MapVersion("m", "v1", 0.5))
    for table in tables:
        table.offer(MapVersion("m", "v1", 9.0))
    assert mounted(tables[0]) == ("v1", ["v1", "v2"])


def test_versions_of_one_moment_are_in_one_order_for_all(memory: Any, other_memory: Any) -> None:
    a, b = MapVersion("m", "aa", 1.0), MapVersion("m", "bb", 1.0)
    assert mounted(joined(memory, 0, a, b)) == ("bb", ["bb", "aa"])
    assert mounted(joined(other_memory, 0, b, a)) == ("bb", ["bb", "aa"])


@pytest.mark.parametrize(
    ("name", "number", "told"), [("x", "v1", "mounted maps: m"), ("m", "v9", "mounted versions: v2, v1")]
)
def test_a_version_that_is_not_mounted_cannot_be_chosen(memory: Any, name: str, number: str, told: str) -> None:
    table = joined(memory, 0, V1, V2)
    with pytest.raises(UnknownMapError, match=told):
        table.choose(name, number)
    table.choose("m", "v1")  # the lock was given back


def test_a_table_that_does_not_fit_is_refused_and_the_old_one_holds(memory: Any) -> None:
    table = joined(memory, 0, V1)
    with pytest.raises(BundleError, match="too many"):
        table.offer(version(1, "x" * 5 * 2**20))
    assert mounted(table) == ("v1", ["v1"])
    table.offer(V2)
    assert mounted(table)[0] == "v2"


def test_a_worker_that_is_killed_while_it_writes_leaves_the_table_whole(memory: Any) -> None:
    table = joined(memory, 0, V1, V2)
    unused = memory._slot(memory.counter + 1)
    memory._memory[unused : unused + mmap.PAGESIZE] = b"{" * mmap.PAGESIZE
    assert mounted(SharedServingTable(memory, 1)) == ("v2", ["v2", "v1"])
    table.choose("m", "v1")
    assert mounted(table)[0] == "v1"


def test_reading_costs_no_lock_and_gives_the_same_object_while_nothing_changes(memory: Any) -> None:
    one, other = joined(memory, 0, V1, V2), joined(memory, 1, V1, V2)
    known = one.read()
    with memory.locked():
        assert one.read() is known
    other.choose("m", "v1")
    assert one.read() is not known


def test_a_single_process_follows_the_same_rules() -> None:
    table = ServingTable()
    assert table.join([]) == frozenset()
    for each in (V1, V2, V3):
        table.offer(each)
    assert mounted(table) == ("v3", ["v3", "v2", "v1"])
    table.choose("m", "v1")
    table.offer(V4)
    assert mounted(table) == ("v4", ["v4", "v3", "v2"])


def test_all_answers_agree_while_workers_are_killed_and_versions_come_are_chosen_and_go(tmp_path: Path) -> None:
    """Forty random steps with three processes, and a kill every 70 ms."""
    seed = str(random.randrange(2**32))  # noqa: S311  # no secret
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("agreeing_workers.py")), str(tmp_path), "40", seed],
        env={"PYTHONPATH": str(ROOT), "PATH": ""},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, ""), f"seed {seed}: {done.stdout[:2000]}"
    answers, _, switches, *_ = done.stdout.split()
    assert int(answers) > 400
    assert int(switches) > 4
    assert "'kill'" in done.stdout
