import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model_training.mapping.cloud import prepared
from model_training.mapping.passes import Targets
from model_training.mapping.voxel_map import SPAN, VOXEL, VoxelMap, lattice_origin
from service.errors import DatasetError


def map_of(*clouds, voxel_m=0.5, origin=(100.0, -50.0, 2.0)):
    voxels = VoxelMap(voxel_m, np.array(origin))
    for cloud in clouds:
        voxels.add(np.asarray(cloud, np.float64))
    return voxels


def surfels_of(voxels, *, fewest=5):
    """Return the surfels of a map in the order of its voxels. Brightness is that of ``surfels``."""
    found = voxels.surfaces(fewest=fewest)
    rows, (keys, moments) = found.rows, voxels.sums()
    with np.errstate(invalid="ignore"):
        brightness = moments[rows, 10] / moments[rows, 11]
    return SimpleNamespace(
        positions=voxels.means_of(rows),
        normals=found.normals[rows],
        thickness_m=found.thickness_m[rows],
        points=moments[rows, 0],
        keys=keys[rows],
        brightness=brightness,
    )


def slow_surfels(points, *, voxel_m=0.5, origin=(100.0, -50.0, 2.0), fewest=5):
    """Compute voxel by voxel: the mean of its points, and normal and thickness from the 26 neighbours, weighted by position."""
    cells = np.floor((points - np.array(origin)) / voxel_m).astype(int)
    rows = []
    for cell in np.unique(cells, axis=0):
        own = points[(cells == cell).all(axis=1)]
        around = points[(np.abs(cells - cell) <= 1).all(axis=1)]
        if len(around) >= fewest:
            axes_away = np.abs(cells[(np.abs(cells - cell) <= 1).all(axis=1)] - cell).sum(axis=1)
            weights = np.array([1.0, 0.3, 0.1, 0.03])[axes_away]
            variances, axes = np.linalg.eigh(np.cov(around, rowvar=False, ddof=0, aweights=weights))
            rows.append((own.mean(axis=0), axes[:, 0], np.sqrt(max(variances[0], 0)), len(own)))
    return rows


@pytest.fixture(scope="module")
def cloud():
    rng = np.random.default_rng(0)
    wall = np.stack([rng.uniform(98, 104, 900), np.full(900, -48.0), rng.uniform(0, 3, 900)], axis=1)
    return np.concatenate([wall + rng.normal(0, 0.03, wall.shape), rng.uniform([97, -52, 0], [104, -46, 4], (60, 3))])


def test_surfels_are_those_of_a_slow_loop(cloud):
    found, expected = surfels_of(map_of(cloud)), slow_surfels(cloud)
    assert len(found.positions) == len(expected)
    order = np.lexsort(np.array([row[0] for row in expected]).T)
    mine = np.lexsort(found.positions.T)
    for k, (position, normal, thickness, count) in zip(mine, (expected[j] for j in order), strict=True):
        np.testing.assert_allclose(found.positions[k], position, atol=1e-7)
        assert abs(found.normals[k] @ normal) == pytest.approx(1.0, abs=1e-4)
        assert found.thickness_m[k] == pytest.approx(thickness, abs=1e-5)
        assert found.points[k] == count


def test_scan_by_scan_gives_the_same_as_all_at_once(cloud):
    one, parts = surfels_of(map_of(cloud)), surfels_of(map_of(*np.array_split(cloud, 150)))
    np.testing.assert_allclose(parts.positions, one.positions, atol=1e-6)
    np.testing.assert_allclose(parts.thickness_m, one.thickness_m, atol=1e-5)
    np.testing.assert_array_equal(parts.points, one.points)


def test_the_normal_of_a_plane_is_square_to_it():
    rng = np.random.default_rng(1)
    normal = np.array([1.0, 2.0, 2.0]) / 3
    flat = rng.uniform(-2, 2, (6000, 3))
    flat -= np.outer(flat @ normal, normal)
    found = surfels_of(map_of(flat + [100, -50, 2]), fewest=30)
    assert np.abs(found.normals @ normal).min() > 0.999
    assert found.thickness_m.max() < 1e-3


