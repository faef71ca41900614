"""``make bench-kitti ROOT=...``: measure place recognition on KITTI by two protocols -> reports/kitti.json.

Published protocol (R@1 within 10 m): every scan of a sequence is a place. The map leaves out only the scan of the
query's own moment, so scans a metre away remain. Held-out protocol: the same street on another day, and loops that
close more than a minute later.
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from benchmarks.kitti.protocol import (
    LOOP_S,
    OWN_SCAN_S,
    RIGHT_M,
    found_within,
    in_the_frame_of,
    place_similarities,
)
from benchmarks.kitti.published import NOTE, PUBLISHED_R1
from benchmarks.kitti.sources import LOOPS, OTHER_DAY, Drive, drives_below, left_out, missing
from benchmarks.report import ROOT, Report
from model_training.datasets.dataset import Dataset
from model_training.importing.kinds import OpenSettings, open_recording
from model_training.importing.take import TakeSettings, take
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.odometry.align_poses import usual_poses
from model_training.stock import ENCODER
from service.errors import StreetfixError
from service.maps.reader import MapBundle

QUERIES = "recorded"
EVERY_SCAN_M = 0.05  # small, so that every scan is a place unless the vehicle stands still


def main() -> None:
    """Find the traversals, measure each and write the report."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kitti", description=__doc__)
    parser.add_argument(
        "--root", type=Path, default=ROOT.parent / "shared" / "data", help="folder that contains KITTI's drives"
    )
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "kitti", help="folder of datasets and maps")
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="drives to measure, such as 00 or 2011_09_26_drive_0005"
    )
    arguments = parser.parse_args()
    if not arguments.root.is_dir():
        parser.error(
            f"--root: folder {arguments.root} not found; give the folder that contains KITTI's sequences or drives"
        )
    drives = drives_below(arguments.root)
    for line in missing(drives):
        print(f"missing: {line}", flush=True)
    if arguments.only:
        _require_known(parser, arguments.only, [drive.name for drive in drives])
    chosen = [drive for drive in drives if not arguments.only or drive.name in arguments.only]
    for line in left_out(drives, chosen):
        print(f"left out: {line}", flush=True)
    if not chosen:
        parser.error(
            f"--root: no drive to measure below {arguments.root}; found: {', '.join(d.name for d in drives) or 'none'}"
        )
    only = f" --only {' '.join(arguments.only)}" if arguments.only else ""
    report = Report("kitti", f"python -m benchmarks.kitti{only}")
    if arguments.only:
        report.keep_others()
    maps = dict[str, tuple[Dataset, MapBundle]]()
    for number, drive in enumerate(chosen, 1):
        print(f"--- {drive.name} ({number} of {len(chosen)})", flush=True)
        maps[drive.name] = _mapped(drive, arguments.root, arguments.work)
        _same_drive(report, drive.name, *maps[drive.name])
    for mapped, asked, shared in OTHER_DAY:
        if mapped in maps and asked in maps:
            _other_day(report, mapped, asked, shared, maps)
    report.notes["missing"] = missing(drives)
    report.notes["left_out"] = left_out(drives, chosen) or None
    report.notes[NOTE] = {name: list(row) for name, row in PUBLISHED_R1.items()}
    print(report.write())


def _require_known(parser: argparse.ArgumentParser, only: list[str], known: list[str]) -> None:
    """End the program if a name is that of no drive below the folder."""
    unknown = [name for name in only if name not in known]
    if unknown:
        parser.error(f"--only: no drive {', '.join(unknown)} below --root; choose among: {', '.join(known) or 'none'}")


