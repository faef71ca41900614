import numpy as np
import pytest

from service.doctor.registered import check_registered, depth_edges, edge_shift

#: Boxes before a wall: left, top, width, height, pixels of an image of 320 x 240; depth, metres.
BOXES = ((40, 60, 30, 50, 4.0), (110, 100, 45, 70, 6.0), (190, 50, 25, 90, 3.0), (250, 130, 35, 60, 5.0))


def scene(right_px=0, down_px=0):
    """Return boxes in front of a wall 12 m away, in another colour. The depth may be shifted against the colour."""
    rgb, depth_m = np.full((240, 320, 3), 90, np.uint8), np.full((240, 320), 12.0, np.float32)
    for number, (u, v, wide, high, z) in enumerate(BOXES):
        rgb[v : v + high, u : u + wide] = 150 + 20 * number
        depth_m[v + down_px : v + down_px + high, u + right_px : u + right_px + wide] = z
    return rgb, depth_m


def test_a_step_in_depth_is_an_edge_of_the_pixel_between():
    row = np.array([[4, 4, 4, 6, 6, 0, 12]], np.float32)
    # From 4 to 6 m is more than a fifth. A hole of one pixel between 6 and 12 m is an edge, a pixel beside a hole is none.
    assert depth_edges(np.repeat(row, 3, axis=0))[1].tolist() == [False, False, True, True, False, True, False]


def test_a_small_step_and_a_far_one_are_no_edges():
    for row in ([10, 10, 11.9, 11.9], [26, 26, 40, 40]):
        assert not depth_edges(np.array([row] * 3, np.float32)).any()


def test_registered_depth_is_ok():
    found = check_registered(*scene())
    assert (found.level, found.text) == (
        "ok",
        "100% of the depth edges lie on colour edges; no shift is clearly better",
    )


@pytest.mark.parametrize(
    ("right_px", "down_px", "where"), [(10, 0, "10 px left"), (-12, 0, "12 px right"), (9, 6, "9 px left and 6 px up")]
)
def test_depth_beside_the_colour_is_a_warning_that_says_how_far(right_px, down_px, where):
    found = check_registered(*scene(right_px, down_px))
    assert found.level == "warning"
    shift = edge_shift(*scene(right_px, down_px))
    assert shift is not None
    # An edge counts up to one pixel away, and the first of several best shifts is taken.
    assert (shift.across_px, shift.down_px) == (pytest.approx(-right_px, abs=2), pytest.approx(-down_px, abs=2))
    assert shift.shifted > 0.95
    assert f"{shift.across_px:+.0f}"[1:] + " px " + ("right" if right_px < 0 else "left") in found.text


def test_the_shift_is_in_pixels_of_the_colour_image():
    """The image has 640 columns, and the check compares at 320."""
    rgb, depth_m = scene(10, 0)
    shift = edge_shift(rgb.repeat(2, axis=0).repeat(2, axis=1), depth_m)
    assert shift is not None
    assert shift.across_px == pytest.approx(-20, abs=4)


def test_depth_without_edges_is_not_compared():
    found = check_registered(np.zeros((240, 320, 3), np.uint8), np.full((240, 320), 5.0, np.float32))
    assert (found.level, found.text) == ("ok", "not compared: the depth image has too few edges")


def test_colour_without_edges_suggests_no_shift():
    _, depth_m = scene()
    assert check_registered(np.full((240, 320, 3), 90, np.uint8), depth_m).level == "ok"
