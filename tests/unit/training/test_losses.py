import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.losses import Side, hardest_triplet, paired_info_nce  # noqa: E402  # after the skip


def pairs(count=7, seed=0, spread_m=100.0):
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(2, count, 5))
    descriptors /= np.linalg.norm(descriptors, axis=2, keepdims=True)
    positions = rng.uniform(0, spread_m, (count, 2))
    return descriptors[0], descriptors[1], positions, positions + rng.uniform(-1, 1, (count, 2))


def slow_loss(queries, surveys, positions_q, positions_s, *, scale, more=(), same_place_m=6.0):
    """Compute pair by pair: minus the log of the share of the own pair, both directions, without pairs that are too near."""
    losses = []
    for k in range(len(queries)):
        both = 0.0
        for own, asked_at, answers, places in (
            (queries, positions_q, surveys, positions_s),
            (surveys, positions_s, queries, positions_q),
        ):
            terms = [np.exp(scale * own[k] @ answers[k])]
            others = [(d, at) for j, (d, at) in enumerate(zip(answers, places, strict=True)) if j != k]
            if more:
                others += list(zip(*(more[0] if answers is queries else more[1]), strict=True))
            terms += [
                np.exp(scale * own[k] @ d) for d, at in others if np.linalg.norm(asked_at[k] - at) >= same_place_m
            ]
            both -= 0.5 * np.log(terms[0] / sum(terms))
        losses.append(both)
    return losses


def side(descriptors, positions):
    return Side(torch.tensor(descriptors, dtype=torch.float64), torch.tensor(positions, dtype=torch.float64))


def loss_of(queries, surveys, positions_q, positions_s, *, scale=10.0, more=()):
    given = dict(zip(("more_queries", "more_surveys"), (side(*m) for m in more), strict=False))
    losses, first = paired_info_nce(
        side(queries, positions_q), side(surveys, positions_s), scale=torch.tensor(scale, dtype=torch.float64), **given
    )
    return losses.numpy(), first.numpy()


@pytest.mark.parametrize("spread_m", [10.0, 30.0, 300.0])
def test_the_loss_is_that_of_a_slow_loop(spread_m):
    given = pairs(spread_m=spread_m)
    np.testing.assert_allclose(loss_of(*given)[0], slow_loss(*given, scale=10.0), rtol=1e-9)


def test_earlier_descriptors_are_negatives_unless_they_are_near():
    given, others = pairs(spread_m=20.0), pairs(count=11, seed=1, spread_m=20.0)
    more = ((others[0], others[2]), (others[1], others[3]))
    found = loss_of(*given, more=more)[0]
    np.testing.assert_allclose(found, slow_loss(*given, scale=10.0, more=more), rtol=1e-9)
    assert (found > loss_of(*given)[0]).all()


def test_an_earlier_hard_negative_ranks_before_the_own_view():
    far = np.array([[0.0, 0.0], [50.0, 0.0]])
    q, s = np.eye(2), np.array([[0.8, 0.6], [0.6, 0.8]])
    alike = (np.array([[1.0, 0.0]]), np.array([[200.0, 0.0]]))
    assert loss_of(q, s, far, far, more=(alike, alike))[1].tolist() == [False, True]


def test_places_too_near_to_be_distinct_are_no_negatives():
    q, s, pq, ps = pairs(count=2)
    pq[:], ps[:] = [[0, 0], [3, 0]], [[0, 0], [3, 0]]
    np.testing.assert_allclose(loss_of(q, s, pq, ps)[0], 0.0, atol=1e-9)


def test_near_pairs_are_not_first_in_anothers_stead():
    q = np.array([[1.0, 0.0], [0.0, 1.0]])
    crossed = q[::-1].copy()
    near, far = np.array([[0.0, 0.0], [3.0, 0.0]]), np.array([[0.0, 0.0], [30.0, 0.0]])
    assert loss_of(q, crossed, near, near)[1].tolist() == [True, True]
    assert loss_of(q, crossed, far, far)[1].tolist() == [False, False]


def test_losses_are_per_pair():
    assert loss_of(*pairs())[0].shape == (7,)


def test_perfect_descriptors_have_almost_no_loss():
    far = np.arange(8.0)[:, None] * [50.0, 0.0]
    losses, first = loss_of(np.eye(8), np.eye(8), far, far, scale=60.0)
    assert losses.max() < 1e-9
    assert first.all()


@pytest.mark.parametrize("spread_m", [30.0, 300.0])
def test_the_triplet_loss_is_that_of_the_hardest_rival_that_is_far_enough(spread_m):
    queries, surveys, at_q, at_s = given = pairs(spread_m=spread_m)
    found, first = (
        each.numpy()
        for each in hardest_triplet(
            side(queries, at_q), side(surveys, at_s), scale=torch.tensor(10.0, dtype=torch.float64)
        )
    )
    for k in range(len(queries)):
        ways = []
        for own, at, answers, places in ((queries[k], at_q[k], surveys, at_s), (surveys[k], at_s[k], queries, at_q)):
            rivals = [
                own @ answer
                for j, (answer, place) in enumerate(zip(answers, places, strict=True))
                if j != k and np.linalg.norm(at - place) >= 6.0
            ]
            ways.append(np.log1p(np.exp(10.0 * (max(rivals) - own @ answers[k]))))
        assert found[k] == pytest.approx(np.mean(ways))
    np.testing.assert_array_equal(first, loss_of(*given)[1])
