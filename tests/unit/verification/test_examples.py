import numpy as np
import pytest

from model_training.verification import examples
from model_training.verification.even_odds import EvenOdds
from model_training.verification.examples import ANSWER, BESIDE, CANDIDATE, STEPS, Examples, make_examples
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
        out.mkdir(exist_ok=True)
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


def test_each_city_is_asked_on_its_own_map_and_the_one_before_too(recorded, tmp_path):
    files = list(make_examples(tmp_path / "work", tmp_path / "encoder.onnx", 2))
    assert recorded == [
        ("map", "verification-0"),
        ("map-0", "verification-0", True),
        ("map", "verification-1"),
        ("map-1", "verification-1", True),
        ("map-1", "verification-0", False),
    ]
    assert [len(Examples.read(file).error_m) for file in files] == [1, 2]
    assert sorted(path.name for path in (tmp_path / "work").iterdir()) == ["examples-0.npz", "examples-1.npz"]


def test_a_city_without_room_has_no_examples(recorded, tmp_path):
    files = list(make_examples(tmp_path, tmp_path / "encoder.onnx", 4))
    assert [len(Examples.read(file).error_m) for file in files] == [1, 2, 0, 1]
    assert ("map-3", "verification-1", False) not in recorded
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"examples-{k}.npz" for k in range(4)]


def test_finished_cities_are_not_made_again(recorded, tmp_path):
    first = list(make_examples(tmp_path, tmp_path / "encoder.onnx", 2))
    recorded.clear()
    assert list(make_examples(tmp_path, tmp_path / "encoder.onnx", 2)) == first
    assert recorded == []


def test_after_an_interruption_the_next_city_still_meets_the_one_before(recorded, tmp_path):
    list(make_examples(tmp_path, tmp_path / "encoder.onnx", 1))
    recorded.clear()
    list(make_examples(tmp_path, tmp_path / "encoder.onnx", 2))
    assert recorded == [
        ("map", "verification-1"),
        ("map-1", "verification-1", True),
        ("map-1", "verification-0", False),
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["examples-0.npz", "examples-1.npz"]


def test_other_errors_of_a_simulation_are_not_hidden(recorded, monkeypatch, tmp_path):
    def refused(plan, out, report):
        raise DatasetError(f"{out} contains the simulation of another plan", field="out")

    monkeypatch.setattr(examples, "simulate", refused)
    (tmp_path / "verification-0").mkdir()
    with pytest.raises(DatasetError, match="another plan"):
        list(make_examples(tmp_path, tmp_path / "encoder.onnx", 1))
    assert (tmp_path / "verification-0").exists()
