import shutil
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.calibration import make  # after the skip
from model_training.calibration.answer_code import code_of_answers
from model_training.calibration.families import FAMILIES
from model_training.calibration.fit import CalibrationData, pooled
from service.confidence.features import FEATURES

COUNT, MARGIN = len(FEATURES), FEATURES.index("margin")


def city(seed, *, upside_down=False, count=1200):
    """Right where the margin is positive, but for chance; five sorts of queries, both presets."""
    rng = np.random.default_rng(seed)
    evidence = rng.normal(size=(count, COUNT))
    sort = rng.integers(0, 5, count)
    evidence[:, MARGIN] += np.where(sort == 0, 3.0, -3.0)
    known = sort == 0
    right = known & (rng.random(count) < 0.9)
    if upside_down:
        evidence[:, MARGIN] *= -1
    presets = np.where(rng.random(count) < 0.5, "precise", "stereo")
    names = np.array(["clear_", "other_city.", "removed_streets.", "wall.", "room."])[sort]
    return CalibrationData(
        evidence=evidence,
        right=right,
        known=known,
        kind=np.char.add(names, presets),
        family=np.full(len(evidence), "any"),
        error=np.full((len(evidence), 6), np.nan),
        covariance=np.full((len(evidence), 6, 6), np.nan),
        heading_rad=np.full(len(evidence), np.nan),
    )


def _dataset(name, folder):
    camera = SimpleNamespace(pinhole=lambda: "camera")
    return SimpleNamespace(
        name=name, folder=folder / name, description=SimpleNamespace(sensors=SimpleNamespace(cameras=[camera]))
    )


def _name_of(rig):
    return () if rig is None else (rig.name,)


class Work:
    """Cities that are never simulated, maps that are never built, questions that are never asked: who would have asked what."""

    def __init__(self, monkeypatch, folder, encoder):
        self.folder, self.encoder, self.built, self.asked = folder, encoder, [], []
        self.simulated = []
        monkeypatch.setattr(make, "CITIES", 3)
        monkeypatch.setattr(
            make, "calibration_plan", lambda index: SimpleNamespace(name=("one", "two", "three")[index], seed=index)
        )
        monkeypatch.setattr(make, "simulate", lambda plan, *_, **__: self.simulated.append(plan.name))
        monkeypatch.setattr(make, "Dataset", lambda folder: _dataset(folder.name, folder.parent))
        monkeypatch.setattr(make, "WithoutStreets", self.without_streets)
        monkeypatch.setattr(make, "build_map", self.build_map)
        monkeypatch.setattr(make, "MapBundle", SimpleNamespace(open=lambda folder: folder.name.rsplit("-", 1)[0]))
        monkeypatch.setattr(make, "Localizer", SimpleNamespace(open=lambda bundle: bundle))
        monkeypatch.setattr(make, "in_the_map", self.asking("in_the_map"))
        monkeypatch.setattr(make, "of_another_city", self.asking("of_another_city"))
        monkeypatch.setattr(make, "where_streets_are_missing", self.where_streets_are_missing)
        monkeypatch.setattr(make, "walls_and_rooms", self.walls_and_rooms)

    def without_streets(self, folder):
        return SimpleNamespace(name=folder.name, folder=folder, is_outside="is_outside", partial=True)

    def build_map(self, dataset, encoder, folder, settings, *, report):
        folder.mkdir()
        assert (encoder, report) == (self.encoder, print)
        assert settings.calibration is None  # or the answers would already be judged
        self.built.append((dataset.name, hasattr(dataset, "partial"), settings.name, settings.spacing_m))

    def asking(self, how):
        def ask(localizer, dataset, report, names=(), *, rig=None):
            self.asked.append((how, localizer, dataset.name, tuple(names), *_name_of(rig)))
            return [city(len(self.asked), count=10)]

        return ask

    def where_streets_are_missing(self, localizer, dataset, names, is_outside, report):
        assert (is_outside, report) == ("is_outside", print)
        self.asked.append(("where_streets_are_missing", localizer, dataset.name, tuple(names)))
        return [city(len(self.asked), count=10)]

    def walls_and_rooms(self, localizer, camera, seed, report, models, *, count=100, rig=None):
        assert (camera, report) == ("camera", print)
        assert {model.name for model in models} <= {"precise", "stereo"}
        assert count in (40, 100)
        self.asked.append(("walls_and_rooms", localizer, seed, *_name_of(rig)))
        return [city(len(self.asked), count=10)]

    def all_of(self, index, *, anew=False):
        return make._data_of_city(self.folder, self.encoder, index, anew=anew, report=print)


@pytest.fixture
def work(monkeypatch, tmp_path, encoder_file):
    return Work(monkeypatch, tmp_path, encoder_file)


CLEAR = ("clear_precise", "clear_stereo")


