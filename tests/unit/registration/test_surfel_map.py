from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from service.errors import BundleError, StreetfixError
from service.registration import kernel
from service.registration.kernel import PACKED_SURFEL, SURFEL, SolverOptions, align, packed_map, surfels_at
from service.registration.surfel_map import SurfelMap

REQUIRED = [
    "origin",
    "surfels",
    *(f"grid_{array}" for array in ("frame", "slots", "regions", "blocks", "cells", "others")),
]
NAMES = [*REQUIRED, "brightness"]


@pytest.fixture(scope="module")
def cloud(scene_of):
    """Return two floors in two regions, 50 m apart."""
    surfels = scene_of(((0, 0, 0), (3, 0, 0), (0, 3, 0)), ((50, 0, 0), (3, 0, 0), (0, 3, 0))).surfels()
    brightness = np.linspace(0, 1, len(surfels), dtype=np.float32)
    brightness[3] = np.nan  # no return told any
    return SurfelMap.prepare(np.array([100.0, 200.0, 30.0]), surfels, brightness)


@pytest.fixture
def arrays(cloud):
    """Return valid arrays that a test then damages."""
    return {name: array.copy() for name, array in cloud.arrays().items()}


def refused(arrays, name, what):
    with pytest.raises(BundleError, match=rf"cloud/{name}\.npy: .*{what}.*copy or build the bundle again") as error:
        SurfelMap.from_arrays(arrays)
    assert error.value.field == f"cloud/{name}.npy"


def test_written_values_are_read_again(cloud):
    found = SurfelMap.from_arrays(cloud.arrays()).arrays()
    assert sorted(found) == sorted(cloud.arrays()) == sorted(NAMES)
    for name, array in cloud.arrays().items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def test_memory_mapped_arrays_register_like_those_in_memory(cloud, tmp_path, points_at, start_at):
    for name, array in cloud.arrays().items():
        np.save(tmp_path / f"{name}.npy", array)
    mapped = SurfelMap.from_arrays({name: np.load(tmp_path / f"{name}.npy", mmap_mode="r") for name in NAMES})
    assert isinstance(mapped.surfels, np.memmap)
    assert isinstance(mapped.grid.cells, np.memmap)
    points = points_at([[1.0, 1, -1.4], [-1, 1, -1.4], [0.5, -1, -1.4], [-1, -1, -1.4]])
    options = SolverOptions(iterations=5, reach=1.2, robust_first=1.0, robust_last=0.1)
    states = [start_at(np.eye(3), [1.5, 1.5, 1.6]) for _ in range(2)]
    for each, state in zip((cloud, mapped), states, strict=True):
        align(each.pieces, points, state, options)
    assert states[0].tobytes() == states[1].tobytes()
    assert states[0]["inliers"][0] > 0.9


@pytest.mark.parametrize(("above_m", "seen"), [(1.0, 1), (1.6, 0), (-1.0, 1), (-1.6, 0)])
def test_the_grid_reaches_12_decimetres_from_a_surface(cloud, points_at, start_at, above_m, seen):
    """A cell of 0.4 m is inside or outside by its centre: 1.2 m, plus or minus half a cell."""
    once = SolverOptions(iterations=1, reach=5.0, robust_first=1.0, robust_last=1.0)
    state = start_at(np.eye(3), [1.5, 1.5, above_m - 1.0])
    align(cloud.pieces, points_at([[0, 0, 1.0]]), state, once)
    assert state["matched"][0] == seen


@pytest.mark.parametrize("name", REQUIRED)
def test_a_missing_array_is_named(arrays, name):
    del arrays[name]
    refused(arrays, name, "missing")


@pytest.mark.parametrize("name", REQUIRED)
def test_an_array_of_another_type_is_named(arrays, name):
    arrays[name] = np.zeros(arrays[name].shape, np.float32)
    refused(arrays, name, "float32 of shape")


