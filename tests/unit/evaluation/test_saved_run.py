"""A run saved in a folder."""

import json
import shutil

import numpy as np
import pytest

from model_training.evaluation.evaluate import evaluate
from model_training.evaluation.predict import Predictions
from model_training.evaluation.saved_run import SavedRun, commit_of
from service.errors import DatasetError
from service.maps.reader import MapBundle

SET = "drive1_precise"


@pytest.fixture
def own_run(saved_run, tmp_path):
    return shutil.copytree(saved_run, tmp_path / "own")


def test_a_saved_run_names_its_queries_and_its_map(saved_run, small_map, small_dataset):
    settings = SavedRun.open(saved_run).settings
    assert (settings.map.name, settings.map.version) == ("small", MapBundle.open(small_map).manifest.version)
    assert settings.dataset.path == str(small_dataset.folder.resolve())
    assert [(each.name, each.split, each.queries, each.condition) for each in settings.sets] == [
        (SET, "other_drive", 5, "clear")
    ]
    assert settings.registered


def test_answers_come_back_as_they_were(saved_run, small_map, small_dataset):
    found = SavedRun.open(saved_run).predictions[SET]
    again = evaluate(MapBundle.open(small_map), small_dataset, workers=1).predictions[SET]
    np.testing.assert_allclose(found.T_answer, again.T_answer)
    np.testing.assert_allclose(found.candidates, again.candidates)
    assert np.isfinite(found.candidates[:, 0]).all()
    np.testing.assert_allclose(found.candidates[:, 0, :2], found.T_answer[:, :2, 3])
    assert (found.hypotheses[:, 0, 3] > 0).all()


def test_answers_of_an_earlier_release_are_read_without_candidates(saved_run, tmp_path):
    with np.load(saved_run / "answers" / f"{SET}.npz", allow_pickle=False) as arrays:
        np.savez(
            tmp_path / "old.npz", **{name: arrays[name] for name in arrays if name not in ("hypotheses", "candidates")}
        )
    old = Predictions.load(tmp_path / "old.npz")
    assert old.candidates.shape == (5, 4, 4)
    assert np.isnan(old.candidates).all()


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-100])


@pytest.mark.parametrize(
    ("broken", "told"),
    [
        (lambda run: (run / "run.json").unlink(), "not a saved run: run.json is missing"),
        (lambda run: (run / "run.json").write_text("{}"), "map: Field required"),
        (lambda run: (run / "answers" / f"{SET}.npz").write_bytes(b"PK"), "not an answer file of Streetfix"),
        (lambda run: (run / "answers" / f"{SET}.npz").unlink(), "not an answer file of Streetfix"),
        (lambda run: cut_off(run / "answers" / f"{SET}.npz"), "not an answer file of Streetfix"),
        (lambda run: rewrite(run, queries=6), "5 answers, but run.json says 6"),
        (lambda run: rewrite(run, name="../../etc"), "should match pattern"),
    ],
)
def test_a_broken_folder_is_refused_with_what_is_wrong(own_run, broken, told):
    broken(own_run)
    with pytest.raises(DatasetError, match=told):
        SavedRun.open(own_run)


def rewrite(run, **changed):
    settings = json.loads((run / "run.json").read_text())
    settings["sets"][0] |= changed
    (run / "run.json").write_text(json.dumps(settings))


@pytest.mark.parametrize("packed", [False, True])
def test_the_commit_is_the_one_that_the_branch_stands_at(tmp_path, packed):
    git, file = tmp_path / ".git", tmp_path / "package" / "module.py"
    (git / "refs" / "heads").mkdir(parents=True)
    (git / "HEAD").write_text("ref: refs/heads/main\n")
    if packed:
        (git / "packed-refs").write_text(f"# pack-refs\n{'b' * 40} refs/heads/other\n{'a' * 40} refs/heads/main\n")
    else:
        (git / "refs" / "heads" / "main").write_text("a" * 40 + "\n")
    assert commit_of(file) == "a" * 40


def test_outside_a_checkout_there_is_no_commit(tmp_path):
    assert commit_of(tmp_path / "module.py") is None
