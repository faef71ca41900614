import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import (
    Dataset,
    DatasetDescription,
    Sensors,
    read_tum,
    write_description,
    write_tum,
)
from model_training.evaluation.evaluate import city_seen_in_training, evaluate, split_of, write_trajectory
from model_training.evaluation.measures import measure
from model_training.simulation.plan import QueryPlan, SimulationPlan
from service.maps.reader import MapBundle

NAME = "drive1_precise"
STAMPS = 1403636579.75 + 0.5 * np.arange(5, dtype=np.float64)


@pytest.fixture
def stamped(small_dataset, tmp_path):
    """Return the small dataset like a recording: timestamps of a clock, and one query image without depth."""
    folder = shutil.copytree(small_dataset.folder, tmp_path / "stamped")
    queries = folder / "queries" / NAME
    write_tum(queries / "poses.txt", STAMPS, read_tum(queries / "poses.txt")[1])
    empty = cv2.imencode(".png", np.zeros((72, 96), np.uint16))[1].tobytes()
    (queries / "depth" / "000002.png").write_bytes(empty)
    return Dataset(folder)


def test_the_trajectory_has_the_timestamps_of_the_truth(small_map, stamped, tmp_path, evo_ape):
    found = evaluate(MapBundle.open(small_map), stamped, [NAME])
    write_trajectory(tmp_path / "answers.txt", found.predictions[NAME])
    np.testing.assert_array_equal(read_tum(tmp_path / "answers.txt")[0], STAMPS[[0, 1, 3, 4]])
    ape = evo_ape(stamped.folder / "queries" / NAME / "poses.txt", tmp_path / "answers.txt", "--project_to_plane", "xy")
    assert ape.pairs == 4
    assert ape.rmse_m == pytest.approx(found.figures["rms_distance_error_m"], abs=1e-5)


def test_the_trajectory_leaves_out_what_was_not_accepted(small_map, stamped, tmp_path, evo_ape):
    """The figure of evo must equal ours also if the map refuses answers."""
    found = evaluate(MapBundle.open(small_map), stamped, [NAME]).predictions[NAME]
    refused = replace(found, status=np.where(np.arange(5) == 1, "AMBIGUOUS", found.status))
    write_trajectory(tmp_path / "answers.txt", refused)
    np.testing.assert_array_equal(read_tum(tmp_path / "answers.txt")[0], STAMPS[[0, 3, 4]])
    ape = evo_ape(stamped.folder / "queries" / NAME / "poses.txt", tmp_path / "answers.txt", "--project_to_plane", "xy")
    assert ape.rmse_m == pytest.approx(measure(refused, [str(k) for k in range(40)])["rms_distance_error_m"], abs=1e-5)


ELSEWHERE, HERE, UNKNOWN = ("city-1000",), ("city-1000", "city-9"), ()


@pytest.fixture
def split_in(tmp_path):
    """Return the split of a set, for a dataset with this source and an encoder trained on these cities."""

    def of(source, name, trained_on):
        write_description(tmp_path, DatasetDescription(name="any", source=source, sensors=Sensors()))
        dataset = Dataset(tmp_path)
        return split_of(dataset, name, city_seen_in_training(dataset, trained_on))

    return of


@pytest.mark.parametrize(
    ("name", "trained_on", "split"),
    [
        ("drive_precise", ELSEWHERE, "unseen_city"),
        ("drive_stereo", HERE, "other_drive"),
        ("drive_precise", UNKNOWN, "other_drive"),
        ("drive_on_precise", ELSEWHERE, "same_drive"),
        ("beside_precise", ELSEWHERE, "same_drive"),
        ("put_there_by_hand", ELSEWHERE, "same_drive"),
    ],
)
def test_simulated_sets_are_split_by_drive_and_city(split_in, name, trained_on, split):
    queries = (
        QueryPlan(name="drive", traversal=1, depths=("precise", "stereo")),
        QueryPlan(name="drive_on", traversal=0, on_track=True),
        QueryPlan(name="beside", traversal=0),
    )
    plan = SimulationPlan(name="any", seed=9, queries=queries)
    assert split_in({"kind": "simulation", "plan": plan.model_dump(mode="json")}, name, trained_on) == split


@pytest.mark.parametrize("trained_on", [ELSEWHERE, UNKNOWN])
def test_frames_of_the_survey_itself_are_of_the_same_drive_wherever_they_were_recorded(split_in, trained_on):
    assert split_in({"kind": "kitti-object", "queries": {"frames": ["000003"]}}, "frames", trained_on) == "same_drive"


@pytest.mark.parametrize(("trained_on", "split"), [(ELSEWHERE, "unseen_city"), (UNKNOWN, "other_drive")])
def test_a_recording_says_which_of_its_sets_are_of_other_drives(split_in, trained_on, split):
    source = {"kind": "log", "other_drives": ["second_day"]}
    assert split_in(source, "second_day", trained_on) == split
    assert split_in(source, "first_day", trained_on) == "same_drive"
