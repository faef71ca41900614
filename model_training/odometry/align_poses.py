"""A recording's own poses, mended by its scans: steps by scan matching, the whole where the recording has it.

Poses of GNSS and inertial sensors are off by decimetres between houses, differently every few dozen metres: on KITTI's drive 0005 by up to
0.26 m in a step of 2.3 m. A map of them is blurred, and what is measured against them is measured wrongly.
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
#: Formats whose own poses are of GNSS and inertial sensors: these are aligned unless told otherwise.
ALIGNED_KINDS = frozenset({"kitti-raw"})
#: A scan that has no given pose so near in time has no guess, and is left out.
TOLERANCE_S = 0.1


@dataclass(frozen=True, slots=True)
class AlignedPoses:
    """Poses that were mended.

    Attributes:
        trajectory: T_map_vehicle at the given poses' times and at the scans'.
        scans: how many scans were matched.
        step_m: how much the steps from scan to scan changed: the median;
        most_step_m: and the most.
    """

    trajectory: Trajectory
    scans: int
    step_m: float
    most_step_m: float


def aligned_with_scans(
    recording: Recording, trajectory: Trajectory, *, report: Report = lambda *_: None
) -> AlignedPoses | None:
    """Match each scan to those before it, guided by the given poses, and bring both into agreement.

    Between scans the given poses keep their own motion: what is interpolated is the correction, in the vehicle's frame.

    Args:
        recording: with scans.
        trajectory: T_map_vehicle, as the recording gives it.
        report: told stage, done and all.

    Returns:
        None where fewer than two scans have a pose.

    Raises:
        ExtraMissingError: small_gicp or gtsam is not installed.
    """
    try:
        import gtsam  # noqa: F401  # asked for before the work, not after it
        import small_gicp  # noqa: F401
    except ModuleNotFoundError as error:
        raise ExtraMissingError(
            f"aligning poses needs {error.name}: {how_to_install('odometry')}, or import with --no-align",
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
    """Of each of many transforms (n, 4, 4)."""
    return np.stack([inverse(T) for T in transforms])


def usual_poses(
    recording: Recording, trajectory: Trajectory, *, align: bool | None = None, report: Report = lambda *_: None
) -> tuple[Trajectory, str | None]:
    """The poses that an import takes unless told otherwise, and a line for people about them.

    Args:
        recording: opened.
        trajectory: its own.
        align: with the scans, or not; None does so for ``ALIGNED_KINDS`` where the packages for it are installed.
        report: told stage, done and all.

    Raises:
        ExtraMissingError: ``align`` is True, and a package for it is not installed.
    """
    if align is False or (align is None and recording.kind not in ALIGNED_KINDS):
        return trajectory, None
    try:
        found = aligned_with_scans(recording, trajectory, report=report)
    except ExtraMissingError as missing:
        if align:
            raise
        return trajectory, f"poses are the recording's own, which may be off by decimetres: {missing}"
    if found is None:
        return trajectory, "poses are the recording's own: fewer than two scans have one"
    line = f"poses aligned with {found.scans} scans: a step from scan to scan changed by {found.step_m:.2f} m in the median"
    return found.trajectory, f"{line}, {found.most_step_m:.2f} m at most; --no-align keeps the recording's own"
