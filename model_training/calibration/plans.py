"""The cities that confidence is calibrated on: neither trained on, nor watched, nor evaluated."""

from dataclasses import dataclass

from model_training.simulation.hard import HARD, hard_query
from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import RgbParameters, StereoParameters, SurveyParameters
from model_training.training.recipe import CALIBRATION_SEEDS

CITIES = 3
SEQUENCE = 5
#: Seed of the street of blocks that repeat, among the calibration's.
_REPEATING = 50
#: Seeds of the cities of ``PAIR_RIGS``, among the calibration's: so many each, from here on.
_PAIRS, PAIR_CITIES = 10, 2
#: Stops brighter than metered, of the drives in hard light. Sunlit road clips there, and what has no texture is matched badly: half of
#: the outliers of KITTI's drive 0005 (decision log, 2026-11-25).
HARD_LIGHT_EV = (0.0, 0.4, 0.8)
BOTH = ("precise", "stereo")


def calibration_plan(index: int, *, queries: int = 350, hard: int = 40, sequences: int = 80) -> SimulationPlan:
    """One of ``CITIES``: a clear day's drive and every hard condition, with both depth presets; the last has sequences too.

    Args:
        index: of the city.
        queries: of the clear day's drive.
        hard: of each hard condition.
        sequences: of ``SEQUENCE`` frames, in the last city.
    """
    drives = [QueryPlan(name="clear", traversal=1, count=queries, depths=BOTH)]
    drives += [hard_query(name, traversal=2 + k, count=hard, depths=BOTH) for k, name in enumerate(HARD)]
    if index == CITIES - 1:
        traversal = 2 + len(HARD)
        drives.append(
            QueryPlan(
                name="sequences", traversal=traversal, count=sequences, depths=BOTH, sequence=SEQUENCE, step_m=3.0
            )
        )
    return SimulationPlan(name=f"calibration-{index + 1}", seed=CALIBRATION_SEEDS[index], queries=tuple(drives))


def repeating_plan(*, singles: int = 150, sequences: int = 100) -> SimulationPlan:
    """A street of blocks that are all alike but for a landmark every few of them: what is there cannot always be told."""
    drives = (
        QueryPlan(name="clear", traversal=1, count=singles, depths=BOTH, aside_m=1.5),
        QueryPlan(
            name="sequences", traversal=2, count=sequences, depths=BOTH, aside_m=1.5, sequence=SEQUENCE, step_m=3.0
        ),
    )
    return SimulationPlan(
        name="calibration-repeating", city="repeating", seed=CALIBRATION_SEEDS[_REPEATING], queries=drives
    )


@dataclass(frozen=True)
class PairRig:
    """A stereo rig whose pairs are rendered and matched, and the survey that it asks.

    A calibration on drawn errors alone takes real stereo depth for a stranger's (decision log): matching errs in another way.

    Attributes:
        name: of its kinds of queries.
        camera: of the left picture.
        camera_height_m: above the ground.
        stereo: focal length times baseline, and how badly it is rectified.
        depths: matchers.
        lidar: of the survey.
        lidar_height_m: above the ground.
        spacing_m: between scans.
        survey: how it drove.
    """

    name: str
    camera: CameraPlan
    camera_height_m: float
    stereo: StereoParameters
    depths: tuple[str, ...]
    lidar: str
    lidar_height_m: float
    spacing_m: float
    survey: SurveyParameters


PAIR_RIGS = (
    # A car as KITTI's: Geiger et al., Vision meets Robotics, IJRR 2013. Poses of GNSS and inertial sensors err by a decimetre.
    PairRig(
        "car", CameraPlan(width=1242, height=376, horizontal_deg=81.4), 1.65, StereoParameters(focal_baseline_px_m=384.0), ("sgbm",),
        "hdl_64", 1.73, 2.5, SurveyParameters(position_m=0.08, angle_deg=0.1, speed_m_s=8.0, followed=0.3),
    ),
    # A small robot: stereo of 0.2 m baseline matched by blocks or along scan lines, in a survey by a LiDAR of 32 beams. It is rectified as
    # well as the car's: the same angles are half as many of its pixels.
    PairRig(
        "robot", CameraPlan(width=640, height=400, horizontal_deg=80.0), 0.9,
        StereoParameters(focal_baseline_px_m=76.0, offset_px=0.29, vertical_px=0.21, roll_px=0.21), ("bm", "sgbm3way"), "hdl_32", 1.6, 1.5,
        SurveyParameters(position_m=0.04, angle_deg=0.1, speed_m_s=1.5),
    ),
)  # fmt: skip


def pair_plan(rig: PairRig, index: int, *, drives: int = 6, queries: int = 25, sequences: int = 30) -> SimulationPlan:
    """One of ``PAIR_CITIES`` of a rig; the last has sequences too. Every drive draws how well the rig is rectified.

    Every second drive is in hard light, whose pictures clip.

    Args:
        rig: what asks, and the survey that it asks.
        index: of the city.
        drives: with ``queries`` pictures each.
        queries: of each drive.
        sequences: of ``SEQUENCE`` frames, in the last city.
    """

    def drive(traversal: int, name: str, count: int, sequence: int | None = None) -> QueryPlan:
        step_m = None if sequence is None else 2.0
        plan = QueryPlan(
            name=name, traversal=traversal, count=count, depths=rig.depths, stereo_parameters=rig.stereo, aside_m=1.5,
            heading_deg=10.0, followed=rig.survey.followed, sequence=sequence, step_m=step_m,
        )  # fmt: skip
        if traversal % 2:
            return plan
        brighter = RgbParameters(exposure_ev=HARD_LIGHT_EV[traversal // 2 % len(HARD_LIGHT_EV)])
        return plan.model_copy(update={"condition": "hard_light", "rgb": "machine", "rgb_parameters": brighter})

    asked = [drive(k, f"drive{k}", queries) for k in range(1, drives + 1)]
    if index == PAIR_CITIES - 1:
        asked.append(drive(drives + 1, "sequences", sequences, SEQUENCE))
    number = _PAIRS + PAIR_CITIES * PAIR_RIGS.index(rig) + index
    return SimulationPlan(
        name=f"calibration-{rig.name}-{index + 1}", seed=CALIBRATION_SEEDS[number], size_m=(200.0, 250.0), lidar=rig.lidar,
        lidar_height_m=rig.lidar_height_m, spacing_m=rig.spacing_m, camera=rig.camera, camera_height_m=rig.camera_height_m,
        queries=tuple(asked), survey_parameters=rig.survey,
    )  # fmt: skip
