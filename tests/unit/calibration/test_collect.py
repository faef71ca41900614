from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from model_training.calibration import collect
from model_training.calibration.collect import (
    calibration_data_of,
    in_the_map,
    of_another_city,
    preset_of,
    walls_and_rooms,
)
from model_training.calibration.rigs import RIGS
from model_training.evaluation.predict import RANKED, Predictions
from model_training.simulation.depth_noise import DEPTHS
from service.confidence.features import FEATURES
from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera


def predictions(errors_m, *, up_m=0.0):
    """Queries that were answered so far to the side; NaN for no answer."""
    count = len(errors_m)
    T_true = np.tile(np.eye(4), (count, 1, 1))
    T_answer = T_true.copy()
    T_answer[:, 0, 3], T_answer[:, 2, 3] = 0.6 * np.array(errors_m), up_m
    T_answer[:, 1, 3] = 0.8 * np.array(errors_m)
    return Predictions(
        T_true,
        T_answer,
        np.zeros(count, int),
        np.zeros(count, int),
        np.zeros((count, RANKED, 2)),
        np.zeros((count, RANKED), int),
        np.full(count, "LOCALIZED"),
        np.full(count, 0.5),
        np.arange(count * len(FEATURES), dtype=float).reshape(count, -1),
        np.zeros((count, 6, 6)),
        np.zeros(count),
        np.zeros(count),
    )


def test_an_answer_within_a_metre_on_the_ground_is_right():
    found = calibration_data_of(predictions([0.0, 0.99, 1.01, 50.0, np.nan], up_m=3.0), "clear_precise", known=True)
    assert found.right.tolist() == [True, True, False, False, False]
    assert found.known.all()
    assert set(found.kind.tolist()) == {"clear_precise"}
    np.testing.assert_array_equal(found.evidence, predictions([0.0] * 5).evidence)


def test_calibration_data_hold_the_error_and_the_heading_of_a_known_query():
    """0.6 of the error is along x, 0.8 along y. The optical axis of an identity pose points up, so its heading is any finite number."""
    found = calibration_data_of(predictions([0.5, np.nan], up_m=3.0), "drive1_sgbm", known=True)
    np.testing.assert_allclose(found.error[0], [0.3, 0.4, 3.0, 0, 0, 0], atol=1e-12)
    assert np.isnan(found.error[1, :2]).all()
    assert np.isfinite(found.heading_rad).all()
    assert found.family.tolist() == ["sgbm", "sgbm"]


def test_outside_the_map_no_answer_is_right():
    found = calibration_data_of(predictions([0.0, 50.0]), "other_city.precise", known=False)
    assert not found.right.any()
    assert not found.known.any()
    assert np.isnan(found.error).all()
    assert np.isnan(found.heading_rad).all()


@pytest.mark.parametrize(
    ("name", "preset"), [("clear_precise", "precise"), ("cars_changed_stereo", "stereo"), ("x", "x")]
)
def test_the_preset_is_the_last_part_of_a_sets_name(name, preset):
    assert preset_of(name) == preset


class City:
    """Query sets by name; one without truth cannot be asked."""

    def query_sets(self, *, with_truth=False):
        return ["clear_precise", "clear_stereo", "rain_precise"] + ["untold_stereo"] * (not with_truth)


#: Depth cameras of walls and rooms.
MODELS = (DEPTHS["precise"], DEPTHS["stereo"])
#: Stand-ins that ``collect`` only passes on.
LOCALIZER: Any = "localizer"
CITY: Any = City()


@pytest.fixture
def predicted(monkeypatch):
    """What was asked of whom, in order; each set is answered by as many right answers as its name has letters."""
    asked = []

    def predict(localizer, dataset, name, *, frames_each, seen_by, report):
        asked.append((localizer, dataset, name, report))
        assert seen_by is None or seen_by == RIGS[0].seen
        assert frames_each == (5 if name.startswith("sequences") else 1)
        return predictions([0.0] * len(name))

    monkeypatch.setattr(collect, "predict", predict)
    return asked


