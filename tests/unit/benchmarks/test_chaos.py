"""Oracle of ``make chaos``: what must serve, what counts as wrong, and which bundles are damaged."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest

from benchmarks.chaos.asking import Outcome, Pair
from benchmarks.chaos.disk import Disk, small_disk
from benchmarks.chaos.oracle import Expected, Oracle, Version
from benchmarks.chaos.run import Chaos, Step
from benchmarks.chaos.shelf import Shelf
from model_training.loadtest.payloads import Payload
from service.errors import StreetfixError
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb
from service.maps.reader import MapBundle
from service.runtime.map_registry import bundle_paths

V = [Version(number, f"id{number}") for number in range(8)]
SENT = Payload(b"", "", pb.LocalizeRequest(), None)


@pytest.fixture
def disk() -> Iterator[Disk]:
    with small_disk(16, may_mount=False) as folder:
        yield folder


@pytest.fixture
def shelf(disk: Disk, bundle_path: Path) -> Shelf:
    return Shelf(disk.folder, bundle_path, Random(0))  # noqa: S311  # replayable


def test_a_newer_bundle_serves_and_an_older_one_does_not() -> None:
    oracle = Oracle({"a": V[1]})
    assert oracle.appeared("b", V[2]) == Expected(("id1", "id2"))
    assert oracle.appeared("c", V[0]) == Expected(("id2",))


def test_a_version_without_a_folder_serves_until_sighup() -> None:
    oracle = Oracle({"a": V[1], "b": V[2]})
    assert oracle.choose(V[1]) == Expected(("id2", "id1"))
    oracle.removed("a")
    assert oracle.unchanged() == Expected(("id1",))
    assert oracle.sighup().path == ("id1", "id2")
    assert oracle.open == [V[2]]


def test_a_choice_holds_over_sighup_and_ends_with_a_start() -> None:
    oracle = Oracle({"a": V[1], "b": V[2]})
    oracle.choose(V[1])
    assert oracle.sighup() == Expected(("id1",))
    assert oracle.start() == Expected(("id2",))


def test_more_than_three_versions_do_not_stay_open() -> None:
    oracle = Oracle({name: V[k] for k, name in enumerate("abcde")})
    assert oracle.open == [V[4], V[3], V[2]]
    oracle.choose(V[2])
    oracle.appeared("f", V[1])
    assert oracle.open == [V[4], V[3], V[2]]
    oracle.appeared("g", V[5])
    assert (oracle.serving, oracle.open) == (V[5], [V[5], V[4], V[3]])


def test_only_a_worker_that_started_while_a_folder_was_gone_leaves_a_choice() -> None:
    oracle = Oracle({"a": V[1], "b": V[2]})
    oracle.worker_started_again()
    assert oracle.unsure(oracle.unchanged()).finals == {"id2"}
    oracle.removed("b")
    oracle.worker_started_again()
    assert oracle.unsure(oracle.unchanged()).finals == {"id2", "id1"}


def test_the_service_must_list_the_newest_bundle_on_disk() -> None:
    oracle, known = Oracle({"a": V[1], "b": V[2]}), {each.id: each for each in V}
    assert oracle.adopt("id2", {"id1", "id2"}, known) is None
    assert oracle.adopt("id1", {"id1"}, known) is not None
    assert oracle.adopt("id2", {"id2", "strange"}, known) is not None


def answer(version: str, began_s: float, ended_s: float, **changed: Any) -> Outcome:
    return replace(Outcome(began_s, ended_s, "rest", "maps", "answer", version), **changed)


def lost(began_s: float, ended_s: float) -> Outcome:
    return Outcome(began_s, ended_s, "rest", "maps", "lost", told="reset")


OLD_TO_NEW = Expected(("old", "new"))
NEW = Expected(("new",))


@pytest.mark.parametrize(
    ("step", "outcomes", "wrong", "disagreements"),
    [
        (Step(OLD_TO_NEW), [answer("old", 0, 1), answer("old", 1, 2), answer("new", 2, 3), answer("new", 3, 4)], 0, 0),
        (Step(OLD_TO_NEW), [answer("new", 0, 1), answer("old", 2, 3)], 0, 1),
        (Step(OLD_TO_NEW), [answer("new", 0, 2), answer("old", 1, 3)], 0, 0),  # they ran at the same time
        (Step(OLD_TO_NEW), [answer("older", 0, 1)], 1, 0),
        (Step(OLD_TO_NEW), [answer("old", 11, 12)], 0, 1),  # all had settled at 10
        (Step(OLD_TO_NEW, strict_s=5.0), [answer("old", 4, 7)], 0, 0),
        (Step(OLD_TO_NEW, strict_s=5.0), [answer("old", 6, 7)], 0, 1),
        (Step(NEW), [lost(1, 2)], 1, 0),
        (Step(NEW, cut=[(1.5, 1.6)]), [lost(1, 2)], 0, 0),
        (Step(NEW, cut=[(2.5, 2.6)]), [lost(1, 2)], 1, 0),
        (Step(NEW, is_away=[(0.5, 3.0)]), [lost(1, 2)], 0, 0),
        (Step(NEW, is_away=[(1.5, 3.0)]), [lost(1, 2)], 1, 0),  # it was asked before the service was told to leave
    ],
)
def test_judgement(
    disk: Disk, bundle_path: Path, step: Step, outcomes: list[Outcome], wrong: int, disagreements: int
) -> None:
    chaos = Chaos(disk, bundle_path, Pair(SENT, SENT), seed=0, workers=2, tell=lambda _: None)
    chaos._serving = "new"
    chaos._judge("old", step, 10.0, outcomes)
    assert (len(chaos.findings.wrong), len(chaos.findings.disagreements)) == (wrong, disagreements)


def test_an_answer_at_another_place_is_wrong(disk: Disk, bundle_path: Path) -> None:
    chaos = Chaos(disk, bundle_path, Pair(SENT, SENT), seed=0, workers=2, tell=lambda _: None)
    chaos._serving, chaos._reference["rest", "full"] = "new", (1.0, 2.0, 3.0)
    for at, wrong in (((1.0, 2.0, 3.0), 0), ((1.0, 2.5, 3.0), 1)):
        chaos._judge("new", Step(NEW), 10.0, [answer("new", 1, 2, what="full", position_m=at)])
        assert len(chaos.findings.wrong) == wrong


def test_every_damaged_bundle_is_refused_and_the_map_itself_stays_whole(shelf: Shelf, bundle_path: Path) -> None:
    told = {shelf.damage().split(": ")[1] for _ in range(60)}
    assert len(told) == 9
    for name in shelf.damaged:
        with pytest.raises(StreetfixError):
            MapBundle.open(bundle_paths(shelf.folder / name)[0])
    name, version = shelf.add()
    assert MapBundle.open(shelf.folder / name).manifest.version == version.id


def test_a_half_copied_bundle_is_refused_until_it_is_whole(shelf: Shelf) -> None:
    for _ in range(12):
        name = shelf.begin_copy().split(": ")[0]
        with pytest.raises(StreetfixError):
            MapBundle.open(shelf.folder / name)
        version = shelf.finish_copy(name)
        assert version is not None
        assert MapBundle.open(shelf.folder / name).manifest.version == version.id


def test_a_full_disk_leaves_no_byte(bundle_path: Path) -> None:
    with small_disk(4) as disk:
        if not disk.is_mounted:
            pytest.skip("mounting is not allowed here")
        disk.fill(())
        with pytest.raises(OSError, match="No space left"):
            (disk.folder / "more").write_bytes(b"x")
        disk.free(())
        (disk.folder / "more").write_bytes(b"x")


def test_a_seed_chooses_the_same_actions_again(bundle_path: Path, tmp_path: Path) -> None:
    def chosen(name: str) -> list[str]:
        folder = tmp_path / name / "disk"
        folder.mkdir(parents=True)
        chaos = Chaos(
            Disk(folder, is_mounted=False), bundle_path, Pair(SENT, SENT), seed=5, workers=2, tell=lambda _: None
        )
        return [chaos._choose(number) for number in range(50)]

    assert chosen("first") == chosen("second")
