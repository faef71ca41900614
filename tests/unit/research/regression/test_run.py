import json
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from research.baselines.paper_data.pairs import make_pairs
from research.baselines.regression import locate as stages
from research.baselines.regression import run as module
from research.baselines.regression.locate import STAGES, locate
from research.baselines.regression.refine import Refined
from research.baselines.regression.train_lk import LkSettings, train_lk
from research.baselines.regression.train_pose import PoseSettings, train_pose

POSE = PoseSettings(side=32, batch=2, point_every=10_000)
LK = LkSettings(batch=2, points=64, iterations=2, point_every=10_000, watched=2)


@pytest.fixture(scope="module")
def asked(small_dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("regression")
    pairs = make_pairs(small_dataset, ["drive1_precise"], folder / "pairs")
    calls, budgets = [], {}

    def noted(train):
        def trained(*arguments, budget_s, **named):
            budgets[train.__name__] = budget_s
            return train(*arguments, budget_s=budget_s, **named)

        return trained

    with pytest.MonkeyPatch.context() as patch:
        for train in (train_pose, train_lk):
            patch.setattr(module, train.__name__, noted(train))
        result = module.run(
            pairs,
            small_dataset.folder,
            {"small": pairs},
            folder / "work",
            budget_s=2.0,
            report=lambda *each: calls.append(each),
            pose=POSE,
            lk=LK,
        )
    return pairs, result, calls, budgets


def test_every_stage_answers_a_place_and_a_street_for_every_pair(asked):
    pairs, result, *_ = asked
    assert tuple(result.answers["small"]) == STAGES
    for answers in result.answers["small"].values():
        assert answers.places.xy.shape == (len(pairs), 2)
        assert (answers.places.street == 0).all()
        np.testing.assert_array_equal(answers.places.xy, answers.T_map_camera[:, :2, 3])


def test_a_stage_that_did_not_register_repeats_the_one_before_it(asked):
    answers = asked[1].answers["small"]
    for before, after in pairwise(STAGES):
        kept = ~answers[after].registered
        np.testing.assert_array_equal(answers[after].T_map_camera[kept], answers[before].T_map_camera[kept])


def test_the_budget_is_shared_three_to_one(asked):
    result, budgets = asked[1], asked[3]
    assert budgets == {"train_pose": 1.5, "train_lk": 0.5}
    assert result.processor_s == sum(cost.processor_s for cost in result.trainings.values())


def test_costs_say_what_was_shown_and_where_the_curves_lie(asked):
    for cost in asked[1].trainings.values():
        last = json.loads(cost.curve.read_text().splitlines()[-1])
        assert (last["images"], cost.ended) == (cost.images, "budget")


def test_progress_is_reported_stage_by_stage(asked):
    names = [stage for stage, _, _ in asked[2]]
    assert list(dict.fromkeys(names)) == ["map cloud", "GoogLeNet", "PointNetLK", "refinement"]


def test_icp_goes_on_from_what_pointnet_lk_found(asked, monkeypatch):
    pairs, guessed = asked[0], np.tile(np.eye(4), (5, 1, 1))

    class Guesses:
        def poses(self, _pairs):
            return guessed

    def shifted(by):
        def refine(*arguments):
            T = next(each for each in arguments if isinstance(each, np.ndarray) and each.shape == (4, 4)).copy()
            T[0, 3] += by
            return Refined(T, registered=True)

        return refine

    monkeypatch.setattr(stages, "by_pointnet_lk", shifted(10.0))
    monkeypatch.setattr(stages, "by_icp", shifted(1.0))
    monkeypatch.setattr(stages, "nearest_streets", lambda _streets, xy: np.zeros(len(xy), np.int64))
    guesses: Any = Guesses()
    unused: Any = None
    found = locate(stages.Method(guesses, unused, unused, unused), pairs)
    np.testing.assert_array_equal(found.xy, np.tile([11.0, 0.0], (5, 1)))
