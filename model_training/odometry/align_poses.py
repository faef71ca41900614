"""Correct the poses of a recording with its scans: scan matching gives the steps, the recording gives the overall position.

Poses of GNSS and inertial sensors err by decimetres between houses, differently every few dozen metres.
On KITTI drive 0005 a step of 2.3 m errs by up to 0.26 m.
A map from such poses is blurred, and they are a wrong reference for measurements.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model_training.importing.deskew import deskewed
from model_training.importing.recording import Recording
from model_training.importing.take import scans_of
from model_training.importing.trajectory import Trajectory
from model_training.odometry.pose_graph import held_near
from model_training.odometry.scan_to_map import FineMap
from service.errors import ExtraMissingError, how_to_install
from service.geometry.rigid import inverse

Report = Callable[[str, int, int], None]
#: Formats whose own poses come from GNSS and inertial sensors. These are aligned by default.
ALIGNED_KINDS = frozenset({"kitti-raw"})
#: Formats whose poses come from a simulator. They have no errors to correct.
_EXACT_KINDS = frozenset({"carla"})
#: What to say about poses that are not aligned.
HOW_TO_ALIGN = "if they err by decimetres, --align corrects them with the scans (--no-align hides this line)"
#: Greatest time between a scan and the given poses, seconds. A scan beyond it has no initial guess and is left out.
TOLERANCE_S = 0.1


@dataclass(frozen=True, slots=True)
class AlignedPoses:
    """Corrected poses.

    Attributes:
        trajectory: T_map_vehicle at the times of the given poses and of the scans.
        scans: number of matched scans.
        step_m: median change of a step from scan to scan, metres.
        most_step_m: greatest change of a step, metres.
    """

    trajectory: Trajectory
    scans: int
    step_m: float
    most_step_m: float


def aligned_with_scans(
    recording: Recording, trajectory: Trajectory, *, report: Report = lambda *_: None
) -> AlignedPoses | None:
    """Match each scan to the scans before it, starting at the given poses, and fuse both in a pose graph.

    Between scans the given poses keep their own motion: only the correction is interpolated, in the vehicle frame.

    Args:
        recording: with scans.
        trajectory: T_map_vehicle, as the recording gives it.
        report: called with the stage, the scans done and all scans.

    Returns:
        The corrected poses; None if fewer than two scans have a pose.

    Raises:
        ExtraMissingError: small_gicp or gtsam is not installed.
    """
    try:
        import gtsam  # noqa: F401  # fails before the work, not after it
        import small_gicp  # noqa: F401
    except ModuleNotFoundError as error:
        raise ExtraMissingError(
            f"aligning poses needs {error.name}: {how_to_install('mapping')}, or import with --no-align",
            field="align",
        ) from error
    mounted = recording.lidar.T_vehicle_sensor
    T_vehicle_lidar = np.eye(4) if mounted is None else np.array(mounted, np.float64)
    stamps, given, found = [], [], []
    matched, total, done = FineMap(), recording.count(), 0
    for done, scan in enumerate(scans_of(recording), 1):
        T = trajectory.at(scan.stamp_s, sync="interpolate", tolerance_s=TOLERANCE_S)
        if not isinstance(T, str):
            points = deskewed(scan, trajectory, T_vehicle_lidar)
            stamps.append(scan.stamp_s)
            given.append(T @ T_vehicle_lidar)
            found.append(matched.aligned(points[:, :3].astype(np.float64), given[-1]))
        report("poses", done, max(done + 1, total))
    report("poses", max(1, done), max(1, done))
    if len(stamps) < 2:
        return None
    T_map_given, T_map_found = np.stack(given), np.stack(found)
    mended = held_near(T_map_found, T_map_given)
    corrections = Trajectory(
        np.array(stamps),
        inverse_of(T_map_given @ inverse(T_vehicle_lidar)) @ mended @ inverse(T_vehicle_lidar),
        "corrections",
    )
    times = np.union1d(trajectory.stamps_s, corrections.stamps_s)
    times = times[(times >= trajectory.stamps_s[0]) & (times <= trajectory.stamps_s[-1])]
    poses = trajectory.between(times) @ corrections.between(times)
    changed = [
        float(np.linalg.norm((inverse(a) @ b)[:3, 3] - (inverse(c) @ d)[:3, 3]))
        for a, b, c, d in zip(mended[:-1], mended[1:], T_map_given[:-1], T_map_given[1:], strict=True)
    ]
    name = f"{trajectory.name}, aligned with {len(stamps)} scans"
    return AlignedPoses(Trajectory(times, poses, name), len(stamps), float(np.median(changed)), max(changed))


def inverse_of(transforms: np.ndarray) -> np.ndarray:
    """Invert transforms.

    Args:
        transforms: rigid transforms (N, 4, 4).

    Returns:
        Their inverses (N, 4, 4).
    """
    return np.stack([inverse(T) for T in transforms])


def usual_poses(
    recording: Recording, trajectory: Trajectory, *, align: bool | None = None, report: Report = lambda *_: None
) -> tuple[Trajectory, str | None]:
    """Return the poses that an import uses by default, and a line about them for people.

    Args:
        recording: opened.
        trajectory: the recording's own poses, T_map_vehicle.
        align: align the poses with the scans. None does so for ``ALIGNED_KINDS`` if the packages are installed.
        report: called with the stage, the scans done and all scans.

    Returns:
        T_map_vehicle, and the line; None without a line if ``align`` is False, or if the poses come from a simulator.

    Raises:
        ExtraMissingError: ``align`` is True, and a package is not installed.
    """
    if align is False or (align is None and recording.kind in _EXACT_KINDS):
        return trajectory, None
    if align is None and recording.kind not in ALIGNED_KINDS:
        return trajectory, f"poses are the recording's own; {HOW_TO_ALIGN}"
    try:
        found = aligned_with_scans(recording, trajectory, report=report)
    except ExtraMissingError as missing:
        if align:
            raise
        return trajectory, f"--align is off: poses are the recording's own, which may be off by decimetres: {missing}"
    if found is None:
        return trajectory, "poses are the recording's own: fewer than two scans have one"
    line = f"poses aligned with {found.scans} scans: a step from scan to scan changed by {found.step_m:.2f} m in the median"
    return found.trajectory, f"{line}, {found.most_step_m:.2f} m at most; --no-align keeps the recording's own"
