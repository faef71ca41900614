import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from model_training.calibration.answer_code import code_of
from model_training.verification import examples, made_with
from model_training.verification.even_odds import EvenOdds
from model_training.verification.examples import ANSWER, BESIDE, CANDIDATE, STEPS, Examples, make_examples
from model_training.verification.made_with import MadeWith
from service.errors import DatasetError, EncoderError
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.scoring.comparison import COLUMNS, PLANES, ROWS
from service.scoring.verifier import Verifier


@pytest.fixture(scope="module")
def localizer(small_map):
    return Localizer.open(MapBundle.open(small_map), verifier=EvenOdds())


def silent(*_):
    pass


def test_a_query_of_the_map_gives_its_answer_and_poses_beside_it(localizer, small_dataset):
    """A street of five queries: every answer is found near the truth or away from it, and both are labelled with the distance."""
    found = list(examples._examples(localizer, small_dataset, True, silent))
    assert len(found) == 5
    for each, frame in zip(found, small_dataset.queries("drive1_precise"), strict=True):
        assert each.planes.shape == (len(each.error_m), len(PLANES), ROWS, COLUMNS)
        assert each.origin[0] == ANSWER
        assert (each.origin == ANSWER).sum() == 1
        assert (each.origin == BESIDE).sum() == 2
        assert (each.origin == CANDIDATE).sum() <= 2
        answer = localizer.localize(frame.query(localizer.bundle.grid)).T_map_camera_guess
        error_m = np.hypot(*(answer - frame.T_map_camera)[:2, 3])
        assert each.error_m[0] == pytest.approx(error_m, abs=1e-3)
        assert (each.planes[:, PLANES.index("in_view")] >= 0).all()
        assert each.planes.max() == STEPS


def test_examples_need_no_earlier_verifier(small_map, small_dataset, monkeypatch):
    def missing():
        raise EncoderError("the verifier is missing")

    monkeypatch.setattr(Verifier, "shipped", missing)
    own = Localizer.open(MapBundle.open(small_map), verifier=EvenOdds())
    frame = next(iter(small_dataset.queries("drive1_precise")))
    assert examples._of_query(own, frame, True) is not None
    refined = own.register((own.encode_and_search(frame.query(own.bundle.grid)),)).refined
    assert refined is not None
    assert refined.verified == 0.0
    with pytest.raises(EncoderError, match="is missing"):
        Localizer.open(MapBundle.open(small_map))


def test_every_pose_is_wrong_on_the_map_of_another_city(localizer, small_dataset):
    found = list(examples._examples(localizer, small_dataset, False, silent))
    assert len(found) == 5
    for each in found:
        assert np.isinf(each.error_m).all()
        assert (each.origin != BESIDE).all()


def test_poses_beside_an_answer_are_drawn_from_its_position(localizer, small_dataset):
    frame = next(iter(small_dataset.queries("drive1_precise")))
    one, same = (examples._of_query(localizer, frame, True) for _ in range(2))
    assert one is not None
    assert same is not None
    np.testing.assert_array_equal(one.planes, same.planes)
    np.testing.assert_array_equal(one.error_m, same.error_m)


class City:
    def __init__(self, folder):
        self.folder = folder


@pytest.fixture
def recorded(monkeypatch):
    """Replace simulation, map and localizer by folders; record which city is asked on which map. City 2 has no room."""
    asked: list[tuple[object, ...]] = []

    def simulated(plan, out, report):
        out.mkdir(parents=True, exist_ok=True)
        if plan.name == "verification-2":
            raise DatasetError("only 27 of 40 queries could be placed", field="queries")

    def mapped(city, encoder, out, settings, report):
        out.mkdir()
        asked.append(("map", city.folder.name))

    def found(localizer, city, own, report):
        asked.append((localizer, city.folder.name, own))
        yield Examples(
            np.zeros((1, len(PLANES), ROWS, COLUMNS), np.int8), np.zeros(1, np.float32), np.zeros(1, np.uint8)
        )

    def opened(bundle, verifier):
        assert isinstance(verifier, EvenOdds)
        return bundle

    monkeypatch.setattr(examples, "simulate", simulated)
    monkeypatch.setattr(examples, "build_map", mapped)
    monkeypatch.setattr(examples, "Dataset", City)
    monkeypatch.setattr(MapBundle, "open", lambda path: path.name)
    monkeypatch.setattr(Localizer, "open", opened)
    monkeypatch.setattr(examples, "_examples", found)
    return asked


