"""``streetfix import``."""

from pathlib import Path
from typing import Annotated, Literal, cast

import typer
from rich.console import Console

from model_training.cli.import_options import SINGLE_FRAMES, kinds, refuse_options_of_images, refuse_unused
from model_training.cli.progress import Report, bars
from model_training.importing.extrinsics import read_camera, read_extrinsics
from model_training.importing.kinds import DepthFrom, OpenSettings, open_recording
from model_training.importing.kitti_object import import_kitti_object
from model_training.importing.map_origin import read_map_origin
from model_training.importing.pose_file import read_pose_file
from model_training.importing.recording import Recording
from model_training.importing.ros_topics import ROLES
from model_training.importing.take import TakeSettings, TakeSummary, take
from model_training.importing.trajectory import Sync, Trajectory
from model_training.importing.turn_times import STAMPS, with_turn_times
from model_training.odometry.align_poses import ALIGNED_KINDS, HOW_TO_ALIGN, usual_poses
from service.errors import DatasetError
from service.imaging.pca import USUAL_LIDAR_HEIGHT_M
from service.option_limits import LEAST_BASELINE_M, MOST_BASELINE_M

DEPTHS = ("recorded", "stored", "sgbm", "lidar")
_HELP = f"Format: {', '.join(kinds())}."