def test_a_corner_is_not_rounded_off():
    """Two walls intersect. Normals are right up to a voxel from the edge. With full weights of neighbours they would not be."""
    rng = np.random.default_rng(4)
    u, v = rng.uniform(0, 3, (2, 30000))
    walls = np.concatenate([np.stack([u, 0 * u, v], axis=1)[:15000], np.stack([0 * u, u, v], axis=1)[15000:]])
    found = surfels_of(map_of(walls + [100.1, -49.9, 2.0]), fewest=30)
    inside = (found.positions[:, 2] > 2.6) & (found.positions[:, 2] < 4.4)
    away = np.min(np.abs(found.positions[:, :2] - [100.1, -49.9]).max(axis=1)[:, None], axis=1)
    turned = 1 - np.max(np.abs(found.normals[:, :2]), axis=1)
    assert turned[inside & (away > 0.5)].max() < 0.05


def test_thickness_is_the_deviation_across_the_plane():
    rng = np.random.default_rng(2)
    slab = np.stack(
        [rng.uniform(98, 102, 40000), rng.uniform(-52, -48, 40000), 2.2 + rng.normal(0, 0.05, 40000)], axis=1
    )
    found = surfels_of(map_of(slab), fewest=500)
    assert np.median(found.thickness_m) == pytest.approx(0.05, rel=0.1)


def test_lonely_points_make_no_surfel():
    assert len(surfels_of(map_of([[101.0, -49.0, 3.0]] * 4)).positions) == 0


def test_surfels_computed_in_parts_are_the_same(monkeypatch):
    """Parts of 1,000 voxels."""
    monkeypatch.setattr("model_training.mapping.voxel_map._PART", 1000)
    rng = np.random.default_rng(8)
    points = rng.uniform([0, 0, 0], [70, 70, 1], (60000, 3))
    voxels = lit(points, points[:, 2], origin=(0.0, 0.0, 0.0))
    plain, (surfels, brightness) = surfels_of(voxels), voxels.surfels()
    assert len(surfels) > 5000
    np.testing.assert_array_equal(surfels["xyz"], plain.positions.astype(np.float32))
    np.testing.assert_array_equal(surfels["normal"], plain.normals)
    np.testing.assert_array_equal(surfels["thickness_m"], plain.thickness_m)
    np.testing.assert_array_equal(surfels["points"], plain.points)
    np.testing.assert_array_equal(brightness, plain.brightness)


def test_coordinates_far_from_zero_lose_nothing():
    far = np.array([412_345.0, 5_654_321.0, 250.0])
    rng = np.random.default_rng(4)
    cloud = rng.uniform(-2, 2, (500, 3))
    near_found = surfels_of(map_of(cloud, origin=(0, 0, 0)))
    far_found = surfels_of(map_of(cloud + far, origin=far))
    np.testing.assert_allclose(far_found.positions - far, near_found.positions, atol=1e-6)


def test_the_lattice_goes_through_the_frames_zero():
    np.testing.assert_allclose(lattice_origin(0.3, np.array([1.0, -0.2, 100.0])), [0.9, -0.3, 99.9])


def test_sums_of_two_maps_with_other_origins_are_those_of_one(cloud):
    """In single precision."""
    near = [lattice_origin(0.5, np.array(point)) for point in ((98.0, -50.0, 1.0), (140.3, -20.0, 5.0))]
    one, other, whole = (
        map_of(c, origin=o) for c, o in ((cloud[:500], near[0]), (cloud[500:], near[1]), (cloud, near[0]))
    )
    one.add_statistics(other.statistics())
    found, expected = surfels_of(one), surfels_of(whole)
    np.testing.assert_array_equal(found.points, expected.points)
    np.testing.assert_allclose(found.positions, expected.positions, atol=1e-6)
    np.testing.assert_allclose(found.thickness_m, expected.thickness_m, atol=1e-4)


