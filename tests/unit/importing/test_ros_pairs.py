from model_training.importing.ros_pairs import MOST_WAITING, Pair, Pairing, UnpairedImage


def paired(given, tolerance_s=0.02):
    pairing = Pairing(tolerance_s)
    found = [each for role, stamp_s in given for each in pairing.add(role, stamp_s, f"{role} {stamp_s}")]
    return [*found, *pairing.finish()]


def test_each_colour_gets_the_nearest_depth_whichever_came_first():
    given = [
        ("color", 0.0),
        ("partner", 0.004),
        ("partner", 0.101),
        ("color", 0.1),
        ("partner", 0.19),
        ("color", 0.2),
        ("partner", 0.207),
    ]
    pairs = [(pair.color, pair.partner) for pair in paired(given)]
    assert pairs == [("color 0.0", "partner 0.004"), ("color 0.1", "partner 0.101"), ("color 0.2", "partner 0.207")]


def test_a_colour_without_depth_in_time_is_alone_and_the_next_is_not():
    found = paired([("color", 0.0), ("color", 0.1), ("partner", 0.1)])
    assert found == [UnpairedImage(0.0, "color"), Pair(0.1, "color 0.1", "partner 0.1")]


def test_the_tolerance_itself_is_near_enough():
    assert isinstance(paired([("color", 0.0), ("partner", 0.5)], tolerance_s=0.5)[0], Pair)
    assert isinstance(paired([("color", 0.0), ("partner", 0.5)], tolerance_s=0.49)[0], UnpairedImage)


def test_colours_at_the_end_are_settled_with_what_there_is():
    assert paired([("partner", 1.0), ("color", 1.01), ("color", 2.0)]) == [
        Pair(1.01, "color 1.01", "partner 1.0"),
        UnpairedImage(2.0, "color"),
    ]


def test_a_depth_that_never_comes_lets_no_more_wait_than_the_limit():
    pairing = Pairing(0.02)
    alone = [each for k in range(500) for each in pairing.add("color", 0.1 * k, None)]
    assert len(alone) == 500 - MOST_WAITING
    assert all(isinstance(each, UnpairedImage) for each in alone)


def test_depth_without_colour_does_not_pile_up():
    pairing = Pairing(0.02)
    for k in range(500):
        assert not list(pairing.add("partner", 0.1 * k, None))
    assert list(pairing.add("color", 0.0, None)) == [UnpairedImage(0.0, "color")]