def command(
    kind: Annotated[str, typer.Argument(help=_HELP)],
    source: Annotated[Path, typer.Argument(help="File or folder of the recording.")],
    out: Annotated[Path, typer.Option(help="Folder of the dataset to write.")],
    depth: Annotated[
        str,
        typer.Option(
            help="Depth of an image: recorded or stored beside the image, sgbm from the stereo pair, or lidar from "
            "the scan nearest in time. For kitti-raw and kitti-odometry recorded means stored.  [default: recorded; "
            "kitti-object and kitti-360: sgbm]"
        ),
    ] = "",
    poses: Annotated[
        Path | None,
        typer.Option(help="TUM file (timestamp x y z qx qy qz qw). It replaces the recording's own poses."),
    ] = None,
    queries: Annotated[str | None, typer.Option(help="Query set for the images.  [default: recorded]")] = None,
    pictures: Annotated[bool | None, typer.Option(help="Import images.  [default: pictures]")] = None,
    hold_out: Annotated[
        int | None,
        typer.Option(
            help="Leave one scan in this many out of the survey. Only images near these scans become queries. "
            "0 leaves none out.  [default: 0]",
            min=0,
        ),
    ] = None,
    hold_out_first: Annotated[
        int | None,
        typer.Option(
            help="With --hold-out: the first scan left out, counted from 0.  [default: the last of each group]", min=0
        ),
    ] = None,
    sync: Annotated[
        str | None,
        typer.Option(help="Method for the pose of a frame: interpolate or nearest.  [default: interpolate]"),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Largest time from a frame to its pose or scan, seconds.  [default: 0.1]", min=0),
    ] = None,
    topic: Annotated[
        list[str] | None,
        typer.Option(
            help=f"Topic of a bag, ROLE=NAME. Roles: {', '.join(ROLES)}. Repeat for several.  [default: guessed; right_info only with "
            "--depth sgbm]"
        ),
    ] = None,
    extrinsics: Annotated[
        Path | None,
        typer.Option(help="JSON file with T_vehicle_lidar and T_vehicle_camera, if the recording lacks them."),
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help="JSON file with width, height, fx, fy, cx and cy, if the recording lacks them. distortion and "
            "distortion_model describe a lens, as in a request.",
        ),
    ] = None,
    baseline_m: Annotated[
        float | None,
        typer.Option(
            help="Baseline of the stereo rig that measured the recorded depth, metres: the distance of its cameras. rosbag takes it from "
            "--topic right_info=NAME too, the CameraInfo of the rectified right camera. --depth sgbm of a rosbag uses it for matching. "
            "`evaluate` and `calibrate` then send the baseline.",
            min=LEAST_BASELINE_M,
            max=MOST_BASELINE_M,
        ),
    ] = None,
    align: Annotated[
        bool | None,
        typer.Option(
            help="Correct the recording's poses step by step by scan matching. The whole trajectory stays in place. "
            "Needs gtsam and small_gicp, which the extra mapping installs. Without them, the default keeps the recording's "
            "poses and says so.  "
            f"[default: on for {', '.join(sorted(ALIGNED_KINDS))} without --poses]"
        ),
    ] = None,
    odometry: Annotated[
        bool,
        typer.Option(
            "--odometry",
            help="Find the poses by LiDAR odometry. The command ignores the recording's own poses. Needs the extra odometry.",
        ),
    ] = False,
    loops: Annotated[
        bool | None,
        typer.Option(help="With --odometry: close loops at places that the vehicle visits again.  [default: loops]"),
    ] = None,
    lidar_height: Annotated[
        float | None,
        typer.Option(
            help="With --odometry: approximate height of the LiDAR above the ground, metres.  "
            f"[default: {USUAL_LIDAR_HEIGHT_M:g}]",
            min=0.1,
        ),
    ] = None,
    georeference: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON[,HEIGHT[,HEADING]]",
            help="WGS-84 position of the origin of the poses: degrees, degrees, metres above the ellipsoid. HEADING is the direction of "
            "their x axis, degrees counter-clockwise from east. Streets in WGS-84 (`streets osm`) and GeoPose answers need it. kitti-raw "
            "has a georeference of its own.",
        ),
    ] = None,
    rectified: Annotated[
        bool | None,
        typer.Option(help="The images of a bag are rectified already.  [default: if the topic's name says so]"),
    ] = None,
    deskew: Annotated[
        bool | None,
        typer.Option(
            help="Remove the vehicle's motion from scans with point times. For kitti-raw and kitti-360 the azimuth "
            "gives the times.  [default: deskew]"
        ),
    ] = None,
    turn_stamp: Annotated[
        str | None,
        typer.Option(
            help="For a spinning LiDAR whose points have no times: the moment of the turn that the stamp of a scan means, begin, middle or "
            "end. The order of the points then gives their times, and the scans are de-skewed. For rosbag and clouds. The driver's manual "
            "tells the moment.  [default: no times]"
        ),
    ] = None,
    vertical_correction: Annotated[
        bool | None,
        typer.Option(
            help="Rotate KITTI's points up by 0.205 degrees, the error of its HDL-64.  [default: on for kitti-raw and "
            "kitti-odometry]"
        ),
    ] = None,
) -> None:
    """Import a recording into a dataset folder.

    The command leaves out unusable frames. It counts them by reason. It refuses an option that the format does not use.

    \b
    Example:
      streetfix import kitti-raw 2011_09_26_drive_0005_sync --depth sgbm --out data/drive
      streetfix import rosbag drive.mcap --topic scan=/ouster/points --out data/drive
      streetfix import rosbag drive.mcap --topic right_info=/stereo/right/camera_info --out data/drive
      streetfix import rosbag stereo.mcap --depth sgbm --out data/drive
      streetfix import rosbag drive.mcap --turn-stamp end --out data/drive
      streetfix import clouds scans/ --odometry --out data/site
      streetfix import rosbag drive.mcap --georeference 48.98,8.44,110,90 --out data/town
      streetfix import kitti-object KITTI --depth sgbm --out data/kitti
    """
    if depth and depth not in DEPTHS:
        raise DatasetError(f"depth: {depth!r} is not valid; choose one of: {', '.join(DEPTHS)}", field="depth")
    given: dict[str, object] = {
        "depth": depth or None,
        "poses": poses,
        "queries": queries,
        "pictures": pictures,
        "hold-out": hold_out,
        "hold-out-first": hold_out_first,
        "sync": sync,
        "tolerance": tolerance,
        "topic": topic,
        "extrinsics": extrinsics,
        "camera": camera,
        "baseline-m": baseline_m,
        "align": align,
        "odometry": odometry or None,
        "loops": loops,
        "lidar-height": lidar_height,
        "georeference": georeference,
        "rectified": rectified,
        "deskew": deskew,
        "turn-stamp": turn_stamp,
        "vertical-correction": vertical_correction,
    }
    refuse_unused(kind, given)
    if kind == SINGLE_FRAMES:
        _single_frames(source, out, depth or "sgbm")
        return
    if sync not in (None, "interpolate", "nearest"):
        raise DatasetError(f"sync: {sync!r} is not valid; choose interpolate or nearest", field="sync")
    if turn_stamp is not None and turn_stamp not in STAMPS:
        raise DatasetError(
            f"turn-stamp: {turn_stamp!r} is not valid; choose one of: {', '.join(STAMPS)}", field="turn-stamp"
        )
    with_pictures = pictures is not False
    map_origin = None if georeference is None else read_map_origin(georeference)
    settings = TakeSettings(
        queries=(queries or "recorded") if with_pictures else "",
        depth="lidar" if depth == "lidar" else "recorded",
        sync=cast(Sync, sync or "interpolate"),
        tolerance_s=0.1 if tolerance is None else tolerance,
        deskew=deskew is not False,
        hold_out=hold_out or 0,
        hold_out_first=hold_out_first,
        georeference=None if map_origin is None else map_origin.georeference(),
        own_frame=not odometry,
    )
    open_settings = OpenSettings(
        depth=cast(DepthFrom, depth or "recorded"),
        topics=_topics(topic or []),
        rectified=rectified,
        camera=None if camera is None else read_camera(camera),
        extrinsics=None if extrinsics is None else read_extrinsics(extrinsics),
        poses=poses,
        pictures=with_pictures,
        vertical_correction=vertical_correction,
        baseline_m=baseline_m,
    )
    if odometry and poses is not None:
        raise DatasetError(
            "poses: --odometry finds the poses, so --poses has no effect; give one of the two", field="poses"
        )
    if odometry and align is not None:
        raise DatasetError("align: --odometry finds poses from the scans alone; give one of the two", field="align")
    recording = open_recording(kind, source, open_settings)
    if turn_stamp is not None:
        recording = with_turn_times(recording, turn_stamp, source=str(source))
    is_placed = recording.georeference is not None
    if is_placed and map_origin is not None and poses is None and not odometry:
        raise DatasetError(
            f"--georeference {georeference}: the recording has a georeference of its own poses; omit this option",
            field="georeference",
        )
    if not recording.has_images:
        refuse_options_of_images(source, given)
    console = Console()
    for line in (*recording.notes.lines, *(recording.notes.picture_lines if with_pictures else ())):
        console.print(line, soft_wrap=True)
    if not odometry:
        trajectory = _trajectory(recording, source, poses)
    with bars() as report:
        told_of_poses: str | None
        if odometry:
            height_m = USUAL_LIDAR_HEIGHT_M if lidar_height is None else lidar_height
            trajectory, told_of_poses = _by_odometry(recording, loops is not False, height_m, report)
        else:
            of_file = poses is not None and align is None
            trajectory, told_of_poses = usual_poses(
                recording, trajectory, align=False if of_file else align, report=report
            )
            told_of_poses = f"poses are those of {poses}; {HOW_TO_ALIGN}" if of_file else told_of_poses
    if told_of_poses:
        console.print(told_of_poses, soft_wrap=True)
    if is_placed and map_origin is None and odometry:
        console.print(
            "the recording's georeference does not hold for poses by odometry; give that of the first scan with --georeference",
            soft_wrap=True,
        )
    if map_origin is not None:
        trajectory = map_origin.turned(trajectory)
    with bars() as report:
        summary = take(recording, trajectory, out, settings, report=report)
    _print_summary(console, out, summary, deskew=settings.deskew)