def test_statistics_by_hand():
    """Two points in the voxel from (1, -0.5, 0), 0.5 m wide. Its centre is (1.25, -0.25, 0.25)."""
    found = map_of([[1.25, -0.25, 0.25], [1.35, -0.25, 0.05]], origin=(0.0, 0.0, 0.0)).statistics()
    assert found.dtype == VOXEL
    assert found["cell"].tolist() == [[2, -1, 0]]
    assert found["points"].tolist() == [2]
    np.testing.assert_allclose(found["sums"], [[0.1, 0, -0.2, 0.01, 0, -0.02, 0, 0, 0.04]], atol=1e-7)


def lit(points, intensity, **rest):
    voxels = map_of(**rest)
    voxels.add(np.asarray(points, np.float64), np.asarray(intensity, np.float32))
    return voxels


def test_brightness_is_the_mean_over_the_returns_of_a_voxel():
    """The left voxel has four returns, the right one has one. The neighbour's returns do not count."""
    points = [[0.1, 0.1, 0.1], [0.2, 0.3, 0.1], [0.3, 0.1, 0.2], [0.4, 0.4, 0.4], [0.6, 0.1, 0.1]]
    found = surfels_of(lit(points, [0.1, 0.2, 0.3, 0.6, 0.9], origin=(0.0, 0.0, 0.0)))
    np.testing.assert_allclose(found.brightness, [0.3, 0.9], rtol=1e-6)


def test_points_without_a_brightness_do_not_dim_others():
    points = np.random.default_rng(5).uniform(0.01, 0.49, (8, 3))
    voxels = lit(points, np.full(8, 0.5), origin=(0.0, 0.0, 0.0))
    voxels.add(points)
    found = surfels_of(voxels)
    np.testing.assert_array_equal(found.points, [16])
    np.testing.assert_allclose(found.brightness, [0.5])
    assert np.isnan(surfels_of(map_of(points, origin=(0.0, 0.0, 0.0))).brightness).all()


def test_brightness_goes_along_with_its_surfel():
    rng = np.random.default_rng(6)
    points = rng.uniform([0, -100, 0], [200, 60, 1], (60000, 3))
    voxels = lit(points, points[:, 0], voxel_m=2.0)
    surfels, brightness = voxels.surfels()
    assert np.abs(brightness - (surfels["xyz"][:, 0] + voxels.origin[0])).max() < 1e-3


def test_statistics_keep_brightness(cloud):
    intensity = np.random.default_rng(7).uniform(0, 1, len(cloud))
    near = lattice_origin(0.5, np.array([98.0, -50.0, 1.0]))
    one, other = (lit(cloud[part], intensity[part], origin=near) for part in (slice(0, 500), slice(500, None)))
    one.add_statistics(other.statistics())
    expected = surfels_of(lit(cloud, intensity, origin=near)).brightness
    np.testing.assert_allclose(surfels_of(one).brightness, expected, atol=1e-6)


def test_a_cloud_of_two_towns_60_km_apart_takes_what_both_take():
    near = np.random.default_rng(3).uniform([100, -50, 0], [140, -10, 4], (20_000, 3))
    far = near + [45_000.0, 40_000.0, 200.0]

    def cost(*towns):
        voxels = VoxelMap(0.5, lattice_origin(0.5, np.mean([town.mean(axis=0) for town in towns], axis=0)))
        tracemalloc.start()
        for town in towns:
            voxels.add(town)
        prepared_cloud = prepared(voxels)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert prepared_cloud is not None
        return sum(array.nbytes for array in prepared_cloud.arrays().values()), peak

    (one, one_peak), (other, other_peak), (both, peak) = cost(near), cost(far), cost(near, far)
    assert both < 1.05 * (one + other)
    assert peak < 1.05 * (one_peak + other_peak)


