"""Robots that are followed over their frames: in the map, outside of it, carried away, and between look-alikes."""

import numpy as np

from benchmarks.carried_tracks import EQUAL_M, carried, equal
from benchmarks.plans import SEQUENCE, TRACK_FRAMES, TRACK_STEP_M, other_track_plan, repeating_plan, track_plan
from benchmarks.report import Report
from benchmarks.runs import Runs
from benchmarks.sequences import far_from_landmarks
from model_training.cli.progress import bars
from model_training.evaluation.tracks import Step, Tracks, displaced, drives_of, followed
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.maps.reader import MapBundle

#: Number of frames before a robot is carried away.
BEFORE = 4


def track_rows(report: Report, runs: Runs) -> None:
    """Add rows ``filter.*``: answers of tracks, frames until a displacement is noticed, and wrong answers between look-alikes.

    Rows ``filter.carried.*`` follow the robots of ``filter.in_map`` with a track that the client carries.

    Args:
        report: collects the rows.
        runs: simulates and builds, or reuses what is kept on disk.
    """
    dataset = runs.dataset(track_plan())
    own, other = runs.bundle(dataset), runs.bundle(runs.dataset(other_track_plan()))
    drives = [drive for name in dataset.query_sets(with_truth=True) for drive in drives_of(dataset, name, TRACK_FRAMES)]
    at_home = _followed(own, drives)
    report.share("filter.in_map.first_frame", at_home.right(RIGHT_M)[:, 0])
    report.share("filter.in_map.last_frame", at_home.right(RIGHT_M)[:, -1])
    report.share("filter.in_map.wrong_and_accepted", at_home.wrong(RIGHT_M).ravel(), better="lower")
    report.share("filter.in_map.disrupted", at_home.epoch[:, -1] > 0, better="lower")
    report.row("filter.in_map.frames", float(at_home.frames.mean()), "frames", better="lower", n=at_home.frames.size)
    _carried_rows(report, own, drives, at_home)
    outside = _followed(other, drives)
    report.share("filter.outside.accepted", outside.accepted.ravel(), better="lower")
    _displaced_rows(report, _followed(own, displaced(drives, BEFORE, step_m=TRACK_STEP_M)))
    repeating = runs.dataset(repeating_plan())
    alike = [drive for name in repeating.query_sets(with_truth=True) for drive in drives_of(repeating, name, SEQUENCE)]
    last = np.array([drive[-1].frame.T_map_camera for drive in alike])
    between = [drive for drive, is_far in zip(alike, far_from_landmarks(last), strict=True) if is_far]
    found = _followed(runs.bundle(repeating), between)
    report.share("filter.no_landmark.wrong_and_accepted", found.wrong(RIGHT_M).ravel(), bar=0.005, better="lower")


def _carried_rows(report: Report, bundle: MapBundle, drives: list[list[Step]], held: Tracks) -> None:
    """Add the rows of the same robots with a track that the client carries, and compare them with the track that the service holds.

    The service registers up to five frames together. The bytes have no images, so there each frame is registered alone.
    """
    with bars() as progress:
        found = carried(Localizer.open(bundle), drives, progress)
    tracks = found.tracks
    report.share("filter.carried.last_frame", tracks.right(RIGHT_M)[:, -1])
    report.share("filter.carried.wrong_and_accepted", tracks.wrong(RIGHT_M).ravel(), better="lower")
    report.share(
        "filter.carried.equal_answers",
        equal(tracks, held).ravel(),
        why=f"status, epoch and error (within {1e3 * EQUAL_M:g} mm) as in filter.in_map, where the service holds the track",
    )
    report.share(
        "filter.carried.equal_answers_alone",
        equal(tracks, held)[held.frames == 1],
        why="the same for answers that register no earlier frame in filter.in_map",
    )
    report.share("filter.carried.equal_status", (tracks.accepted == held.accepted).ravel())
    report.row("filter.carried.largest_bytes", float(found.sizes.max()), "bytes", better="lower", n=found.sizes.size)
    report.row(
        "filter.carried.median_bytes", float(np.median(found.sizes)), "bytes", better="lower", n=found.sizes.size
    )


def _displaced_rows(report: Report, found: Tracks) -> None:
    """Add the rows of robots that were LOCALIZED rightly before they were carried away."""
    placed = found.right(RIGHT_M)[:, BEFORE - 1]
    after, wrong = found.epoch[placed, BEFORE:] > found.epoch[placed, BEFORE - 1 : BEFORE], found.wrong(RIGHT_M)
    noticed = np.where(after.any(axis=1), after.argmax(axis=1) + 1, after.shape[1] + 1)
    report.row(
        "filter.kidnapped.noticed_frames",
        float(np.median(noticed)) if len(noticed) else None,
        "frames",
        bar=3,
        better="lower",
        n=len(noticed),
        why="the median; filter.kidnapped.noticed_within_3 is the share of robots within three frames"
        if len(noticed)
        else "no robot was LOCALIZED before it was carried away",
    )
    report.share("filter.kidnapped.noticed_within_3", noticed <= 3)
    report.share("filter.kidnapped.wrong_and_accepted", wrong[placed, BEFORE:].ravel(), better="lower")
    report.share("filter.kidnapped.last_frame", found.right(RIGHT_M)[placed, -1])


def _followed(bundle: MapBundle, drives: list[list[Step]]) -> Tracks:
    with bars() as report:
        return followed(Localizer.open(bundle), drives, report)