@pytest.mark.parametrize("name", ["origin", "grid_frame", "grid_slots", "grid_others"])
def test_numbers_of_another_byte_order_are_refused(arrays, name):
    arrays[name] = arrays[name].astype(arrays[name].dtype.newbyteorder(">"))
    refused(arrays, name, "of shape .* instead of")


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("origin", (4,)),
        ("origin", (1, 3)),
        ("surfels", (2, 3)),
        ("grid_others", (3, 1)),
        ("grid_frame", (3,)),
        ("grid_frame", (5,)),
        ("grid_slots", (4, 4)),
        ("grid_regions", (1, 2)),
        ("grid_blocks", (4, 4)),
        ("grid_cells", (3, 512)),
    ],
)
def test_an_array_of_another_shape_is_named(arrays, name, shape):
    arrays[name] = np.zeros(shape, arrays[name].dtype)
    refused(arrays, name, "of shape")


def test_an_array_in_another_order_of_memory_is_named(arrays):
    arrays["surfels"] = np.repeat(arrays["surfels"], 2)[::2]
    refused(arrays, "surfels", "of shape")


@pytest.mark.parametrize("region", [0, -1])
def test_a_cell_that_refers_outside_the_surfels_of_its_block_is_refused(arrays, region):
    block = arrays["grid_blocks"][arrays["grid_regions"]["block"][region]]
    first = int(arrays["grid_regions"]["cells"][region]) + int(block["first"])
    referred = int(block["own"] & 255) + int(block["first"]) // 2  # the list of the first block begins with its region
    arrays["grid_cells"][first] = referred
    refused(arrays, "grid_cells", "a number is outside the surfels of its block or region")
    arrays["grid_cells"][first] = referred - 1
    assert len(SurfelMap.from_arrays(arrays).surfels) == len(arrays["surfels"])


@cache
def crowded_arrays():
    """Return a map whose blocks list foreign surfels, and some of which are wide."""
    surfels, rng = np.zeros(3000, SURFEL), np.random.default_rng(0)
    surfels["xyz"] = np.r_[rng.uniform(0, [30, 5, 1], (1000, 3)), rng.uniform(0, 3, (2000, 3))]
    return {name: array.copy() for name, array in SurfelMap.prepare(np.zeros(3), surfels).arrays().items()}


@pytest.mark.parametrize("wide", [False, True])
def test_a_listed_number_outside_the_surfels_of_its_region_is_refused(wide):
    """The number of a foreign surfel in a narrow block, and of a cell in a wide one."""
    arrays = {name: array.copy() for name, array in crowded_arrays().items()}
    region, blocks = arrays["grid_regions"][0], arrays["grid_blocks"]
    is_wide = blocks["before"] >> np.uint64(63) > 0
    of_region = int(region["block"]) + np.arange(int(np.bitwise_count(region["has"]).sum()))
    of_kind = of_region[(is_wide == wide)[of_region]]
    at = int(blocks["first"][of_kind[0]]) if wide else int(blocks["first"][of_kind[1]]) - 2
    most = int(region["surfels"]) + int(region["others"])
    for number, is_sound in ((most - 1, True), (most, False)):
        arrays["grid_cells"][at], arrays["grid_cells"][at + 1] = number & 255, number >> 8
        if wide:
            arrays["grid_cells"][at + 2] = 0
        if is_sound:
            assert len(SurfelMap.from_arrays(arrays).surfels) == 3000
        else:
            refused(arrays, "grid_cells", "a number is outside the surfels of its block or region")


#: Arrays that the kernel reads without checks.
GRID = [name for name in REQUIRED if name.startswith("grid_") and name != "grid_frame"]


@given(
    damage=st.lists(
        st.tuples(st.sampled_from(GRID), st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=8)),
        min_size=1,
        max_size=3,
    )
)
@settings(max_examples=300, deadline=None)
def test_a_damaged_grid_is_refused_or_refers_to_surfels_of_the_map(damage):
    """Wherever bytes change, no lookup leaves the arrays. ``make sanitize`` sees each read outside of them."""
    arrays = dict(crowded_arrays())
    for name, share, written in damage:
        changed = bytearray(crowded_arrays()[name].tobytes())
        at = int(share * len(changed))
        changed[at : at + len(written)] = written[: len(changed) - at]
        arrays[name] = np.frombuffer(bytes(changed), arrays[name].dtype).copy()
    try:
        found = SurfelMap.from_arrays(arrays)
    except BundleError:
        return
    rows = surfels_at(found.pieces, np.random.default_rng(0).uniform(-3, 33, (500, 3)))
    assert -1 <= rows.min() <= rows.max() < 3000