def test_moments_of_a_group_are_those_of_its_points():
    rng = np.random.default_rng(5)
    points = rng.uniform([0.05, 0.05, 0.05], [0.45, 0.45, 0.45], (200, 3))
    whole, group = map_of(points, origin=(0, 0, 0)), map_of(origin=(0, 0, 0))
    group.add_moments(points.mean(axis=0)[None], np.array([200]), np.cov(points, rowvar=False, bias=True)[None])
    for one, other in zip(group.sums(), whole.sums(), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)


def test_discarded_voxels_are_removed(cloud):
    voxels = map_of(cloud)
    means = voxels.means()
    voxels.keep(means[:, 0] < 101.0)
    np.testing.assert_array_equal(voxels.means(), means[means[:, 0] < 101.0])
    np.testing.assert_array_equal(voxels.keys_of(voxels.means()), voxels.sums()[0])


REACH_CELLS = (1 << 19) - 2
cells = st.tuples(*[st.integers(-REACH_CELLS, REACH_CELLS - 1)] * 3)


@given(cells, cells, st.sampled_from([0.1, 0.3, 1.0]))
def test_two_voxels_within_reach_never_share_a_key_and_keep_their_place(one, other, voxel_m):
    voxels = VoxelMap(voxel_m, np.array([30.0, -600.0, 9.0]))
    points = voxels.origin + (np.array([one, other]) + 0.5) * voxel_m
    voxels.add(points)
    keys = voxels.keys_of(points)
    assert (keys[0] == keys[1]) == (one == other)
    found = voxels.means()
    assert len(found) == len({one, other})
    for point in points:
        assert np.abs(found - point).max(axis=1).min() < 1e-3 * voxel_m


@given(st.integers(0, 2), st.sampled_from([-1, 1]), st.floats(1.001, 1e9))
def test_points_beyond_the_voxel_keys_are_refused(axis, sign, times):
    """At 0.3 m the keys end after 157 km. A UTM position among local ones fell into voxels of the map."""
    voxels = VoxelMap(0.3, np.zeros(3))
    point = np.zeros((2, 3))
    point[1, axis] = sign * times * voxels.reach_m
    with pytest.raises(DatasetError, match="one frame"):
        voxels.add(point)
    with pytest.raises(DatasetError, match="one frame"):
        voxels.keys_of(point)
    assert not len(voxels.sums()[0])


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_a_coordinate_that_is_no_number_is_refused(number):
    with pytest.raises(DatasetError):
        VoxelMap(0.3, np.zeros(3)).add(np.array([[0.0, number, 0.0]]))


def test_neighbours_of_the_farthest_voxels_are_theirs():
    """One cell further, the y key of the neighbour would belong to a voxel at the other end, one row on."""
    voxels = VoxelMap(1.0, np.zeros(3))
    far = voxels.reach_m - 0.5
    ends = [[0.5, far, 0.5], [1.5, -far, 0.5]]
    voxels.add(np.repeat(np.array(ends), 4, axis=0))
    assert len(surfels_of(voxels, fewest=4).positions) == 2
    assert len(surfels_of(voxels, fewest=5).positions) == 0


def test_sums_of_a_map_out_of_reach_are_refused():
    near, far = (VoxelMap(0.5, np.array([x, 0.0, 0.0])) for x in (0.0, 400_000.0))
    far.add(far.origin + np.array([[0.1, 0.1, 0.1]]))
    with pytest.raises(DatasetError, match="400 km from the middle"):
        near.add_statistics(far.statistics())


@pytest.mark.parametrize("held", [(0,), (1,), (0, 1), ()])
def test_a_caller_of_sums_keeps_arrays_of_their_length(cloud, held):
    """The map grows in place only if nobody else has its arrays."""
    half = len(cloud) // 2
    one, other = map_of(cloud[:half], cloud[half:]), map_of(cloud[:half])
    kept = [other.sums()[k] for k in held]
    before = [len(each) for each in kept]
    other.add(cloud[half:])
    np.testing.assert_array_equal(other.sums()[0], one.sums()[0])
    np.testing.assert_allclose(other.sums()[1], one.sums()[1], atol=1e-5)
    assert [len(each) for each in kept] == before
    assert len(other.sums()[0]) > 100


