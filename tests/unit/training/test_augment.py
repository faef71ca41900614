import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.augment import Augmentation, Augmenter, brightness, least_of_nine  # noqa: E402  # after the skip
from service.imaging.fusion import ihs_linear  # noqa: E402
from service.imaging.view_grid import PLANES, ViewGrid, heights_of  # noqa: E402
from service.imaging.view_grid import brightness as of_one_view  # noqa: E402

GRID = ViewGrid()
COUNT = 300
#: Everything off.
NOTHING = Augmentation(
    disparity_noise_px=(1e-6, 1e-6),
    scale_error=0,
    monocular=0,
    invented_depth=0,
    short_range=0,
    no_colour=0,
    narrow_rows=0,
    narrow_columns=0,
    blocked=0,
    small_blocks=0,
    unseen_top_rows=0,
    survey_noise_m=0,
    survey_dropout=0,
    height_error_m=0,
    no_intensity=0,
    intensity_gain=0,
    no_brightness=0,
    shading=0,
    matched_noise_px=0,
    matched_offset_px=0,
    matched_scale_error=0,
    matched_holes=(99.0, 99.0),
)


def augmenter(*, seed=0, **changed):
    settings = Augmentation.model_validate(NOTHING.model_dump() | changed)
    return Augmenter(settings, GRID, torch.Generator().manual_seed(seed), torch.device("cpu"))


def clean(count=COUNT, range_m=15.0):
    generator = torch.Generator().manual_seed(9)
    ranges = torch.full((count, GRID.rows, GRID.columns), range_m)
    rgb = torch.rand(count, 3, GRID.rows, GRID.columns, generator=generator) * 255
    return ranges, rgb, torch.full((count,), 1.5), torch.ones(1, GRID.rows, 1, dtype=torch.bool)


def query(augment, **options):
    return augment.query(*clean(**options))


def survey(augment, ranges, height, seen, intensity=None):
    return augment.survey(ranges, torch.full_like(ranges, 0.4) if intensity is None else intensity, height, seen)


def plane(planes, name):
    return planes[:, PLANES.index(name)]


def test_planes_of_both_sides_have_the_shape_of_a_view():
    ranges, rgb, height, seen = clean(count=3)
    augment = Augmenter(Augmentation(), GRID, torch.Generator().manual_seed(0), torch.device("cpu"))
    assert survey(augment, ranges, height, seen).shape == (3, 6, 32, 128)
    assert augment.query(ranges, rgb, height, seen).shape == (3, 6, 32, 128)


def test_one_generator_gives_one_batch():
    ranges, rgb, height, seen = clean(count=4)
    one, other = (
        Augmenter(Augmentation(), GRID, torch.Generator().manual_seed(5), torch.device("cpu")).query(
            ranges, rgb, height, seen
        )
        for _ in range(2)
    )
    torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_another_generator_gives_another_batch():
    ranges, rgb, height, seen = clean(count=4)
    one, other = (
        Augmenter(Augmentation(), GRID, torch.Generator().manual_seed(s), torch.device("cpu")).query(
            ranges, rgb, height, seen
        )
        for s in (5, 6)
    )
    assert float((one - other).abs().max()) > 0.1


def test_heights_and_colours_are_those_of_the_service(monkeypatch):
    monkeypatch.setattr(Augmenter, "_normal", lambda _, *shape: torch.zeros(shape))
    ranges, rgb, height, seen = clean(count=4)
    ranges[:, ::3] = 0.0
    planes = augmenter().query(ranges, rgb, height, seen).numpy()
    of_service = heights_of(planes[:, 0], 1.5, GRID)
    np.testing.assert_allclose(planes[:, PLANES.index("height_m")], of_service, atol=1e-4)
    _, v1, v2 = ihs_linear(np.moveaxis(rgb.numpy(), 1, -1))
    np.testing.assert_allclose(planes[:, PLANES.index("v1")], v1, atol=1e-3)
    np.testing.assert_allclose(planes[:, PLANES.index("v2")], v2, atol=1e-3)


def test_the_given_views_are_left_as_they_are():
    ranges, rgb, height, seen = clean(count=4)
    before = ranges.clone(), rgb.clone()
    Augmenter(Augmentation(), GRID, torch.Generator(), torch.device("cpu")).query(ranges, rgb, height, seen)
    torch.testing.assert_close((ranges, rgb), before, rtol=0, atol=0)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_the_stated_share_of_views_has_no_colour(share):
    found = query(augmenter(no_colour=share))
    grey = (plane(found, "v1") == 0).flatten(1).all(dim=1) & (plane(found, "v2") == 0).flatten(1).all(dim=1)
    assert float(grey.float().mean()) == pytest.approx(share, abs=0.08)


