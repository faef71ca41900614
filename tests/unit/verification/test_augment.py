import pytest

torch = pytest.importorskip("torch")

from model_training.verification.augment import augmented  # noqa: E402
from service.scoring.comparison import COLUMNS, PLANES, ROWS  # noqa: E402

OF_QUERY = [PLANES.index(n) for n in ("measured", "inverse_depth", "difference_sigmas", "difference_ratio", "height")]
OF_MAP = [PLANES.index(n) for n in ("mapped", "mapped_inverse_depth", "mapped_height", "relative_noise")]


def batch(count=200):
    """Return equal comparisons whose planes are 0.5 in the left half and 1 in the right half."""
    planes = torch.full((count, len(PLANES), ROWS, COLUMNS), 0.5)
    planes[..., COLUMNS // 2 :] = 1.0
    return planes


def test_the_same_seed_gives_the_same_errors():
    one, same, other = (augmented(batch(8), torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)


def test_about_half_are_mirrored():
    found = augmented(batch(), torch.Generator().manual_seed(0))[:, PLANES.index("mapped")]
    mirrored = found[:, :, : COLUMNS // 2].amax((1, 2)) == 1.0
    assert 0.4 < mirrored.float().mean() < 0.6


def test_the_map_loses_only_whole_columns():
    found = augmented(batch(), torch.Generator().manual_seed(0))
    empty = found == 0
    for plane in OF_MAP:
        assert torch.equal(empty[:, plane].all(1), empty[:, plane].any(1))
    cut = empty[:, PLANES.index("mapped")].any((1, 2))
    assert 0.25 < cut.float().mean() < 0.5


def test_lost_depth_is_lost_in_all_planes_of_the_query():
    found = augmented(batch(), torch.Generator().manual_seed(0))
    empty = found[:, OF_QUERY] == 0
    assert torch.equal(empty.all(1), empty.any(1))
    assert empty.float().mean() > (found[:, OF_MAP] == 0).float().mean() + 0.02


def test_far_depth_is_lost_first():
    """The left half is at 8 m, the right half at 4 m."""
    found = augmented(batch(400), torch.Generator().manual_seed(0))
    near, far = (found[:, PLANES.index("inverse_depth")] == value for value in (1.0, 0.5))
    assert far.float().mean() < near.float().mean()


def test_brightness_may_be_missing_on_either_side():
    found = augmented(batch(), torch.Generator().manual_seed(0))
    for name, share in (("brightness", 0.1), ("mapped_brightness", 0.2)):
        missing = (found[:, PLANES.index(name)] == 0).all(2).all(1)
        assert missing.float().mean() == pytest.approx(share, abs=0.07)