@pytest.mark.parametrize("size", [-1, 1])
def test_cells_that_are_cut_or_too_long_are_refused(size):
    arrays = dict(crowded_arrays())
    arrays["grid_cells"] = np.resize(arrays["grid_cells"], len(arrays["grid_cells"]) + size)
    refused(arrays, "grid_cells", "its length is not what the blocks need")


@pytest.mark.parametrize("beyond", [True, False])
def test_an_entry_that_refers_outside_the_surfels_is_refused(beyond):
    surfels = np.zeros(1000, SURFEL)
    surfels["xyz"] = np.random.default_rng(0).uniform(0, [30, 5, 1], (1000, 3))  # two regions
    arrays = {name: array.copy() for name, array in SurfelMap.prepare(np.zeros(3), surfels).arrays().items()}
    arrays["grid_others"][0] = len(arrays["surfels"]) if beyond else -1
    refused(arrays, "grid_others", "an index is outside")


@pytest.mark.parametrize("kept", [-1, 1, 0])
def test_a_hash_table_without_a_free_slot_or_of_another_length_is_refused(arrays, kept):
    full = np.arange(1 << (len(arrays["grid_regions"]).bit_length() - 1), dtype="<i4")
    arrays["grid_slots"] = arrays["grid_slots"][:kept] if kept else full
    refused(arrays, "grid_slots", "instead of a power of two above their number")


@pytest.mark.parametrize(
    ("value", "what"),
    [
        (-2, "an index is outside the .* entries"),
        (10**6, "an index is outside the .* entries"),
        (1, "a region is missing or occurs twice"),
        (-1, "a region is missing or occurs twice"),
    ],
)
def test_a_hash_table_that_loses_a_region_is_refused(arrays, value, what):
    arrays["grid_slots"][arrays["grid_slots"] == 0] = value
    refused(arrays, "grid_slots", what)


@pytest.mark.parametrize(
    ("name", "field", "value", "what"),
    [
        ("grid_regions", "block", -1, "the .* blocks are not shared out"),
        ("grid_regions", "block", 10**9, "the .* blocks are not shared out"),
        ("grid_regions", "has", 2**64 - 1, "a number of blocks is wrong"),
        ("grid_regions", "before", 500, "a number of blocks is wrong"),
        ("grid_regions", "surfel", -1, "the .* surfels are not shared out"),
        ("grid_regions", "surfel", 10**9, "the .* surfels are not shared out"),
        ("grid_regions", "surfels", 10**9, "the .* surfels are not shared out"),
        ("grid_regions", "other", -1, "the .* entries of grid_others are not shared out"),
        ("grid_regions", "others", 10**9, "the .* entries of grid_others are not shared out"),
        ("grid_regions", "cells", -1, "the bytes of the cells are not shared out"),
        ("grid_regions", "cells", 2**63 - 1, "the bytes of the cells are not shared out"),
        ("grid_blocks", "first", 0, "a first cell does not follow"),
        ("grid_blocks", "first", 2**32 - 1, "a first cell does not follow"),
        ("grid_blocks", "before", 400, "a number of filled cells is wrong"),
        ("grid_blocks", "filled", 0, "a number of filled cells is wrong"),
        ("grid_blocks", "own", 2**32 - 1, "the surfels of a block are outside those of its region"),
    ],
)
def test_a_level_of_the_grid_that_points_outside_is_refused(arrays, name, field, value, what):
    arrays[name][field][-1] = value
    refused(arrays, name, what)


@pytest.mark.parametrize(
    ("entry", "value"),
    [(0, np.nan), (2, np.inf), (1, 1e300), (3, np.nan), (3, 0.0), (3, -0.4), (3, np.inf), (3, 1e300)],
)
def test_a_frame_that_is_none_is_refused(arrays, entry, value):
    arrays["grid_frame"][entry] = value
    refused(arrays, "grid_frame", "the corner is not within .* m, or the edge of a cell not between 0 and 10 m")


def test_an_origin_that_is_none_is_refused(arrays):
    arrays["origin"][0] = np.nan
    refused(arrays, "origin", "not within")


def test_the_check_of_every_index_can_be_skipped(arrays):
    arrays["grid_cells"][0] = 255
    assert SurfelMap.from_arrays(arrays, verify=False).grid.cells[0] == 255
    with pytest.raises(BundleError):
        SurfelMap.from_arrays(arrays, verify=False).require_consistent()


