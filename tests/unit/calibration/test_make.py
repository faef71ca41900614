import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.calibration import make  # after the skip
from model_training.calibration.fit import Asked, fit, pooled
from model_training.calibration.make import confidences, cross_checks
from model_training.calibration.plans import PAIR_RIGS
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
    return Asked(evidence, right, known, np.char.add(names, presets))


def test_confidence_is_the_calibrations_and_nothing_where_nothing_was_registered():
    asked = city(1)
    calibration = fit(asked, measured_on={})
    asked.evidence[5] = np.nan
    found = confidences(calibration, asked)
    assert found[5] == 0
    rest = np.arange(len(asked)) != 5
    np.testing.assert_allclose(found[rest], calibration.confidence(asked.evidence[rest]))


def test_every_city_is_predicted_from_the_others_with_both_presets():
    lines = cross_checks([city(seed, count=4000) for seed in (1, 2, 3)], city(4))
    assert len(lines) == 9
    for index in range(3):
        head, *presets = lines[3 * index : 3 * index + 3]
        error = re.fullmatch(rf"city {index + 1} from the others: expected calibration error (0\.\d{{4}})", head)
        assert error is not None
        assert float(error[1]) < 0.1
        for preset, line in zip(("precise", "stereo"), presets, strict=True):
            shares = re.fullmatch(
                rf"  {preset}: false accepts at 95 % of the true ones: "
                r"other_city (0\.\d{4}), removed_streets (0\.\d{4}), wall (0\.\d{4}), room (0\.\d{4})",
                line,
            )
            assert shares is not None
            assert max(map(float, shares.groups())) < 0.05


def test_a_city_is_not_predicted_from_itself():
    """The second contradicts the first: each is predicted as wrongly as can be, however well it fits itself."""
    one, other = city(1), city(2, upside_down=True)
    heads = [line for line in cross_checks([one, other], city(3, count=10)) if line.startswith("city")]
    assert min(float(line.rsplit(" ", 1)[1]) for line in heads) > 0.3
    assert len(pooled([one, other])) == 2400


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
        self.cities = [_dataset(name, folder) for name in ("one", "two", "three")]
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

    def walls_and_rooms(self, localizer, camera, seed, report, *, rig=None):
        assert (camera, report) == ("camera", print)
        self.asked.append(("walls_and_rooms", localizer, seed, *_name_of(rig)))
        return [city(len(self.asked), count=10)]

    def all_of(self, index, *, anew=False):
        return make._asked(self.folder, self.encoder, self.cities, index, anew=anew, report=print)


@pytest.fixture
def work(monkeypatch, tmp_path, encoder_file):
    return Work(monkeypatch, tmp_path, encoder_file)


CLEAR = ("clear_precise", "clear_stereo")


def test_a_city_is_asked_of_its_own_map_the_next_ones_sparse_ones_of_both_and_where_streets_are_missing(work):
    """Who comes to a sparse survey looks less like its places, whether he is a stranger or not; so does a rig that sees less."""
    found = work.all_of(1)
    assert work.asked == [
        ("in_the_map", "two", "two", ()),
        ("walls_and_rooms", "two", 1),
        ("of_another_city", "three", "two", ()),
        ("in_the_map", "two", "two", CLEAR, "narrow"),
        ("walls_and_rooms", "two", 1, "narrow"),
        ("of_another_city", "three", "two", CLEAR, "narrow"),
        ("in_the_map", "two-sparse", "two", CLEAR),
        ("of_another_city", "three-sparse", "two", CLEAR),
        ("where_streets_are_missing", "two-without-streets", "two", CLEAR),
    ]
    np.testing.assert_array_equal(found.evidence, pooled([city(k, count=10) for k in range(1, 10)]).evidence)


def test_a_sparse_map_has_a_place_every_five_metres_and_any_other_every_metre(work):
    work.all_of(1)
    assert work.built == [
        ("two", False, "two", 1.0),
        ("three", False, "three", 1.0),
        ("two", False, "two-sparse", 5.0),
        ("three", False, "three-sparse", 5.0),
        ("two", True, "two-without-streets", 1.0),
    ]


def test_repeating_blocks_are_asked_of_their_own_map_and_kept(work):
    street: Any = SimpleNamespace(name="blocks", folder=work.folder / "blocks")
    first = make._asked_repeating(work.folder, work.encoder, street, anew=False, report=print)
    again = make._asked_repeating(work.folder, work.encoder, street, anew=False, report=print)
    assert work.asked == [("in_the_map", "blocks", "blocks", ())]
    assert work.built == [("blocks", False, "blocks", 1.0)]
    np.testing.assert_array_equal(first.evidence, again.evidence)


def test_a_stereo_rig_asks_its_own_cities_and_the_other_of_them(work, monkeypatch):
    monkeypatch.setattr(make, "simulate", lambda *_, **__: None)
    monkeypatch.setattr(make, "Dataset", lambda folder: _dataset(folder.name, folder.parent))
    car = PAIR_RIGS[0]
    found = make._asked_pairs(work.folder, work.encoder, car, anew=False, report=print)
    one, two = "calibration-car-1", "calibration-car-2"
    assert work.asked == [
        ("in_the_map", one, one, (), "car"),
        ("of_another_city", two, one, (), "car"),
        ("in_the_map", two, two, (), "car"),
        ("of_another_city", one, two, (), "car"),
        ("walls_and_rooms", two, 0, "car"),
    ]
    assert len(found) == 50
    assert {name for name, *_ in work.built} == {one, two}


def test_the_last_city_is_asked_of_the_first_ones_maps(work):
    work.all_of(2)
    assert [row[1] for row in work.asked if row[0] == "of_another_city"] == ["one", "one", "one-sparse"]


def test_maps_and_answers_are_kept_and_questions_asked_anew_only_on_demand(work):
    """Each city's sparse map serves the city before it, too."""
    first = work.all_of(1)
    count = len(work.asked)
    again = work.all_of(1)
    assert len(work.asked) == count
    np.testing.assert_array_equal(again.evidence, first.evidence)
    assert again.kind.tolist() == first.kind.tolist()
    work.all_of(1, anew=True)
    assert len(work.asked) == 2 * count
    assert len(work.built) == 5
    work.all_of(2)
    assert [row[2] for row in work.built[5:]] == ["one", "one-sparse", "three-without-streets"]
