import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.training.batches import PAIR_REACH_M, City, open_cities  # noqa: E402  # after the skip
from model_training.training.packs import Pack  # noqa: E402
from service.errors import DatasetError  # noqa: E402

TURN_DEG = 9.0


@pytest.fixture
def city(pack_folder, grid):
    return City(Pack.open(pack_folder), grid, turn_deg=TURN_DEG)


def draw(city, pairs=24, seed=0):
    return city.draw(pairs, np.random.default_rng(seed))


def test_pairs_lie_within_reach(city):
    for seed in range(5):
        batch = draw(city, seed=seed)
        assert float((batch.survey_xy - batch.query_xy).norm(dim=1).max()) <= PAIR_REACH_M


def test_no_query_is_twice_in_a_batch(city):
    xy = draw(city).query_xy.numpy()
    assert len(np.unique(xy, axis=0)) == len(xy)


def test_a_batch_has_up_to_the_pairs_wanted(city):
    batch = draw(city, pairs=20)
    assert 10 <= len(batch.query_xy) <= 20
    assert batch.images == 2 * len(batch.query_xy)


def test_wanted_pairs_are_in_the_batch(city):
    wanted = np.array([3, 17, 42])
    batch = city.draw(20, np.random.default_rng(0), wanted)
    assert set(wanted) <= set(batch.pairs)
    assert 10 <= len(batch.pairs) <= 20


def test_more_pairs_wanted_than_fit_are_cut(city):
    assert city.draw(6, np.random.default_rng(0), np.arange(30)).pairs.tolist() == list(range(6))


def test_pairs_number_the_queries_drawn(city):
    batch = draw(city)
    np.testing.assert_allclose(batch.query_xy.numpy(), city.pack.queries[batch.pairs, :2], rtol=1e-6)


def test_views_are_rotated_at_most_by_the_requested_angle(city, grid):
    """Each query shows the panorama of its place. The shift of the survey view is its yaw offset."""
    step_deg = 360.0 / grid.around
    for seed in range(2):
        batch = draw(city, pairs=8, seed=seed)
        for place_xy, survey_view, query_view in zip(
            batch.survey_xy, batch.survey_ranges, batch.query_ranges, strict=True
        ):
            places = torch.tensor(np.array(city.pack.places))
            k = int((places[:, :2] - place_xy.double()).norm(dim=1).argmin())
            panorama = np.asarray(city.pack.panoramas[k], np.float32)
            starts = [offset_of(panorama, view.numpy(), grid) for view in (survey_view, query_view)]
            turn = ((starts[0] - starts[1]) * step_deg + 180) % 360 - 180
            assert abs(turn) <= TURN_DEG + step_deg


def offset_of(panorama, view, grid):
    """Return the column of the panorama at which a view begins, by best fit."""
    columns = np.rint((grid.azimuths_rad + np.pi) / (2 * np.pi) * grid.around).astype(int)
    errors = [np.abs(panorama[:, (columns + k) % grid.around] - view).sum() for k in range(grid.around)]
    best = np.flatnonzero(np.isclose(errors, min(errors)))
    return float(best[len(best) // 2])


def test_one_seed_gives_one_batch(city):
    one, other = draw(city, seed=3), draw(city, seed=3)
    torch.testing.assert_close(one.survey_ranges, other.survey_ranges, rtol=0, atol=0)
    torch.testing.assert_close(one.query_xy, other.query_xy, rtol=0, atol=0)


def test_queries_without_a_place_nearby_are_never_drawn(pack_of, grid, tmp_path):
    folder = pack_of(tmp_path / "sparse")
    queries = np.load(folder / "queries.npy")
    queries[:30, :2] += 5000.0
    np.save(folder / "queries.npy", queries)
    city = City(Pack.open(folder), grid, turn_deg=TURN_DEG)
    assert city.usable.tolist() == list(range(30, 60))
    assert float(draw(city, pairs=12).query_xy.max()) < 1000


def test_a_pack_with_too_few_usable_queries_is_refused_before_training(pack_of, tmp_path, grid):
    """Earlier, NumPy raised "Cannot take a larger sample than population"."""
    folder = pack_of(tmp_path / "few", places=20)
    queries = np.load(folder / "queries.npy")
    queries[:5, 0] += 1000.0  # near no place
    np.save(folder / "queries.npy", queries)
    with pytest.raises(
        DatasetError, match=r"15 of its 20 queries lie within 2\.5 m of a place, but a batch needs 16 pairs"
    ) as error:
        open_cities([folder], grid, turn_deg=TURN_DEG, pairs=16)
    assert (error.value.field, "--pairs 15" in error.value.message, str(folder) in error.value.message) == (
        "pairs",
        True,
        True,
    )
    (city,) = open_cities([folder], grid, turn_deg=TURN_DEG, pairs=15)
    assert len(city.draw(15, np.random.default_rng(0)).pairs) == 15


@pytest.mark.parametrize("damage", ["gone", "empty", "cut off"])
def test_a_damaged_pack_is_named_with_the_remedy(pack_of, tmp_path, grid, damage):
    folder = pack_of(tmp_path / "pack", places=20)
    path = folder / "ranges.npy"
    content = path.read_bytes()
    path.unlink() if damage == "gone" else path.write_bytes(b"" if damage == "empty" else content[: len(content) // 2])
    with pytest.raises(DatasetError, match=r"ranges\.npy: the file is (missing|damaged)"):
        open_cities([folder], grid, turn_deg=TURN_DEG, pairs=4)


def test_a_survey_view_has_the_columns_of_its_panorama(city, grid):
    """Column c of a view shows the direction heading + azimuth of column c: its number in the panorama is counted here one by one."""
    choice = city.choose(6, np.random.default_rng(1))
    batch = city.read(choice)
    for k in range(len(choice)):
        towards = choice.queries[k, 2] + choice.turn_rad[k] - choice.places[k, 2] + grid.azimuths_rad
        columns = [round((float(angle) + np.pi) / (2 * np.pi) * grid.around) % grid.around for angle in towards]
        panorama = np.asarray(city.pack.panoramas[choice.place[k]], np.float32)
        np.testing.assert_array_equal(batch.survey_ranges[k].numpy(), panorama[:, columns])
        np.testing.assert_array_equal(
            batch.query_ranges[k].numpy(), city.pack.ranges[choice.pairs[k]].astype(np.float32)
        )


def test_a_device_without_enough_memory_is_named_with_the_remedy(pack_folder, grid, monkeypatch):
    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("model_training.training.batches.City", full)
    with pytest.raises(DatasetError, match=r"the memory of cuda is full after 0 of 1 cities.*--cities") as error:
        open_cities([pack_folder], grid, turn_deg=TURN_DEG, pairs=16, device=torch.device("cuda"))
    assert error.value.field == "device"