def _topics(pairs: list[str]) -> dict[str, str]:
    topics = {}
    for text in pairs:
        role, equals, name = text.partition("=")
        if not equals or not name:
            raise DatasetError(f"topic: {text!r} is not ROLE=NAME, such as scan=/points", field="topic")
        topics[role] = name
    return topics


def _trajectory(recording: Recording, source: Path, poses: Path | None) -> Trajectory:
    trajectory = read_pose_file(poses) if poses is not None else recording.trajectory()
    if trajectory is None:
        raise DatasetError(
            f"{source}: the recording has no poses; give a TUM file with --poses, or find them with --odometry",
            field="poses",
        )
    return trajectory


def _by_odometry(
    recording: Recording, close_loops: bool, lidar_height: float, report: Report
) -> tuple[Trajectory, str]:
    """Return the trajectory and a line that describes it."""
    from model_training.odometry.find import find_trajectory

    found = find_trajectory(recording, close_loops=close_loops, expected_height_m=lidar_height, report=report)
    before, after = found.disagreement_m
    line = "poses by odometry, "
    line += (
        f"{found.loops} loops closed: error at the loops {before:.2f} m before, {after:.2f} m after"
        if found.loops
        else "no loop found"
    )
    return found.trajectory, line


def _single_frames(source: Path, out: Path, depth: str) -> None:
    if depth not in ("stored", "sgbm"):
        raise DatasetError(f"depth: {depth!r} is not valid; choose stored or sgbm", field="depth")
    with bars() as report:
        summary = import_kitti_object(
            source,
            out,
            depth=cast(Literal["stored", "sgbm"], depth),
            progress=lambda done, total: report("frames", done, total),
        )
    console = Console()
    console.print(f"{out}: {summary.places} places, query sets: frames {summary.frames}, elsewhere {summary.elsewhere}")
    if summary.skipped:
        console.print(f"left out because they have no depth: {', '.join(summary.skipped)}")


def _print_summary(console: Console, out: Path, summary: TakeSummary, *, deskew: bool) -> None:
    held = f" ({summary.held_out} held out)" if summary.held_out else ""
    console.print(f"{out}: {summary.scans} scans{held}, {summary.pictures} image pairs", soft_wrap=True)
    text = f"corrected for the vehicle's motion: {summary.deskewed} of {summary.scans + summary.held_out} scans"
    why = ""
    if not deskew:
        why = ", because --no-deskew was given"
    elif not summary.deskewed:
        why = (
            ", because their points have no usable times; unless they are corrected already, record clouds with a time for each point, or "
            "correct them before the import; --turn-stamp gives times to the clouds of a spinning LiDAR (rosbag, clouds)"
        )
    console.print(text + why, soft_wrap=True)
    if summary.points_without_numbers:
        console.print(f"left out: {summary.points_without_numbers} points that are not finite")
    for line in summary.dropped:
        console.print(f"left out: {line}", soft_wrap=True)