def listed(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*"))


def test_each_city_is_asked_on_its_own_map_and_the_one_before_too(recorded, encoder_file, tmp_path):
    files = list(make_examples(tmp_path / "work", encoder_file, 2))
    assert recorded == [
        ("map", "verification-0"),
        ("map-0", "verification-0", True),
        ("map", "verification-1"),
        ("map-1", "verification-1", True),
        ("map-1", "verification-0", False),
    ]
    assert [len(Examples.read(file).error_m) for file in files] == [1, 2]
    assert listed(tmp_path / "work") == ["examples-0.npz", "examples-1.npz"]


def test_a_city_without_room_has_no_examples(recorded, encoder_file, tmp_path):
    files = list(make_examples(tmp_path, encoder_file, 4))
    assert [len(Examples.read(file).error_m) for file in files] == [1, 2, 0, 1]
    assert ("map-3", "verification-1", False) not in recorded
    assert listed(tmp_path) == [f"examples-{k}.npz" for k in range(4)]


def test_finished_cities_are_not_made_again(recorded, encoder_file, tmp_path):
    first = list(make_examples(tmp_path, encoder_file, 2))
    recorded.clear()
    assert list(make_examples(tmp_path, encoder_file, 2)) == first
    assert recorded == []


def test_more_cities_still_meet_the_one_before(recorded, encoder_file, tmp_path):
    list(make_examples(tmp_path, encoder_file, 1))
    recorded.clear()
    list(make_examples(tmp_path, encoder_file, 2))
    assert recorded == [
        ("map", "verification-1"),
        ("map-1", "verification-1", True),
        ("map-1", "verification-0", False),
    ]
    assert listed(tmp_path) == ["examples-0.npz", "examples-1.npz"]


@pytest.fixture
def interrupted(recorded, encoder_file, tmp_path, monkeypatch):
    """Interrupt the command while the second of two cities is asked; return the folder of what is unfinished."""
    ask = examples._examples

    def stopped(localizer, city, own, report):
        if city.folder.name == "verification-1":
            raise KeyboardInterrupt
        return ask(localizer, city, own, report)

    monkeypatch.setattr(examples, "_examples", stopped)
    with pytest.raises(KeyboardInterrupt):
        list(make_examples(tmp_path, encoder_file, 2))
    monkeypatch.setattr(examples, "_examples", ask)
    recorded.clear()
    return tmp_path / f"unfinished-{MadeWith.of(encoder_file).key}"


def test_after_an_interruption_the_cities_and_the_map_are_used_again(recorded, interrupted, encoder_file, tmp_path):
    assert listed(interrupted) == ["map-1", "verification-0", "verification-1"]
    list(make_examples(tmp_path, encoder_file, 2))
    assert recorded == [("map-1", "verification-1", True), ("map-1", "verification-0", False)]
    assert listed(tmp_path) == ["examples-0.npz", "examples-1.npz"]


@pytest.mark.usefixtures("recorded")
def test_what_finished_examples_no_longer_need_is_removed(interrupted, encoder_file, tmp_path):
    """An interruption after the examples were written leaves their cities and their map."""
    shutil.copy(tmp_path / "examples-0.npz", tmp_path / "examples-1.npz")
    (interrupted / "map-0").mkdir()
    assert len(list(make_examples(tmp_path, encoder_file, 2))) == 2
    assert listed(tmp_path) == ["examples-0.npz", "examples-1.npz"]


@pytest.mark.usefixtures("recorded")
def test_fewer_cities_leave_what_the_others_need(interrupted, encoder_file, tmp_path):
    list(make_examples(tmp_path, encoder_file, 1))
    assert listed(interrupted) == ["map-1", "verification-1"]


def test_what_another_encoder_left_is_removed(recorded, interrupted, encoder_of, tmp_path):
    (tmp_path / "examples-0.npz").unlink()
    other = tmp_path / "other.onnx"
    other.write_bytes(encoder_of(seed=1))
    (tmp_path / "unfinished-survey").mkdir()  # a folder of someone else
    list(make_examples(tmp_path, other, 1))
    assert not interrupted.exists()
    assert (tmp_path / "unfinished-survey").exists()
    assert recorded == [("map", "verification-0"), ("map-0", "verification-0", True)]


def test_examples_of_another_encoder_are_refused(recorded, encoder_file, encoder_of, tmp_path):
    list(make_examples(tmp_path, encoder_file, 2))
    recorded.clear()
    other = tmp_path / "other.onnx"
    other.write_bytes(encoder_of(seed=1))
    with pytest.raises(DatasetError) as refused:
        list(make_examples(tmp_path, other, 3))
    assert refused.value.field == "work"
    assert refused.value.message == (
        f"{tmp_path}: 2 of 2 files of examples cannot be used (examples-0.npz comes from another encoder); choose another --work, or "
        "remove these files"
    )
    assert recorded == []
    assert list(make_examples(tmp_path, encoder_file, 2)) == [tmp_path / f"examples-{k}.npz" for k in range(2)]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"code": "0" * 16}, "another version of the code"),
        ({"planes": PLANES[:-1]}, "other planes"),
        ({"code": "0" * 16, "planes": PLANES[::-1]}, "another version of the code and other planes"),
    ],
)
@pytest.mark.usefixtures("recorded")
def test_examples_of_other_code_are_refused(encoder_file, tmp_path, changed, said):
    list(make_examples(tmp_path, encoder_file, 2))
    Examples.read(tmp_path / "examples-1.npz").write(
        tmp_path / "examples-1.npz", replace(MadeWith.of(encoder_file), **changed)
    )
    with pytest.raises(DatasetError, match=rf"1 of 2 files.*\(examples-1\.npz comes from {said}\)"):
        list(make_examples(tmp_path, encoder_file, 2))


