"""Trainings from city archives and from packs are the same."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training import unpacked_cities  # noqa: E402  # after the skip
from model_training.training.archive_places import FolderOfArchives, archives_at  # noqa: E402
from model_training.training.archive_reader import unpack_archive  # noqa: E402
from model_training.training.batches import City  # noqa: E402
from model_training.training.city_archive import archive_name, write_archive  # noqa: E402
from model_training.training.loop import TrainingConfig, train  # noqa: E402
from model_training.training.packs import Pack, PackPlan  # noqa: E402
from model_training.training.processes import ALONE, Processes  # noqa: E402
from model_training.training.unpacked_cities import unpack_together  # noqa: E402
from service.errors import DatasetError  # noqa: E402

PLANS = [PackPlan(seed=1000 + k, places=40, queries_a_place=1) for k in range(3)]


@pytest.fixture(scope="module")
def packs(pack_of, tmp_path_factory):
    root = tmp_path_factory.mktemp("packs")
    return [pack_of(root / plan.stem, places=40, seed=k) for k, plan in enumerate(PLANS)]


@pytest.fixture(scope="module")
def place(packs, grid, tmp_path_factory):
    folder = tmp_path_factory.mktemp("archives")
    for plan, pack in zip(PLANS, packs, strict=True):
        write_archive(pack, plan, grid, folder / archive_name(plan))
    return FolderOfArchives(folder)


def losses_of(cities, run, config):
    losses = []
    train(cities, run, config, device="cpu", report=lambda progress: losses.append(progress.loss))
    return losses


def test_both_ways_give_the_same_batches_and_losses(packs, place, grid, shape, tmp_path):
    told = []
    folders = unpack_together(PLANS, place, tmp_path / "packs", grid, ALONE, report=lambda *event: told.append(event))
    assert told == [("unpacking cities", done, 3) for done in range(4)]
    for one, other in zip(packs, folders, strict=True):
        batches = [
            City(Pack.open(pack), grid, turn_deg=9.0).draw(24, np.random.default_rng(7)) for pack in (one, other)
        ]
        for name in (
            "survey_ranges",
            "survey_intensity",
            "survey_height_m",
            "query_ranges",
            "query_rgb",
            "query_height_m",
        ):
            torch.testing.assert_close(getattr(batches[0], name), getattr(batches[1], name), rtol=0, atol=0)
        assert torch.equal(batches[0].survey_xy, batches[1].survey_xy)
        assert torch.equal(batches[0].rows_seen, batches[1].rows_seen)
    config = TrainingConfig(
        steps=4, pairs=24, warm_up_steps=2, encoder=shape, memory_after=2, alike_seeds=3, alike_each=3
    )
    losses = losses_of(packs, tmp_path / "of_packs", config)
    assert len(losses) == 4
    assert losses_of(folders, tmp_path / "of_archives", config) == losses


def test_a_pack_that_is_there_is_not_unpacked_again(place, grid, tmp_path):
    for plan in PLANS:
        (tmp_path / plan.stem).mkdir()
    (
        tmp_path / f".{PLANS[0].stem}.unpacked-1234.part"
    ).mkdir()  # of a process that was killed after it had renamed the folder
    told = []
    folders = unpack_together(
        PLANS, FolderOfArchives(tmp_path / "none"), tmp_path, grid, ALONE, report=lambda *e: told.append(e)
    )
    assert folders == [tmp_path / plan.stem for plan in PLANS]
    assert sorted(tmp_path.iterdir()) == folders
    assert told == []


def test_cities_that_are_not_simulated_are_named_before_any_is_unpacked(place, grid, tmp_path):
    more = [*PLANS, PackPlan(seed=1777), PackPlan(seed=1778)]
    with pytest.raises(
        DatasetError,
        match=r"cities_from: .*pack3-city-1777.*\.tar is missing, and 2 of 5 cities in all; simulate .*streetfix simulate-training",
    ):
        unpack_together(more, place, tmp_path / "packs", grid, ALONE)
    assert list((tmp_path / "packs").iterdir()) == []


def test_a_damaged_archive_leaves_no_part_of_a_pack(place, grid, tmp_path):
    whole = (place.folder / archive_name(PLANS[0])).read_bytes()
    (tmp_path / archive_name(PLANS[0])).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DatasetError, match=r"pack3-city-1000-.*\.tar: .*delete the file and make it again"):
        unpack_together(PLANS[:1], FolderOfArchives(tmp_path), tmp_path / "packs", grid, ALONE)
    assert list((tmp_path / "packs").iterdir()) == []


def test_a_url_is_named_in_errors(place, grid, tmp_path):
    stored = archives_at(f"file://{place.folder}")
    folders = unpack_together(PLANS[:1], stored, tmp_path / "packs", grid, ALONE)
    assert [path.name for path in (tmp_path / "packs").iterdir()] == [folders[0].name]
    (tmp_path / archive_name(PLANS[1])).write_bytes(b"damaged" * 99)
    with pytest.raises(DatasetError, match=rf"^file://{tmp_path}/pack3-city-1001-.*\.tar: it is no tar file"):
        unpack_together(PLANS[1:2], archives_at(f"file://{tmp_path}"), tmp_path / "packs", grid, ALONE)


class Threads(Processes):
    """Threads in place of the processes of two machines."""

    barrier = threading.Barrier(4)

    def wait(self):
        self.barrier.wait(timeout=60)


@pytest.mark.parametrize("shared", [False, True])
def test_the_processes_of_each_machine_unpack_all_cities_once(place, packs, grid, tmp_path, monkeypatch, shared):
    unpacked = []

    def note(archive, plan, grid, folder, *, name):
        unpacked.append((folder.parent.parent.name, plan.seed))
        unpack_archive(archive, plan, grid, folder, name=name)

    monkeypatch.setattr(unpacked_cities, "unpack_archive", note)
    machines = [tmp_path / ("both" if shared else f"machine{rank // 2}") for rank in range(4)]

    def of(rank):
        return unpack_together(PLANS, place, machines[rank], grid, Threads(rank, 4, rank % 2, 2))

    with ThreadPoolExecutor(4) as pool:
        folders = list(pool.map(of, range(4)))
    if not shared:
        assert sorted(unpacked) == [(f"machine{machine}", 1000 + k) for machine in range(2) for k in range(3)]
    for rank, found in enumerate(folders):
        assert found == [machines[rank] / plan.stem for plan in PLANS]
        for pack, folder in zip(packs, found, strict=True):
            assert {path.name: path.read_bytes() for path in folder.iterdir()} == {
                path.name: path.read_bytes() for path in pack.iterdir()
            }
    for machine in machines:
        assert {path.name for path in machine.iterdir()} == {plan.stem for plan in PLANS}


def test_a_full_disk_is_told_with_a_remedy(place, grid, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(unpacked_cities, "unpack_archive", fail)
    with pytest.raises(DatasetError, match=r"the city cannot be unpacked \(No space left on device\).*another --packs"):
        unpack_together(PLANS[:1], place, tmp_path, grid, ALONE)
    assert list(tmp_path.iterdir()) == []