def _mapped(drive: Drive, root: Path, work: Path) -> tuple[Dataset, MapBundle]:
    """Import a traversal with SGBM depth and map every scan as a place, or reuse an earlier result."""
    folder, bundle = work / f"{drive.name}_data", work / f"{drive.name}_map"
    if not (folder / "dataset.json").exists():
        source = drive.folder
        if drive.packed:
            raw = work / f"{drive.name}_raw"
            shutil.rmtree(raw, ignore_errors=True)
            subprocess.run([sys.executable, str(root / "unpack.py"), str(drive.folder), str(raw)], check=True)
            (source,) = raw.glob("*/*_sync")
        recording = open_recording(drive.kind, source, OpenSettings(depth="sgbm"))
        trajectory = recording.trajectory()
        if trajectory is None:
            raise SystemExit(f"{source} has no poses; put poses/{drive.name}.txt next to the sequences")
        folder.parent.mkdir(parents=True, exist_ok=True)
        poses, _ = usual_poses(recording, trajectory)
        take(recording, poses, folder, TakeSettings())
    dataset = Dataset(folder)
    if not bundle.exists():
        build_map(dataset, ENCODER, bundle, BuildSettings(name=drive.name, spacing_m=EVERY_SCAN_M), report=_told)
    return dataset, MapBundle.open(bundle)


def _told(stage: str, done: int, of: int) -> None:
    if done == of or done % 500 == 0:
        print(f"{stage}: {done} of {of}", flush=True)


def _when_and_where(dataset: Dataset, bundle: MapBundle) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return positions and times of queries and of places; a place has the time of its scan."""
    frames = [
        (frame.T_map_camera[:2, 3], frame.stamp_s)
        for frame in dataset.queries(QUERIES)
        if frame.T_map_camera is not None
    ]
    query_xy = np.array([xy for xy, _ in frames])
    query_s = np.array([stamp_s for _, stamp_s in frames], np.float64)
    stamps, poses = dataset.survey_trajectory()
    place_xy = np.array(bundle.T_map_place[:, :2, 3])
    # The map may have moved the survey's poses by centimetres. The nearest scan is the place's own.
    own = np.array([np.hypot(*(poses[:, :2, 3] - xy).T).argmin() for xy in place_xy])
    return query_xy, query_s, place_xy, stamps[own]


def _same_drive(report: Report, name: str, dataset: Dataset, bundle: MapBundle) -> None:
    similarity = place_similarities(bundle, dataset, QUERIES)
    query_xy, query_s, place_xy, place_s = _when_and_where(dataset, bundle)
    protocols = [("published", OWN_SCAN_S)] + ([("loops", LOOP_S)] if name in LOOPS else [])
    for protocol, left_out_s in protocols:
        right, asked = found_within(
            similarity, query_xy, place_xy, query_s=query_s, place_s=place_s, left_out_s=left_out_s
        )
        report.share(f"kitti.{protocol}.{name}.recall_at_1_{RIGHT_M:.0f}m", right[asked])


def _other_day(
    report: Report, mapped: str, asked: str, shared: str, maps: dict[str, tuple[Dataset, MapBundle]]
) -> None:
    """Add R@1 of one day's queries on another day's map; only queries with a place within 10 m count."""
    (own, bundle), (other, _) = maps[mapped], maps[asked]
    similarity = place_similarities(bundle, other, QUERIES)
    xyz = np.array([f.T_map_camera[:3, 3] for f in other.queries(QUERIES) if f.T_map_camera is not None])
    xy, times = in_the_frame_of(own, other, xyz)[:, :2], np.zeros(len(xyz))
    place_xy = np.array(bundle.T_map_place[:, :2, 3])
    right, counted = found_within(
        similarity, xy, place_xy, query_s=times, place_s=np.zeros(len(place_xy)), left_out_s=-1.0
    )
    print(f"{asked} on {mapped}: {shared}", flush=True)
    report.share(f"kitti.other_day.{mapped}.{asked}.recall_at_1_{RIGHT_M:.0f}m", right[counted])


if __name__ == "__main__":
    try:
        main()
    except StreetfixError as error:
        sys.exit(f"bench-kitti: {error}")
