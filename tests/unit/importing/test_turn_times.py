"""Times of points from the order of a turn, where the recording has none."""

import numpy as np
import pytest

from model_training.importing.deskew import deskewed
from model_training.importing.recording import RecordedScan, Unusable
from model_training.importing.turn_times import turned_at, with_turn_times
from service.errors import DatasetError


def turn(*, first_deg=30.0, direction=-1, turns=1.0, count=720, spread_deg=0.0):
    """Return a scan in the order of measurement. Two beams of a firing look ``spread_deg`` apart."""
    azimuth = np.deg2rad(first_deg) + direction * 2 * np.pi * turns * np.arange(count) / count
    azimuth += np.deg2rad(spread_deg) * (np.arange(count) % 2)
    return np.stack([10 * np.cos(azimuth), 10 * np.sin(azimuth), np.zeros(count), np.ones(count)], 1).astype(np.float32)


def turns_of(points):
    found = turned_at(points)
    assert not isinstance(found, str)
    return found


@pytest.mark.parametrize("direction", [-1, 1])
@pytest.mark.parametrize("first_deg", [0.0, 30.0, 179.9, -135.0])
def test_the_order_of_the_points_gives_begin_and_direction_of_the_turn(direction, first_deg):
    found = turns_of(turn(first_deg=first_deg, direction=direction))
    np.testing.assert_allclose(found, np.arange(720) / 720, atol=1e-6)


def test_beams_of_one_firing_that_look_apart_are_measured_together():
    """Eight degrees apart are 0.022 turns, also where the turn begins and ends."""
    found = turns_of(turn(spread_deg=8.0, direction=1))
    np.testing.assert_allclose(found, np.arange(720) / 720 + 8 / 360 * (np.arange(720) % 2), atol=1e-6)


def test_points_without_a_direction_do_not_matter():
    points = turn()
    points[::7] = np.nan
    points[1::7, :3] = 0
    found = turns_of(points)
    known = np.arange(720) % 7 > 1
    np.testing.assert_allclose(np.diff(found[known]), np.diff(np.arange(720)[known]) / 720, atol=1e-6)
    assert not found[~known].any()


def rows(count=16):
    """Return the rings of a turn one after another, as KITTI's files and organised clouds have them."""
    return np.concatenate([turn(count=360)] * count)


@pytest.mark.parametrize(
    "points",
    [
        rows(),
        turn(turns=0.4),
        turn(turns=1.3),
        np.concatenate([turn(turns=0.6), turn(turns=0.4, first_deg=30 - 216, direction=1)]),
        turn()[np.random.default_rng(2).permutation(720)],
    ],
    ids=["rings", "part of a turn", "more than a turn", "there and back", "mixed"],
)
def test_points_that_are_not_in_the_order_of_one_turn_have_no_times(points):
    assert turned_at(points) == "its points are not in the order of one turn, so they have no times by azimuth"


def test_a_scan_of_few_points_has_no_times():
    assert "fewer than 100 points" in turned_at(turn(count=99))


def scans(points, step_s=0.1, count=3, offsets_s=None):
    return [RecordedScan(f"scan {k}", 5 + step_s * k, points, offsets_s) for k in range(count)]


def timed(recording):
    """Return the scans of a recording that have times."""
    found = [event for event in recording.events() if isinstance(event, RecordedScan) and event.offsets_s is not None]
    assert found
    return found


@pytest.mark.parametrize(("stamp", "first_s"), [("begin", 0.0), ("middle", -0.05), ("end", -0.1)])
def test_the_stamp_is_the_named_moment_of_the_turn(recording_of, stamp, first_s):
    found = with_turn_times(recording_of(scans(turn(count=1000))), stamp, source="bag")
    assert found.turn_s == pytest.approx(0.1)
    for scan in timed(found):
        assert scan.offsets_s[0] == pytest.approx(first_s, abs=2e-4)
        np.testing.assert_allclose(np.diff(scan.offsets_s), 0.0001, atol=1e-7)
    assert found.notes.source == {"path": "list", "point_times": "azimuth", "turn_s": found.turn_s, "turn_stamp": stamp}
    assert f"a scan's stamp is the {stamp} of its turn" in found.notes.lines[-1]
    assert (found.kind, found.has_images, found.count(), found.georeference) == ("listed", True, 10, None)


def test_a_round_wall_seen_from_a_moving_vehicle_is_round_again(recording_of, straight):
    """At 10 m/s the vehicle drives 1 m in a turn; the wall has a radius of 20 m about the place of the stamp (the end)."""
    trajectory = straight(10.0, speed=10.0)
    share = np.arange(2000) / 2000
    azimuth = 1.0 - 2 * np.pi * share
    behind = (share - 1) * 1.0  # x of the vehicle before its stamp, metres
    ray = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
    b = behind * ray[:, 0]
    ranges = -b + np.sqrt(b**2 - behind**2 + 400)
    points = np.c_[ranges[:, None] * ray, np.zeros((2000, 2))].astype(np.float32)
    found = with_turn_times(recording_of(scans(points)), "end", source="bag")
    scan = timed(found)[0]
    assert np.abs(np.linalg.norm(points[:, :2], axis=1) - 20).max() > 0.8
    at_rest = deskewed(scan, trajectory, np.eye(4))
    assert np.abs(np.linalg.norm(at_rest[:, :2], axis=1) - 20).max() < 0.02


def test_a_later_scan_out_of_order_keeps_its_motion_and_is_counted(recording_of):
    given = [*scans(turn()), RecordedScan("odd", 5.3, rows(), None)]
    events = list(with_turn_times(recording_of(given), "end", source="bag").events())
    assert [type(event).__name__ for event in events] == ["RecordedScan"] * 3 + ["Unusable", "RecordedScan"]
    why = turned_at(rows())
    assert isinstance(why, str)
    assert events[3] == Unusable("de-skew", "odd", why)
    assert isinstance(events[4], RecordedScan)
    assert events[4].offsets_s is None


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (scans(turn(), offsets_s=np.zeros(720)), "the points of bag have times already; omit this option"),
        (
            scans(rows()),
            "scan 0: its points are not in the order of one turn.*record clouds with a time for each point",
        ),
        (scans(turn(), step_s=1.0), "the first scans of bag are not 0.04 to 0.25 s apart.*record every turn"),
        (scans(turn(), count=1), "the first scans of bag are not 0.04 to 0.25 s apart"),
        ([], "the first scans of bag are not 0.04 to 0.25 s apart"),
    ],
)
def test_scans_without_known_turns_are_refused(recording_of, given, why):
    with pytest.raises(DatasetError, match=f"--turn-stamp end: .*{why}"):
        with_turn_times(recording_of(given), "end", source="bag")