@given(st.lists(st.lists(st.integers(-20, 20), max_size=30), max_size=8), st.integers(1, 7))
def test_a_map_that_grows_in_place_is_the_map_of_all_points(batches, part):
    """Points in the middle of cells along a line; the map merges after each batch, and moves a few rows at a time."""
    grown, points = VoxelMap(1.0, np.zeros(3)), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("model_training.mapping.voxel_map._PART", part)
        for batch in batches:
            batch_points = [[cell + 0.5, 0.5, 0.5] for cell in batch]
            grown.add(np.array(batch_points).reshape(-1, 3))
            grown.means()
            points += batch_points
    whole = VoxelMap(1.0, np.zeros(3))
    whole.add(np.array(points).reshape(-1, 3))
    np.testing.assert_array_equal(grown.sums()[0], whole.sums()[0])
    np.testing.assert_array_equal(grown.sums()[1], whole.sums()[1])


def test_a_map_grows_without_a_copy_of_itself(monkeypatch):
    monkeypatch.setattr("model_training.mapping.voxel_map._PART", 1 << 12)
    rng = np.random.default_rng(5)
    voxels = VoxelMap(0.3, np.zeros(3))
    tracemalloc.start()
    voxels.add(rng.uniform([0, 0, 0], [300, 300, 0.3], (3_000_000, 3)))
    before = len(voxels.sums()[0])
    voxels.add(rng.uniform([290, 0, 0], [330, 300, 0.3], (300_000, 3)))
    held = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    added = len(voxels.sums()[0]) - before
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert added > 50_000
    assert peak - held < 0.5 * 56 * before  # a copy would take 56 bytes for each voxel


@pytest.mark.parametrize(
    ("work", "most"),
    [
        (lambda voxels: voxels.surfaces(), 30),
        (lambda voxels: voxels.surfels(), 80),
        (lambda voxels: sum(column.sum(dtype=np.float64) for column in voxels.columns().each()), 10),
        (lambda voxels: voxels.statistics(), 72),
        (lambda voxels: Targets.of(voxels), 50),
        (lambda voxels: prepared(voxels), 90),
    ],
    ids=["surfaces", "surfels", "columns", "statistics", "targets", "prepared"],
)
def test_bytes_beside_a_large_map(work, most, monkeypatch):
    """A voxel has 56 bytes. A tile of a town has five million, so each byte beside them counts."""
    monkeypatch.setattr("model_training.mapping.voxel_map._PART", 1 << 12)
    rng = np.random.default_rng(2)
    voxels = VoxelMap(0.3, np.zeros(3))
    voxels.add(rng.uniform([0, 0, 0], [150, 150, 0.3], (1_000_000, 3)))
    count = len(voxels.sums()[0])
    assert count > 200_000
    tracemalloc.start()
    kept = work(voxels)
    peak = tracemalloc.get_traced_memory()[1] / count
    tracemalloc.stop()
    assert kept is not None  # it stays in memory until here
    assert 0.7 * most < peak < most


@pytest.mark.parametrize("voxel_m", [0.1, 0.3, 0.7])
@pytest.mark.parametrize("side", [-1, 1])
def test_a_point_at_the_limit_is_added_or_refused(voxel_m, side):
    """Rounding decides which. Nothing else may come out: the sums of such a scan are not computed."""
    voxels = VoxelMap(voxel_m, np.zeros(3))
    for distance_m in np.nextafter(voxels.reach_m, [0.0, np.inf]).tolist() + [voxels.reach_m]:
        point = np.array([[side * distance_m, 0.0, 0.0]])
        before = len(voxels.sums()[0])
        try:
            voxels.add(point)
        except DatasetError:
            assert len(voxels.sums()[0]) == before
        else:
            assert voxels.means()[:, 0] == pytest.approx(side * voxels.reach_m, rel=1e-6)


