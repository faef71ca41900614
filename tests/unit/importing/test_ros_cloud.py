from types import SimpleNamespace as Message

import numpy as np
import pytest

from model_training.importing.ros_cloud import points_of_cloud

TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
XYZI = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8), ("intensity", "f4", 12)]
STAMP_S = 1_700_000_000.25


def cloud(layout, step, values, *, big=False, height=1, row_padding=0, **changed):
    """Return a message with ``values`` by field name, height x width numbers each. Padding between fields is random."""
    order = ">" if big else "<"
    width = len(next(iter(values.values()))) // height
    rng = np.random.default_rng(0)
    data = rng.integers(0, 256, height * (width * step + row_padding), dtype=np.uint8)
    for name, kind, offset in layout:
        if name in values:
            numbers = np.asarray(values[name]).astype(order + kind).reshape(height, width)
            for row in range(height):
                for column in range(width):
                    at = row * (width * step + row_padding) + column * step + offset
                    raw = np.frombuffer(numbers[row, column : column + 1].tobytes(), np.uint8)
                    data[at : at + len(raw)] = raw
    fields = [Message(name=name, offset=offset, datatype=TYPES.get(kind, 99), count=1) for name, kind, offset in layout]
    told = {
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": big,
        "point_step": step,
        "row_step": width * step + row_padding,
        "data": data,
    }
    return Message(**(told | changed))


def xyzi(n=6):
    return {"x": np.arange(n) + 0.5, "y": -np.arange(n), "z": np.arange(n) * 0.25, "intensity": np.arange(n) * 10.0}


def read(message, max_points=100):
    return points_of_cloud(message, stamp_s=STAMP_S, max_points=max_points)


@pytest.mark.parametrize(
    ("layout", "step"),
    [
        (XYZI, 16),
        (XYZI, 48),
        ([("intensity", "f4", 1), ("z", "f4", 9), ("x", "f4", 17), ("y", "f4", 13)], 22),
        ([("x", "f8", 0), ("y", "f8", 8), ("z", "f8", 16), ("intensity", "u2", 24)], 26),
        ([("reflectivity", "u1", 12), *XYZI[:3]], 13),
        ([*XYZI, ("_", "u1", 16), ("_", "u1", 17), ("ring", "odd", 18)], 20),
    ],
)
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize(("height", "row_padding"), [(1, 0), (2, 0), (3, 5)])
def test_any_layout_gives_the_same_points(layout, step, big, height, row_padding):
    told = xyzi()
    values = told | {"reflectivity": told["intensity"]}
    points, offsets = read(cloud(layout, step, values, big=big, height=height, row_padding=row_padding))
    np.testing.assert_array_equal(points, np.stack(list(told.values()), axis=1).astype(np.float32))
    assert points.dtype == np.float32
    assert offsets is None


def test_a_cloud_without_intensity_has_zeros():
    points, _ = read(cloud(XYZI[:3], 12, {name: xyzi()[name] for name in "xyz"}))
    assert not points[:, 3].any()


OFFSETS = np.array([0.0, 0.025, 0.05, 0.099])


@pytest.mark.parametrize(
    ("name", "kind", "values", "atol"),
    [
        ("t", "u4", OFFSETS * 1e9, 1e-9),  # Ouster
        ("time", "f4", OFFSETS - 0.099, 1e-7),  # Velodyne: before the stamp
        ("timestamp", "f8", OFFSETS + STAMP_S, 1e-6),  # Hesai, RoboSense
        ("offset_time", "u4", OFFSETS * 1e9, 1e-9),  # Livox
        ("timestamp", "f8", (OFFSETS + STAMP_S) * 1e9, 1e-6),  # Livox, nanoseconds since 1970 as a double
        ("timestamp", "u4", OFFSETS * 1e9, 1e-9),
    ],
)
def test_each_drivers_times_of_points_are_against_the_stamp(name, kind, values, atol):
    layout = [*XYZI, (name, kind, 16)]
    _, offsets = read(cloud(layout, 24, {**xyzi(4), name: values}))
    expected = OFFSETS - 0.099 if name == "time" else OFFSETS
    np.testing.assert_allclose(offsets, expected, atol=atol)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"width": 0}, "no points"),
        ({"width": 101}, "more than 100 points"),
        ({"data": np.zeros(16 * 6 - 1, np.uint8)}, "truncated"),
        ({"point_step": 15}, "point_step of 15 bytes is too small for its fields"),
        ({"row_step": 16 * 5}, "row_step"),
        ({"fields": []}, r"no x, y, z \(they are: none\)"),
    ],
)
def test_a_message_that_is_no_scan_says_why(changed, why):
    import re

    found = read(cloud(XYZI, 16, xyzi(), **changed))
    assert isinstance(found, str)
    assert re.search(why, found)


def test_a_field_of_an_unknown_type_is_named_where_it_is_needed():
    layout = [("x", "f4", 0), ("y", "odd", 4), ("z", "f4", 8)]
    assert read(cloud(layout, 12, {"x": [1.0], "z": [1.0]})) == "unknown datatype of field y"
