import numpy as np
import pytest

from service.errors import BundleError
from service.registration.kernel import SURFEL, SolverOptions, align
from service.registration.surfel_map import SurfelMap

REQUIRED = [
    "origin",
    "surfels",
    "tiles",
    *(f"grid_{array}" for array in ("frame", "slots", "regions", "blocks", "nearest")),
]
NAMES = [*REQUIRED, "brightness"]


@pytest.fixture(scope="module")
def cloud(scene_of):
    """Return two floors in two tiles, 50 m apart."""
    surfels = scene_of(((0, 0, 0), (3, 0, 0), (0, 3, 0)), ((50, 0, 0), (3, 0, 0), (0, 3, 0))).surfels()
    half = len(surfels) // 2
    tiles = np.array([[20.0, 20, 0, half], [60, 20, half, half]])
    brightness = np.linspace(0, 1, len(surfels), dtype=np.float32)
    brightness[3] = np.nan  # no return told any
    return SurfelMap.prepare(np.array([100.0, 200.0, 30.0]), surfels, tiles, brightness)


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
    assert isinstance(mapped.grid.nearest, np.memmap)
    points = points_at([[1.0, 1, -1.4], [-1, 1, -1.4], [0.5, -1, -1.4], [-1, -1, -1.4]])
    options = SolverOptions(iterations=5, reach=1.2, robust_first=1.0, robust_last=0.1)
    states = [start_at(np.eye(3), [1.5, 1.5, 1.6]) for _ in range(2)]
    for each, state in zip((cloud, mapped), states, strict=True):
        align(each.grid, each.surfels, points, state, options)
    assert states[0].tobytes() == states[1].tobytes()
    assert states[0]["inliers"][0] > 0.9


@pytest.mark.parametrize(("above_m", "seen"), [(1.0, 1), (1.6, 0), (-1.0, 1), (-1.6, 0)])
def test_the_grid_reaches_12_decimetres_from_a_surface(cloud, points_at, start_at, above_m, seen):
    """A cell of 0.4 m is inside or outside by its centre: 1.2 m, plus or minus half a cell."""
    once = SolverOptions(iterations=1, reach=5.0, robust_first=1.0, robust_last=1.0)
    state = start_at(np.eye(3), [1.5, 1.5, above_m - 1.0])
    align(cloud.grid, cloud.surfels, points_at([[0, 0, 1.0]]), state, once)
    assert state["matched"][0] == seen


@pytest.mark.parametrize("name", REQUIRED)
def test_a_missing_array_is_named(arrays, name):
    del arrays[name]
    refused(arrays, name, "missing")


@pytest.mark.parametrize("name", REQUIRED)
def test_an_array_of_another_type_is_named(arrays, name):
    arrays[name] = np.zeros(arrays[name].shape, np.float32)
    refused(arrays, name, "float32 of shape")


@pytest.mark.parametrize("name", ["origin", "grid_frame", "grid_slots", "grid_nearest"])
def test_numbers_of_another_byte_order_are_refused(arrays, name):
    arrays[name] = arrays[name].astype(arrays[name].dtype.newbyteorder(">"))
    refused(arrays, name, "of shape .* instead of")


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("origin", (4,)),
        ("origin", (1, 3)),
        ("surfels", (2, 3)),
        ("tiles", (2, 3)),
        ("tiles", (8,)),
        ("grid_frame", (3,)),
        ("grid_frame", (5,)),
        ("grid_slots", (4, 4)),
        ("grid_regions", (1, 2)),
        ("grid_blocks", (4, 4)),
        ("grid_nearest", (3, 512)),
    ],
)
def test_an_array_of_another_shape_is_named(arrays, name, shape):
    arrays[name] = np.zeros(shape, arrays[name].dtype)
    refused(arrays, name, "of shape")


@pytest.mark.parametrize("name", ["tiles"])
def test_an_array_in_another_order_of_memory_is_named(arrays, name):
    arrays[name] = np.asfortranarray(arrays[name])
    refused(arrays, name, "of shape")