def plain_sums(points, intensity, origin, voxel_m):
    """Compute the sums of points by voxel in NumPy: double precision in the order of the points, then single precision."""
    cell = np.floor((points - origin) / voxel_m)
    local = (points - origin) - (cell + 0.5) * voxel_m
    x, y, z = local.T
    bright = [np.zeros(len(x))] * 2 if intensity is None else [intensity.astype(np.float64), np.ones(len(x))]
    moments = np.stack([np.ones(len(x)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z, *bright], axis=1)
    shifted = cell.astype(np.int64) + SPAN // 2
    keys, row_of = np.unique((shifted[:, 0] * SPAN + shifted[:, 1]) * SPAN + shifted[:, 2], return_inverse=True)
    sums = np.zeros((len(keys), 12))
    np.add.at(sums, row_of, moments)
    return keys, sums.astype(np.float32), row_of


#: Points near each other and far away, on limits of cells, and in any order.
random_points = given(
    seed=st.integers(0, 10**6),
    count=st.integers(0, 300),
    voxel_m=st.sampled_from([0.3, 0.4, 1.0]),
    extent_m=st.sampled_from([0.2, 2.0, 40.0, 90_000.0]),
    on_limits=st.booleans(),
)


def points_of(seed, count, voxel_m, extent_m, on_limits):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-extent_m, extent_m, (count, 3)) * rng.choice([1.0, 0.01], (count, 1))
    return np.round(points / voxel_m) * voxel_m if on_limits else points


@random_points
def test_the_sums_of_points_are_numpys_to_the_bit(seed, count, voxel_m, extent_m, on_limits):
    points, origin = points_of(seed, count, voxel_m, extent_m, on_limits), np.array([10.0, -20.0, 0.5])
    intensity = np.random.default_rng(seed).random(count).astype(np.float32) if seed % 2 else None
    voxels = VoxelMap(voxel_m, origin)
    voxels.add(points, intensity)
    keys, sums, _ = plain_sums(points, intensity, origin, voxel_m)
    np.testing.assert_array_equal(voxels.sums()[0], keys)
    assert voxels.sums()[1].tobytes() == sums.tobytes()


@random_points
def test_the_voxels_of_points_are_numpys(seed, count, voxel_m, extent_m, on_limits):
    points, origin = points_of(seed, count, voxel_m, extent_m, on_limits), np.array([10.0, -20.0, 0.5])
    half, source = count // 2, np.sort(np.random.default_rng(seed).integers(0, 4, count))
    known, voxels = VoxelMap(voxel_m, origin), VoxelMap(voxel_m, origin)
    known.add(points[:half])
    expected = np.unique(plain_sums(points[half:], None, origin, voxel_m)[0])
    np.testing.assert_array_equal(known.rows_of(points[half:]), np.flatnonzero(np.isin(known.sums()[0], expected)))
    keys, sums, row_of = plain_sums(points, None, origin, voxel_m)
    found, of_several, rows = voxels.add_from(points, source)
    np.testing.assert_array_equal(found, keys)
    np.testing.assert_array_equal(rows, row_of)
    assert of_several.tolist() == [len(set(source[row_of == row])) > 1 for row in range(len(keys))]
    assert voxels.sums()[1].tobytes() == sums.tobytes()