def test_a_surfel_takes_11_bytes():
    assert PACKED_SURFEL.itemsize == 11


def packed(surfels):
    grid, found, order = packed_map(surfels, cell_m=0.4, reach_m=1.2)
    return grid.unpacked(found, np.arange(len(found))), surfels[order]


@given(seed=st.integers(0, 10**6), count=st.integers(1, 300), extent_m=st.sampled_from([0.0, 3.0, 200.0]))
def test_packed_surfels_are_near_the_given_ones(seed, count, extent_m):
    """Half a step of a position is 0.2 mm. Half a step of a normal's pair is 0.00024, so a normal errs by up to 0.0009. A code of the
    thickness is 2 sqrt(1.6e-5 t) wide.
    """
    rng = np.random.default_rng(seed)
    surfels = np.zeros(count, SURFEL)
    surfels["xyz"] = rng.uniform(-1, 1, (count, 3)) * extent_m + rng.uniform(-500, 500, 3)
    normal = rng.normal(size=(count, 3)) * rng.choice([1, 1, 0.001], (count, 3))
    surfels["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    surfels["thickness_m"], surfels["points"] = rng.uniform(0, 1, count) ** 3, rng.integers(1, 10**6, count)
    found, given_ones = packed(surfels)
    np.testing.assert_allclose(found["xyz"], given_ones["xyz"], atol=0.00025)
    np.testing.assert_allclose(found["normal"], given_ones["normal"], atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(found["normal"], axis=1), 1, atol=1e-6)
    thickness = given_ones["thickness_m"]
    assert (np.abs(found["thickness_m"] - thickness) <= np.sqrt(1.6e-5 * thickness) + 5e-6).all()
    np.testing.assert_allclose(found["points"], given_ones["points"], rtol=0.05)


def test_numbers_that_packing_keeps():
    """A cell of 0.4 m has 1,024 steps, so a position in eighths of it stays. So do axes, no thickness, 1 cm and few points."""
    surfels = np.zeros(6, SURFEL)
    surfels["xyz"] = 0.05 * np.arange(18).reshape(6, 3)
    surfels["normal"] = [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]]
    surfels["thickness_m"], surfels["points"] = [0, 0, 0.01, 0.01, 0, 0], [0, 1, 2, 3, 4, 5]
    found, expected = packed(surfels)
    np.testing.assert_allclose(found["xyz"], expected["xyz"], atol=1e-6)
    np.testing.assert_array_equal(found["normal"], expected["normal"])
    np.testing.assert_allclose(found["thickness_m"], expected["thickness_m"], rtol=1e-5)
    np.testing.assert_array_equal(found["points"], expected["points"])


def test_numbers_beyond_the_codes_become_the_largest_ones():
    surfels = np.zeros(2, SURFEL)
    surfels["normal"], surfels["thickness_m"], surfels["points"] = [0, 0, 1], [50, 1.04], [2**32 - 1, 1]
    found, _ = packed(surfels)
    np.testing.assert_allclose(found["thickness_m"], 1.0404, rtol=1e-5)
    np.testing.assert_allclose(found["points"], [2**32 - 1, 1], rtol=0.05)


def test_a_region_with_more_surfels_than_two_bytes_number():
    """70,000 surfels in one region of 25.6 m. Every cell refers to the nearest one."""
    rng = np.random.default_rng(4)
    surfels = np.zeros(70_000, SURFEL)
    surfels["xyz"], surfels["normal"] = rng.uniform(0, [20, 20, 2], (70_000, 3)), [0, 0, 1]
    cloud = SurfelMap.prepare(np.zeros(3), surfels)
    grid = SurfelMap.from_arrays(cloud.arrays()).grid
    cells = np.unique(np.floor((rng.uniform(1, [19, 19, 2], (4000, 3)) - grid.origin_m) / grid.cell_m), axis=0)
    centres = grid.origin_m + (cells + 0.5) * grid.cell_m
    xyz = cloud.unpacked(np.s_[:])["xyz"]
    tree: Any = cKDTree(xyz)
    distance, _ = tree.query(centres)
    rows = surfels_at(cloud.pieces, centres)
    assert (rows > 1 << 16).any()
    np.testing.assert_allclose(np.linalg.norm(xyz[rows] - centres, axis=1), distance, atol=1e-5)