@pytest.mark.parametrize("share", [0.0, 0.35, 1.0])
def test_the_stated_share_of_views_is_blocked(share):
    ranges = plane(query(augmenter(blocked=share)), "range_m")
    blocked = ((ranges > 0) & (ranges < 12)).flatten(1).any(dim=1)
    assert float(blocked.float().mean()) == pytest.approx(share, abs=0.1)


def test_blocks_are_no_wider_than_stated():
    ranges = plane(query(augmenter(blocked=1.0, widest_block=0.45)), "range_m")
    columns = ((ranges > 0) & (ranges < 12)).any(dim=1).float().mean(dim=1)
    assert float(columns.max()) < 0.45 + 0.05


def test_narrow_cameras_lose_columns_at_both_sides_only():
    observed = plane(query(augmenter(narrow_columns=1.0)), "observed")
    assert bool(observed[:, :, 40:88].all())
    assert not bool(observed[:, :, 0].all())


def test_unobserved_cells_are_blank_in_every_plane():
    found = query(augmenter(narrow_columns=1.0, narrow_rows=1.0))
    outside = plane(found, "observed") == 0
    assert float(found.abs().sum(dim=1)[outside].max()) == 0.0


def test_short_ranges_are_cut():
    far = plane(query(augmenter(short_range=1.0), range_m=30.0), "range_m")
    assert bool((far == 0).flatten(1).all(dim=1).any())


def test_a_survey_view_without_errors_keeps_its_ranges_and_heights():
    ranges, _, height, seen = clean(count=2)
    found = survey(augmenter(), ranges, height, seen)
    torch.testing.assert_close(plane(found, "range_m"), ranges)
    sine = torch.sin(torch.tensor(GRID.elevations_rad, dtype=torch.float32))[:, None]
    torch.testing.assert_close(plane(found, "height_m"), (ranges * sine + 1.5))
    assert not bool(plane(found, "v1").any())


def test_rows_that_the_survey_does_not_see_are_blank_on_both_sides():
    ranges, rgb, height, _ = clean(count=2)
    seen = (torch.arange(GRID.rows) >= 10).reshape(1, -1, 1)
    augment = augmenter()
    for found in (survey(augment, ranges, height, seen), augment.query(ranges, rgb, height, seen)):
        assert not bool(found[:, :, :10].any())


def test_top_rows_are_cut_in_the_stated_share_of_views():
    rows = augmenter(unseen_top_rows=0.5).cut_rows(torch.ones(GRID.rows, dtype=torch.bool), COUNT)
    cut = ~rows[:, 0, 0]
    assert float(cut.float().mean()) == pytest.approx(0.5, abs=0.1)
    assert bool(rows[:, 17:].all())


def uneven(count=4):
    generator = torch.Generator().manual_seed(3)
    return torch.rand(count, GRID.rows, GRID.columns, generator=generator)


def test_brightness_is_what_the_service_makes_of_the_same_view():
    values, measured = uneven(), uneven() > 0.4
    seen = measured | (values > 0.9)
    values[1] = 0.7  # flat
    measured[2] = False
    batch = brightness(values, measured=measured, seen=seen).numpy()
    for k, found in enumerate(batch):
        one = of_one_view(values[k].numpy(), measured=measured[k].numpy(), seen=seen[k].numpy())
        np.testing.assert_allclose(found, one, atol=1e-4)
    assert batch[0].any()
    assert not batch[1:3].any()


def test_brightness_is_missing_in_the_stated_share_of_views():
    ranges, rgb, height, seen = clean()
    lost = ~plane(augmenter(no_brightness=0.3).query(ranges, rgb, height, seen), "brightness").flatten(1).any(dim=1)
    assert float(lost.float().mean()) == pytest.approx(0.3, abs=0.1)
    found = survey(augmenter(no_intensity=0.3), ranges, height, seen, uneven(COUNT))
    assert float((~plane(found, "brightness").flatten(1).any(dim=1)).float().mean()) == pytest.approx(0.3, abs=0.1)