def test_the_queries_of_a_city_are_localized_in_its_own_map_the_other_one_and_without_some_streets(work):
    """A rig that sees less localizes the same queries in both maps."""
    found = work.all_of(1)
    assert work.asked == [
        ("in_the_map", "two", "two", ()),
        ("walls_and_rooms", "two", 1),
        ("of_another_city", "three", "two", ()),
        ("in_the_map", "two", "two", CLEAR, "narrow"),
        ("walls_and_rooms", "two", 1, "narrow"),
        ("of_another_city", "three", "two", CLEAR, "narrow"),
        ("where_streets_are_missing", "two-without-streets", "two", CLEAR),
    ]
    np.testing.assert_array_equal(found.evidence, pooled([city(k, count=10) for k in range(1, 8)]).evidence)
    assert work.built == [
        ("two", False, "two", 1.0),
        ("three", False, "three", 1.0),
        ("two", True, "two-without-streets", 1.0),
    ]


def test_repeating_blocks_are_asked_of_their_own_map_and_kept(work, monkeypatch):
    monkeypatch.setattr(make, "repeating_plan", lambda: SimpleNamespace(name="blocks"))
    first = make._data_of_repeating(work.folder, work.encoder, anew=False, report=print)
    again = make._data_of_repeating(work.folder, work.encoder, anew=False, report=print)
    assert work.asked == [("in_the_map", "blocks", "blocks", ())]
    assert work.built == [("blocks", False, "blocks", 1.0)]
    np.testing.assert_array_equal(first.evidence, again.evidence)


def test_a_family_localizes_the_queries_of_its_cities_in_both_maps(work):
    car = FAMILIES[0]
    found = make._data_of_family(work.folder, work.encoder, car, anew=False, report=print)
    one, two = "calibration-car-1", "calibration-car-2"
    assert work.asked == [
        ("in_the_map", one, one, (), "car"),
        ("of_another_city", two, one, (), "car"),
        ("in_the_map", two, two, (), "car"),
        ("of_another_city", one, two, (), "car"),
        ("walls_and_rooms", two, 0, "car"),
    ]
    assert len(found) == 50
    assert set(found.family.tolist()) == {"car"}
    assert {name for name, *_ in work.built} == {one, two}


def test_stored_answers_need_neither_cities_nor_maps(work, tmp_path):
    """The answers alone are enough to repeat the fit."""
    first = make.collected(work.folder, work.encoder, report=print)
    simulated, built, other = len(work.simulated), len(work.built), tmp_path / "answers"
    assert simulated > 0
    other.mkdir()
    for kept in work.folder.glob("asked-*.npz"):
        shutil.copy(kept, other)
    again = make.collected(other, work.encoder, report=print)
    np.testing.assert_array_equal(again.evidence, first.evidence)
    assert (len(work.simulated), len(work.built)) == (simulated, built)
    assert {path.suffix for path in other.iterdir()} == {".npz"}


def test_the_last_city_is_asked_of_the_first_ones_maps(work):
    work.all_of(2)
    assert [row[1] for row in work.asked if row[0] == "of_another_city"] == ["one", "one"]


def test_maps_and_answers_are_kept_and_questions_asked_anew_only_on_demand(work):
    """The map of each city serves the queries of another city too."""
    first = work.all_of(1)
    count = len(work.asked)
    again = work.all_of(1)
    assert len(work.asked) == count
    np.testing.assert_array_equal(again.evidence, first.evidence)
    assert again.kind.tolist() == first.kind.tolist()
    work.all_of(1, anew=True)
    assert len(work.asked) == 2 * count
    assert len(work.built) == 3
    work.all_of(2)
    assert [row[2] for row in work.built[3:]] == ["one", "three-without-streets"]


def test_stored_answers_name_the_version_of_the_code(work, monkeypatch):
    """An older release did not keep it. A line of the command tells how many files are of another version."""
    make.collected(work.folder, work.encoder, report=print)
    codes = make.codes_of_answers(work.folder, work.encoder)
    assert set(codes.values()) == {code_of_answers()}
    assert len(codes) == 3 + len(FAMILIES) + 1
    name = next(name for name in codes if name.startswith("asked-calibration-car-1-"))
    with np.load(work.folder / name) as kept:
        arrays = {field: kept[field] for field in CalibrationData.__dataclass_fields__}
    np.savez_compressed(work.folder / name, **arrays)
    assert {each for each, code in make.codes_of_answers(work.folder, work.encoder).items() if code is None} == {name}
    monkeypatch.setattr(make, "fit", lambda *_, **__: "calibration")
    monkeypatch.setattr(make, "cross_check", lambda *_, **__: [])
    _, told = make.calibrate(work.folder, work.encoder, report=print)
    assert told[-1].startswith(
        f"1 of {len(codes)} files of answers in {work.folder} are of another version of the code; --anew"
    )


def test_answers_of_the_present_code_need_no_word(work, monkeypatch):
    monkeypatch.setattr(make, "fit", lambda *_, **__: "calibration")
    monkeypatch.setattr(make, "cross_check", lambda *_, **__: [])
    _, told = make.calibrate(work.folder, work.encoder, report=print)
    assert not any("another version" in line for line in told)
