"""The second pass of a survey: its path, its day, and the map to which it is added."""

import shutil
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from benchmarks import second_pass as under_test  # after the skip
from benchmarks.runs import Runs
from benchmarks.second_pass import _has_room, second_pass, second_poses, updated
from model_training.datasets.dataset import Dataset
from model_training.simulation.city import City
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.traversal import stations_along
from service.maps.reader import MapBundle


@pytest.fixture(scope="module")
def plan(small_dataset):
    return SimulationPlan.model_validate(small_dataset.description.source["plan"])


@pytest.fixture(scope="module")
def city(plan):
    return City(seed=plan.seed, name=plan.city, size_m=plan.size_m)


def test_the_second_pass_drives_in_the_other_direction_one_metre_beside_the_first(city, plan):
    """Both keep 0.5 m to the right of the centre line. So each has the other 1 m to its left."""
    true, written = second_poses(city, plan)
    first = stations_along([street for street in city.streets if street.street in plan.streets], 0.1)
    path = np.array([[station.x, station.y, station.heading] for station in first])
    for T in true:
        away = path[:, :2] - T[:2, 3]
        nearest = int(np.hypot(*away.T).argmin())
        assert np.hypot(*away[nearest]) == pytest.approx(1.0, abs=0.03)
        ahead = T[:2, 0] / np.hypot(*T[:2, 0])
        assert ahead @ [np.cos(path[nearest, 2]), np.sin(path[nearest, 2])] == pytest.approx(-1.0, abs=0.01)
        assert ahead[0] * away[nearest][1] - ahead[1] * away[nearest][0] > 0.9  # to the left
    assert np.linalg.norm(np.diff(true[:, :2, 3], axis=0), axis=1) == pytest.approx(plan.spacing_m, rel=0.05)
    errors = np.linalg.norm(written[:, :3, 3] - true[:, :3, 3], axis=1)
    assert 0.001 < errors.max() < 0.3  # 0.03 m per axis


def test_poses_without_room_are_left_out(city, plan):
    every, _ = second_poses(city, plan)
    east = float(np.median(every[:, 0, 3]))
    some, written = second_poses(city, plan, lambda T: T[0, 3] > east)
    np.testing.assert_array_equal(some, every[every[:, 0, 3] > east])
    assert len(written) == len(some) < len(every)


@pytest.mark.parametrize(("distance_m", "room"), [(0.0, True), (0.49, False), (0.51, True)])
def test_a_vehicle_has_room_unless_an_object_is_nearer_than_half_a_metre(distance_m, room):
    """A ray that meets nothing has the distance 0."""
    scene: Any = SimpleNamespace(distances=lambda _, rays: np.where(np.arange(len(rays)) == 7, distance_m, 0.0))
    assert _has_room(scene, np.eye(4)) is room


@pytest.fixture(scope="module")
def again(small_dataset, plan, tmp_path_factory):
    return second_pass(small_dataset, plan, tmp_path_factory.mktemp("again") / "small-second-pass-0")


def test_the_second_pass_is_a_survey_in_the_same_frame_on_another_day(again, small_dataset, city, plan):
    _, written = second_poses(city, plan)
    np.testing.assert_allclose(again.survey_poses(), written, atol=1e-6)
    assert again.streets() == small_dataset.streets()
    assert again.query_sets(with_truth=False) == []
    assert (again.name, again.description.sensors) == ("small-second-pass", small_dataset.description.sensors)
    assert all(len(again.scan(number)) > 1000 for number in range(len(written)))
    day, other = city.occupants(0), city.occupants(under_test.TRAVERSAL)
    assert day.triangles.shape != other.triangles.shape or not np.array_equal(day.triangles, other.triangles)


def test_a_finished_second_pass_is_opened_and_an_unfinished_one_starts_again(
    again, small_dataset, plan, tmp_path, monkeypatch
):
    part = tmp_path / "a.part"
    part.mkdir()
    (part / "old").touch()
    made = second_pass(small_dataset, plan, tmp_path / "a")
    assert not (made.folder / "old").exists()
    for number in range(len(again.survey_poses())):
        np.testing.assert_array_equal(made.scan(number), again.scan(number))
    monkeypatch.setattr(under_test, "Scene", None)  # a second simulation would fail
    assert second_pass(small_dataset, plan, tmp_path / "a").folder == made.folder


def test_the_second_pass_is_added_to_the_map_once(again, small_map, encoder_file, tmp_path, monkeypatch):
    shutil.copytree(small_map, tmp_path / "m")
    first, runs = MapBundle.open(tmp_path / "m"), Runs(tmp_path / "work", encoder_file)
    both = updated(runs, first, again, "two")
    assert both.path.parent == tmp_path / "work" / "maps"
    assert both.path.name.startswith("two-0-")  # with the code of the second pass
    count = len(first.T_map_place)
    np.testing.assert_allclose(both.T_map_place[:count, :2, 3], first.T_map_place[:, :2, 3], atol=1e-9)
    assert both.cloud is not None
    assert first.cloud is not None
    assert len(both.cloud.unpacked(np.s_[:])) > len(first.cloud.unpacked(np.s_[:]))
    monkeypatch.setattr(under_test, "update_map", None)  # a second update would fail
    assert updated(runs, first, Dataset(again.folder), "two").path == both.path
