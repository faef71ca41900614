from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.bridge.pairs import Pair, Pairs, nanoseconds_of
from service.errors import RequestError

MS = 10**6
PICTURE = np.zeros((1, 1), np.uint8)
Image = Callable[..., Any]


def filled(image_of: Image, info_of: Image, *, colors: Any, depths: Any, infos: Any = (0,), **how: Any) -> Pairs:
    """Fill the queues; stamps are in milliseconds."""
    pairs = Pairs(**how)
    for at in infos:
        pairs.info(info_of(at * MS))
    for at in colors:
        pairs.color(image_of(PICTURE, "mono8", at * MS))
    for at in depths:
        pairs.depth(image_of(PICTURE, "mono8", at * MS))
    return pairs


def stamps(pair: Pair | None) -> tuple[int, int, int] | None:
    """Return the stamps of colour, depth and calibration, milliseconds."""
    if pair is None:
        return None
    color, depth, info = (nanoseconds_of(each) // MS for each in (pair.color, pair.depth, pair.info))
    return color, depth, info


def test_a_stamp_is_its_seconds_and_nanoseconds(info_of: Image) -> None:
    assert nanoseconds_of(info_of(3_000_000_007)) == 3_000_000_007


def test_the_nearest_stamps_belong_together(image_of: Image, info_of: Image) -> None:
    pairs = filled(image_of, info_of, colors=(100, 133), depths=(102, 131))
    assert stamps(pairs.oldest()) == (100, 102, 0)
    assert stamps(pairs.oldest()) == (133, 131, 0)
    assert pairs.oldest() is None
    assert pairs.dropped == 0


def test_the_newest_drops_what_is_older(image_of: Image, info_of: Image) -> None:
    pairs = filled(image_of, info_of, colors=(100, 133, 166), depths=(100, 133))
    assert stamps(pairs.newest()) == (133, 133, 0)
    assert pairs.dropped == 2
    pairs.depth(image_of(PICTURE, "mono8", 166 * MS))
    assert stamps(pairs.newest()) == (166, 166, 0)


@pytest.mark.parametrize(("apart", "belong"), [(20, True), (21, False)])
def test_the_tolerance_is_the_last_that_belongs(image_of: Image, info_of: Image, apart: int, belong: bool) -> None:
    pairs = filled(image_of, info_of, colors=(100,), depths=(100 + apart,), tolerance_s=0.02)
    assert (pairs.oldest() is not None) == belong


def test_a_depth_picture_goes_to_the_colour_that_is_nearer(image_of: Image, info_of: Image) -> None:
    pairs = filled(image_of, info_of, colors=(100, 110), depths=(108,))
    assert stamps(pairs.oldest()) == (110, 108, 0)


def test_nothing_is_whole_without_a_calibration(image_of: Image, info_of: Image) -> None:
    pairs = filled(image_of, info_of, colors=(100,), depths=(100,), infos=())
    assert pairs.oldest() is None
    assert pairs.missing() == ("info",)
    pairs.info(info_of(0))
    assert pairs.oldest() is not None


def test_a_calibration_holds_and_the_nearest_is_taken(image_of: Image, info_of: Image) -> None:
    pairs = filled(image_of, info_of, colors=(100, 200), depths=(100, 200), infos=(90, 210))
    assert [stamps(pairs.oldest()), stamps(pairs.oldest())] == [(100, 100, 90), (200, 200, 210)]


def test_buffers_are_bounded_and_count_what_they_drop(image_of: Image, info_of: Image) -> None:
    pairs = filled(image_of, info_of, colors=range(0, 1000, 100), depths=(), infos=range(50), most=3)
    assert pairs.dropped == 7
    pairs.depth(image_of(PICTURE, "mono8", 900 * MS))
    assert stamps(pairs.oldest()) == (900, 900, 49)
    assert pairs.missing() == ("color", "depth")


def test_a_stamp_that_comes_twice_is_one_picture(image_of: Image, info_of: Image) -> None:
    pairs = filled(image_of, info_of, colors=(5, 5), depths=(5,))
    assert (stamps(pairs.oldest()), pairs.dropped, pairs.oldest()) == ((5, 5, 0), 1, None)


@given(arrivals=st.lists(st.tuples(st.booleans(), st.integers(0, 50)), max_size=60))
def test_every_picture_is_waiting_used_or_dropped(
    image_of: Image, info_of: Image, arrivals: list[tuple[bool, int]]
) -> None:
    pairs, used = Pairs(tolerance_s=0.002, most=4), 0
    pairs.info(info_of())
    for is_color, at in arrivals:
        (pairs.color if is_color else pairs.depth)(image_of(PICTURE, "mono8", at * MS))
        if at % 3 == 0 and (pair := pairs.oldest()) is not None:
            used += 2
            assert abs(nanoseconds_of(pair.color) - nanoseconds_of(pair.depth)) <= 2 * MS
    assert pairs.waiting <= 8
    assert used + pairs.dropped + pairs.waiting == len(arrivals)


@pytest.mark.parametrize(
    ("wrong", "name"),
    [({"tolerance_s": -1.0}, "tolerance"), ({"tolerance_s": float("nan")}, "tolerance"), ({"most": 0}, "queue")],
)
def test_an_unknown_setting_is_refused(wrong: dict[str, Any], name: str) -> None:
    with pytest.raises(RequestError, match=f"^{name}: "):
        Pairs(**wrong)