def test_voxels_of_points_by_hand():
    """Voxels of 1 m along x. Points of the sources 0, 0, 1, 1 and 4 lie in the voxels 2, 0, 2, 0 and 5."""
    voxels = VoxelMap(1.0, np.zeros(3))
    points = np.array([[2.5, 0, 0], [0.5, 0, 0], [2.1, 0, 0], [0.2, 0, 0], [5.5, 0, 0]])
    _, of_several, row_of = voxels.add_from(points[[0, 1, 2, 4]], np.array([0, 0, 1, 4]))
    assert (of_several.tolist(), row_of.tolist()) == ([False, True, False], [1, 0, 1, 2])
    assert voxels.rows_of(points[[4, 3, 1]]).tolist() == [0, 2]
    assert voxels.rows_of(np.array([[1.5, 0, 0], [9.5, 0, 0], [-0.5, 0, 0]])).tolist() == []
    assert voxels.rows_of(np.zeros((0, 3))).tolist() == []
    with pytest.raises(DatasetError, match="from the middle"):
        voxels.rows_of(np.array([[1e9, 0, 0]]))


@pytest.mark.parametrize("most", [3, 12, 700])
def test_merged_sums_are_numpys_to_the_bit(most):
    """Up to ``most`` voxels receive sums of 3,000 rows, so some receive one row, and some more than 128. Some numbers are -0."""
    rng = np.random.default_rng(most)
    voxels, expected = VoxelMap(1.0, np.zeros(3)), {}
    for _ in range(3):
        keys = np.r_[rng.integers(0, most, 3000), rng.integers(5000, 5000 + most, 5)]
        moments = rng.normal(0, 10.0 ** rng.integers(-4, 5, (len(keys), 1)), (len(keys), 12)).astype(np.float32)
        moments[rng.random(moments.shape) < 0.2] = -0.0
        for part in np.array_split(np.arange(len(keys)), 7):
            voxels.add_sums(keys[part], moments[part])
        order = np.argsort(keys, kind="stable")
        first = np.flatnonzero(np.r_[True, np.diff(keys[order]) > 0])
        sums = np.add.reduceat(moments[order], first, axis=0)
        for key, row in zip(keys[order][first].tolist(), sums, strict=True):
            expected[key] = expected[key] + row if key in expected else row
        voxels.sums()  # merges
    assert voxels.sums()[0].tolist() == sorted(expected)
    assert voxels.sums()[1].tobytes() == np.stack([expected[key] for key in sorted(expected)]).tobytes()


def test_a_surface_does_not_depend_on_the_voxels_that_are_computed_with_it(cloud):
    """The voxels of a heap take other places among those of two heaps. A flat heap of exact numbers needs no rotation."""
    flat = np.stack(np.meshgrid(*[np.arange(0.125, 4, 0.25)] * 2, [0.25]), axis=-1).reshape(-1, 3) + [100, -50, 2]
    for heap in (cloud, flat):
        alone, both = map_of(heap), map_of(heap, np.random.default_rng(3).uniform(0, 6, (501, 3)) + [60, -50, 2])
        one, other = alone.surfaces(), both.surfaces()
        row_of = np.searchsorted(both.sums()[0], alone.sums()[0][one.rows])
        assert len(other.rows) > len(one.rows) > 32
        assert one.normals[one.rows].tobytes() == other.normals[row_of].tobytes()
        assert one.thickness_m[one.rows].tobytes() == other.thickness_m[row_of].tobytes()
    assert (one.normals[one.rows] == [0, 0, 1]).all()
    assert (one.thickness_m[one.rows] == 0).all()


def test_arrays_of_other_shapes_are_refused():
    """The C code would read beyond their ends."""
    voxels = VoxelMap(0.3, np.zeros(3))
    for intensity in (np.ones(4, np.float32), np.ones((5, 1), np.float32)):
        with pytest.raises(ValueError, match=r"intensity: the shape .* does not fit 5 points"):
            voxels.add(np.zeros((5, 3)), intensity)
    for call in (voxels.add, voxels.rows_of, lambda points: voxels.add_from(points, np.zeros(5, np.int64))):
        with pytest.raises(ValueError, match=r"points: the shape \(5, 2\) is not \(n, 3\)"):
            call(np.zeros((5, 2)))
    assert len(voxels.sums()[0]) == 0