@pytest.mark.usefixtures("recorded")
def test_examples_that_do_not_say_what_they_were_made_with_are_refused(encoder_file, tmp_path):
    np.savez(tmp_path / "examples-0.npz", planes=np.zeros((0, 9, 64, 128), np.int8), error_m=[], origin=[])
    with pytest.raises(DatasetError, match=r"examples-0\.npz comes from an unknown version of the code"):
        list(make_examples(tmp_path, encoder_file, 1))


@pytest.mark.usefixtures("recorded")
def test_damaged_examples_are_named_before_the_work(encoder_file, tmp_path):
    (tmp_path / "examples-1.npz").write_bytes(b"PK\x03\x04")
    with pytest.raises(DatasetError, match=r"examples-1\.npz.*remove it, and the command makes it again"):
        list(make_examples(tmp_path, encoder_file, 2))
    assert listed(tmp_path) == ["examples-1.npz"]


def test_an_encoder_that_cannot_be_used_is_refused_before_the_work(recorded, tmp_path):
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"no network")
    with pytest.raises(EncoderError, match="cannot load the encoder"):
        list(make_examples(tmp_path / "work", bad, 1))
    assert recorded == []
    assert not (tmp_path / "work").exists()


def test_a_new_verifier_needs_no_new_examples(encoder_file, monkeypatch, tmp_path):
    """The examples depend on no verifier, and the command writes a new one into the folder of the code."""
    root = tmp_path / "installed"
    for name in ("service/scoring/verifier.onnx", "service/scoring/comparison.py"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(b"one")
    monkeypatch.setattr(made_with, "code_of", partial(code_of, root=root))
    before = MadeWith.of(encoder_file)
    (root / "service/scoring/verifier.onnx").write_bytes(b"other")
    assert MadeWith.of(encoder_file) == before
    (root / "service/scoring/comparison.py").write_bytes(b"other")
    assert before.difference_to(MadeWith.of(encoder_file)) == "another version of the code"


def test_all_parts_of_the_code_exist():
    root = Path(__file__).parents[3]
    assert all((root / name).exists() for name in made_with.CODE)


@pytest.mark.usefixtures("recorded")
def test_other_errors_of_a_simulation_are_not_hidden(monkeypatch, encoder_file, tmp_path):
    def refused(plan, out, report):
        out.mkdir(parents=True)
        raise DatasetError(f"{out} contains the simulation of another plan", field="out")

    monkeypatch.setattr(examples, "simulate", refused)
    with pytest.raises(DatasetError, match="another plan"):
        list(make_examples(tmp_path, encoder_file, 1))
    assert [path.name for path in tmp_path.glob("*/*")] == ["verification-0"]
