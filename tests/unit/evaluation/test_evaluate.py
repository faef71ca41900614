import shutil

import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import Dataset, read_tum, write_tum
from model_training.evaluation.evaluate import evaluate, write_trajectory
from service.maps.reader import MapBundle

NAME = "drive1_precise"
STAMPS = 1403636579.75 + 0.5 * np.arange(5)


@pytest.fixture
def stamped(small_dataset, tmp_path):
    """The small dataset as if it were recorded: timestamps of a clock, and a picture without depth among the queries."""
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