@pytest.mark.parametrize("ask", [in_the_map, of_another_city])
@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ((), ["clear_precise", "clear_stereo", "rain_precise"]),
        (("clear_stereo",), ["clear_stereo"]),
        (["rain_precise", "clear_precise"], ["rain_precise", "clear_precise"]),
        (("sequences_precise",), ["sequences_precise"]),
    ],
)
def test_query_sets_are_asked_as_they_are_named_or_else_all_that_have_truth(predicted, ask, names, expected):
    city, report = City(), print
    found = ask("localizer", city, report, names) if names else ask("localizer", city, report)
    assert predicted == [("localizer", city, name, report) for name in expected]
    assert [len(each) for each in found] == [len(name) for name in expected]


def test_sets_of_the_maps_own_city_keep_their_names_and_those_of_another_only_their_preset(predicted):
    names = ("clear_precise", "rain_stereo")
    own, other = in_the_map(LOCALIZER, CITY, print, names), of_another_city(LOCALIZER, CITY, print, names)
    assert [set(each.kind.tolist()) for each in own] == [{"clear_precise"}, {"rain_stereo"}]
    assert [set(each.kind.tolist()) for each in other] == [{"other_city.precise"}, {"other_city.stereo"}]
    assert all(each.known.all() and each.right.all() for each in own)
    assert not any(each.known.any() or each.right.any() for each in other)


def test_kinds_of_another_rig_are_told_by_its_name(predicted):
    names = ("clear_precise", "clear_stereo")
    own = in_the_map(LOCALIZER, CITY, print, names, rig=RIGS[0])
    other = of_another_city(LOCALIZER, CITY, print, names, rig=RIGS[0])
    assert [set(each.kind.tolist()) for each in own] == [{"narrow_clear_precise"}, {"narrow_clear_stereo"}]
    assert [set(each.kind.tolist()) for each in other] == [{"narrow_other_city.precise"}, {"narrow_other_city.stereo"}]


class Wherever:
    """Registers two pictures of three, refuses every fourth."""

    def __init__(self):
        self.asked = []

    def localize(self, query):
        self.asked.append(query)
        number = len(self.asked) - 1
        if number % 4 == 3:
            raise NoDepthError("nothing", field="depth")
        return SimpleNamespace(evidence=None if number % 4 == 1 else np.full(len(FEATURES), float(number)))


def wherever() -> Any:
    """Return one in the place of a localizer."""
    return Wherever()


def test_walls_and_rooms_are_nowhere_and_told_by_kind_and_preset():
    localizer, told = wherever(), []
    camera = PinholeCamera(32, 24, 16.0, 16.0, 15.5, 11.5)
    found = walls_and_rooms(localizer, camera, 3, lambda *told_of: told.append(told_of), MODELS, count=4)
    assert [set(each.kind.tolist()) for each in found] == [
        {"wall.precise"},
        {"wall.stereo"},
        {"room.precise"},
        {"room.stereo"},
    ]
    assert not any(each.known.any() or each.right.any() for each in found)
    for part, each in enumerate(found):
        rows = each.evidence[:, 0]
        np.testing.assert_array_equal(rows, [4 * part, np.nan, 4 * part + 2, np.nan])
    assert told[3] == ("walls and rooms wall_precise", 4, 4)
    assert len(told) == len(localizer.asked) == 16


def test_another_rig_sees_the_same_walls_and_rooms():
    whole, cut = wherever(), wherever()
    camera = PinholeCamera(32, 24, 16.0, 16.0, 15.5, 11.5)
    walls_and_rooms(whole, camera, 3, lambda *_: None, MODELS, count=2)
    found = walls_and_rooms(cut, camera, 3, lambda *_: None, MODELS, count=2, rig=RIGS[0])
    assert [set(each.kind.tolist()) for each in found] == [
        {"narrow_wall.precise"},
        {"narrow_wall.stereo"},
        {"narrow_room.precise"},
        {"narrow_room.stereo"},
    ]
    for query, seen in zip(whole.asked, cut.asked, strict=True):
        np.testing.assert_array_equal(seen.depth_m, RIGS[0].seen(query).depth_m)


def test_every_city_draws_walls_and_rooms_of_its_own():
    def first(seed):
        localizer = wherever()
        walls_and_rooms(
            localizer, PinholeCamera(32, 24, 16.0, 16.0, 15.5, 11.5), seed, lambda *_: None, MODELS, count=1
        )
        return np.concatenate([query.depth_m for query in localizer.asked])

    np.testing.assert_array_equal(first(1), first(1))
    assert not np.array_equal(first(1), first(2))