@pytest.mark.parametrize("beyond", [True, False])
def test_an_index_that_points_outside_is_named(arrays, beyond):
    surfels = arrays["surfels"]
    arrays["grid_nearest"][3] = len(surfels) if beyond else -1
    refused(arrays, "grid_nearest", f"an index is outside the {len(surfels)} entries")
    arrays["grid_nearest"][3] = len(surfels) - 1 if beyond else 0
    assert len(SurfelMap.from_arrays(arrays).surfels) == len(surfels)


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
        ("grid_regions", "first", -1, "a block is outside the .* entries of grid_blocks"),
        ("grid_regions", "first", 10**9, "a block is outside the .* entries of grid_blocks"),
        ("grid_regions", "row", 513, "a block is outside the .* entries of grid_blocks"),
        ("grid_blocks", "first", -1, "a cell is outside the .* entries of grid_nearest"),
        ("grid_blocks", "first", 10**9, "a cell is outside the .* entries of grid_nearest"),
        ("grid_blocks", "first", 2**63 - 1, "a cell is outside the .* entries of grid_nearest"),
        ("grid_blocks", "before", 400, "a number of filled cells is wrong"),
        ("grid_blocks", "filled", 0, "a number of filled cells is wrong"),
    ],
)
def test_a_level_of_the_grid_that_points_outside_is_refused(arrays, name, field, value, what):
    arrays[name][field][-1] = value
    refused(arrays, name, what)


def test_a_tile_that_ends_beyond_the_surfels_is_refused(arrays):
    arrays["tiles"][1, 3] += 1
    refused(arrays, "tiles", "ends beyond")


@pytest.mark.parametrize(("column", "value"), [(0, np.nan), (1, np.inf), (2, -1), (3, -1), (3, np.nan)])
def test_a_tile_of_senseless_numbers_is_refused(arrays, column, value):
    arrays["tiles"][0, column] = value
    refused(arrays, "tiles", "a number is not finite, or an index is negative")


@pytest.mark.parametrize(("entry", "value"), [(0, np.nan), (2, np.inf), (3, np.nan), (3, 0.0), (3, -0.4)])
def test_a_frame_that_is_none_is_refused(arrays, entry, value):
    arrays["grid_frame"][entry] = value
    refused(arrays, "grid_frame", "the origin is not finite, or the cell size is not positive")


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_surfel_that_is_nowhere_is_refused(arrays, value):
    arrays["surfels"]["xyz"][5, 1] = value
    refused(arrays, "surfels", "not finite")


@pytest.mark.parametrize(("name", "field"), [("origin", None), ("surfels", "normal"), ("surfels", "thickness_m")])
def test_other_numbers_that_are_none_are_refused(arrays, name, field):
    (arrays[name] if field is None else arrays[name][field])[0] = np.nan
    with pytest.raises(BundleError):
        SurfelMap.from_arrays(arrays)


def test_the_check_of_every_index_can_be_skipped(arrays):
    arrays["grid_nearest"][0] = 10**6
    assert SurfelMap.from_arrays(arrays, verify=False).grid.nearest[0] == 10**6
    with pytest.raises(BundleError):
        SurfelMap.from_arrays(arrays, verify=False).require_consistent()


def test_a_map_without_tiles_is_consistent(arrays):
    arrays["tiles"] = np.zeros((0, 4))
    assert len(SurfelMap.from_arrays(arrays).tiles) == 0


def test_a_surfel_takes_32_bytes():
    assert SURFEL.itemsize == 32


def test_a_map_of_an_earlier_release_has_no_brightness(arrays):
    del arrays["brightness"]
    found = SurfelMap.from_arrays(arrays)
    assert found.brightness is None
    assert "brightness" not in found.arrays()


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (lambda b: b[:-1], "float32 of shape"),
        (lambda b: b.astype(np.float64), "float64 of shape"),
        (lambda b: np.where(np.arange(len(b)) == 5, np.float32(-1), b), "a brightness is negative or infinite"),
        (lambda b: np.where(np.arange(len(b)) == 5, np.float32(np.inf), b), "a brightness is negative or infinite"),
    ],
)
def test_a_brightness_that_is_none_is_refused(arrays, damage, what):
    arrays["brightness"] = damage(arrays["brightness"])
    refused(arrays, "brightness", what)
