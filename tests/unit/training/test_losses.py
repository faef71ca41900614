import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.losses import paired_info_nce  # noqa: E402  # after the skip


def pairs(count=7, seed=0, spread_m=100.0):
    rng = np.random.default_rng(seed)
    descriptors = rng.normal(size=(2, count, 5))
    descriptors /= np.linalg.norm(descriptors, axis=2, keepdims=True)
    positions = rng.uniform(0, spread_m, (count, 2))
    return descriptors[0], descriptors[1], positions, positions + rng.uniform(-1, 1, (count, 2))


def slow_loss(queries, surveys, positions_q, positions_s, scale, same_place_m=6.0):
    """Pair by pair: minus the log of the own one's share, both ways, those too near left out."""
    losses = []
    for k in range(len(queries)):
        both = 0.0
        for turned in (False, True):
            terms = []
            for j in range(len(queries)):
                q, s = (j, k) if turned else (k, j)
                if j == k or np.linalg.norm(positions_q[q] - positions_s[s]) >= same_place_m:
                    terms.append(np.exp(scale * queries[q] @ surveys[s]))
            both -= 0.5 * np.log(np.exp(scale * queries[k] @ surveys[k]) / sum(terms))
        losses.append(both)
    return losses


def loss_of(queries, surveys, positions_q, positions_s, scale=10.0):
    tensors = [torch.tensor(x, dtype=torch.float64) for x in (queries, surveys, positions_q, positions_s)]
    losses, first = paired_info_nce(*tensors, scale=torch.tensor(scale, dtype=torch.float64))
    return losses.numpy(), first.numpy()


@pytest.mark.parametrize("spread_m", [10.0, 30.0, 300.0])
def test_the_loss_is_that_of_a_slow_loop(spread_m):
    given = pairs(spread_m=spread_m)
    np.testing.assert_allclose(loss_of(*given)[0], slow_loss(*given, 10.0), rtol=1e-9)


def test_places_too_near_to_be_told_apart_do_not_repel():
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