def test_a_vehicle_in_the_way_covers_the_brightness_of_what_is_behind_it():
    ranges, rgb, height, seen = clean(count=40)
    free = plane(augmenter().query(ranges, rgb, height, seen), "brightness")
    planes = augmenter(blocked=1, widest_block=0.5).query(ranges, rgb, height, seen)
    hidden = plane(planes, "range_m") < 14.0
    assert bool(hidden.any())
    inside = plane(planes, "brightness")[hidden]
    alike = torch.corrcoef(torch.stack([inside, free[hidden]]))[0, 1]
    assert abs(float(alike)) < 0.3  # depth bleeds over the edge, brightness does not


def test_the_least_of_nine_is_what_a_pooling_gives():
    values = torch.rand(3, 32, 128, generator=torch.Generator().manual_seed(4))
    pooled = -torch.nn.functional.max_pool2d(-values[:, None], 3, 1, 1)[:, 0]
    torch.testing.assert_close(least_of_nine(values), pooled, rtol=0, atol=0)


def test_stereo_matched_depth_gets_no_modelled_errors():
    noisy = {"disparity_noise_px": (0.5, 0.5), "scale_error": 0.05, "invented_depth": 1.0}
    ranges, rgb, height, rows = clean()
    seen = torch.ones_like(ranges, dtype=torch.bool)
    planes = augmenter(**noisy).query(ranges, rgb, height, rows, seen=seen)
    torch.testing.assert_close(plane(planes, "range_m"), ranges, rtol=1e-6, atol=0)
    drawn = plane(augmenter(**noisy).query(ranges, rgb, height, rows), "range_m")
    assert ((drawn - ranges).abs() > 0.1).any()


def matched_ranges(range_m=10.0, **changed):
    """Range of one cell of each view, next to the optical axis, where z and range are nearly the same."""
    ranges, rgb, height, rows = clean(range_m=range_m)
    seen = torch.ones_like(ranges, dtype=torch.bool)
    return plane(augmenter(**changed).query(ranges, rgb, height, rows, seen=seen), "range_m")[:, 16, 64]


def test_an_offset_of_matched_depth_shifts_the_disparity_of_a_whole_view():
    """At 10 m the disparity is 8 px, so 0.4 px (two of three views within one standard deviation) is 0.5 m."""
    shifted = (80 / matched_ranges(matched_offset_px=0.4, matched_unchanged=0.0)) - 8
    assert float(shifted.std()) == pytest.approx(0.4, rel=0.15)
    same = matched_ranges(matched_offset_px=0.4, matched_unchanged=1.0)
    torch.testing.assert_close(same, torch.full_like(same, 10.0), rtol=1e-5, atol=0)


def test_the_noise_of_matched_depth_stays_below_its_greatest_size():
    errors = (80 / matched_ranges(matched_noise_px=0.3, matched_unchanged=0.0)) - 8
    assert 0.02 < float(errors.std()) < 0.3


def test_holes_of_matched_depth_are_where_a_smooth_field_exceeds_the_threshold():
    lost = matched_ranges(matched_holes=(0.0, 0.0)) == 0
    assert float(lost.float().mean()) == pytest.approx(0.5, abs=0.1)
    assert not (matched_ranges(matched_holes=(99.0, 99.0)) == 0).any()


def test_a_scale_error_of_matched_depth_is_relative():
    far, near = (matched_ranges(range_m, matched_scale_error=0.02) / range_m for range_m in (20.0, 5.0))
    assert float(far.std()) == pytest.approx(0.02, rel=0.15)
    assert float(near.std()) == pytest.approx(0.02, rel=0.15)


def test_cells_outside_the_field_of_view_are_not_observed():
    ranges, rgb, height, rows = clean()
    seen = torch.ones_like(ranges, dtype=torch.bool)
    seen[:, :, :40] = False
    planes = augmenter().query(ranges, rgb, height, rows, seen=seen)
    for name in ("range_m", "observed", "brightness"):
        assert not plane(planes, name)[:, :, :40].any(), name
    assert plane(planes, "observed")[:, :, 40:].all()


@pytest.mark.parametrize(("monocular", "largest"), [(0.0, 0.02), (1.0, 0.12)])
def test_a_view_of_monocular_depth_has_the_larger_scale_error(monocular, largest):
    """Each view has one scale, uniform between minus and plus the largest error. The median over holes and noise shows it."""
    augment = augmenter(scale_error=0.02, monocular=monocular, monocular_scale_error=0.12)
    ranges = plane(query(augment), "range_m")
    scales = torch.stack([view[view > 0].median() / 15.0 - 1 for view in ranges])
    assert scales.abs().max() == pytest.approx(largest, rel=0.1)
    assert scales.std() == pytest.approx(largest / 3**0.5, rel=0.15)