def test_a_region_with_more_surfels_than_a_cell_can_refer_to_is_refused(monkeypatch):
    monkeypatch.setattr(kernel, "_MOST_NUMBERED", 10)
    surfels = np.zeros(11, SURFEL)
    with pytest.raises(StreetfixError, match=r"refers to 11 surfels, at most 10; build the map with larger voxels"):
        SurfelMap.prepare(np.zeros(3), surfels)


@pytest.mark.parametrize("field", ["xyz", "normal", "thickness_m"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_surfel_that_is_not_finite_is_not_packed(field, value):
    surfels = np.zeros(3, SURFEL)
    surfels[field][1] = value
    with pytest.raises(StreetfixError, match=f"a number of {field} is not finite"):
        SurfelMap.prepare(np.zeros(3), surfels)


def test_a_negative_thickness_counts_as_none():
    surfels = np.zeros(1, SURFEL)
    surfels["thickness_m"] = -1e-9
    assert packed(surfels)[0]["thickness_m"] == 0


def test_a_slice_of_surfels_is_packed_as_its_copy():
    surfels = np.zeros(6, SURFEL)
    surfels["xyz"][:, 0] = np.arange(6)
    np.testing.assert_allclose(packed(surfels[::2])[0]["xyz"][:, 0], [0, 2, 4], atol=1e-3)


@pytest.mark.parametrize("row", [-1, 10**6])
def test_a_row_outside_the_surfels_is_refused(cloud, row):
    with pytest.raises(IndexError, match="a row is outside the"):
        cloud.unpacked(np.array([0, row]))


def test_a_map_without_a_surfel_is_refused(arrays):
    for name in ("surfels", "grid_regions", "grid_blocks", "grid_cells", "grid_others", "brightness"):
        arrays[name] = arrays[name][:0]
    arrays["grid_slots"] = np.full(2, -1, np.int32)
    refused(arrays, "surfels", "there is none")


@pytest.mark.parametrize("brightest", [0.0, 1e-9])
def test_a_brightness_that_is_nothing_in_half_precision_is_none(brightest):
    surfels = np.zeros(2, SURFEL)
    assert SurfelMap.prepare(np.zeros(3), surfels, np.array([0.0, brightest], np.float32)).brightness is None


def test_a_brightness_beyond_half_precision_becomes_the_largest_one():
    found = SurfelMap.prepare(np.zeros(3), np.zeros(2, SURFEL), np.array([1e6, np.nan], np.float32)).brightness
    assert found is not None
    np.testing.assert_array_equal(found, np.array([65504, np.nan], np.float16))


def test_a_map_may_have_no_brightness(arrays):
    del arrays["brightness"]
    found = SurfelMap.from_arrays(arrays)
    assert found.brightness is None
    assert "brightness" not in found.arrays()


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (lambda b: b[:-1], "float16 of shape"),
        (lambda b: b.astype(np.float32), "float32 of shape"),
        (lambda b: np.where(np.arange(len(b)) == 5, np.float16(-1), b), "a brightness is negative or infinite"),
        (lambda b: np.where(np.arange(len(b)) == 5, np.float16(np.inf), b), "a brightness is negative or infinite"),
    ],
)
def test_a_brightness_that_is_none_is_refused(arrays, damage, what):
    arrays["brightness"] = damage(arrays["brightness"])
    refused(arrays, "brightness", what)


def test_a_map_made_in_two_halves_is_the_map_made_at_once():
    rng = np.random.default_rng(4)
    surfels = np.zeros(500, SURFEL)
    surfels["xyz"], surfels["normal"] = rng.uniform(-60, 60, (500, 3)), [0, 0, 1]
    brightness = rng.random(500).astype(np.float32)
    whole = SurfelMap.prepare(np.zeros(3), surfels, brightness).arrays()
    packed, half = SurfelMap.packed(surfels, brightness)
    surfels["xyz"] = 0.0  # the second half does not read them
    for name, array in SurfelMap.of_packed(np.zeros(3), packed, half).arrays().items():
        np.testing.assert_array_equal(array, whole[name])
    assert SurfelMap.packed(surfels)[1] is None
