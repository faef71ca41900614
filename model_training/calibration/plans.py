"""Plan the calibration cities: they serve neither training nor validation nor evaluation."""

from dataclasses import dataclass

from model_training.simulation.hard import HARD, hard_query
from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import RgbParameters, StereoParameters, SurveyParameters
from model_training.training.recipe import CALIBRATION_SEEDS

#: Number of cities with modelled depth errors.
CITIES = 3
#: Number of frames in a sequence.
SEQUENCE = 5
#: Index of the seed of the street with repeating blocks in ``CALIBRATION_SEEDS``.
_REPEATING = 50
#: Index of the first seed of the cities of ``PAIR_RIGS`` in ``CALIBRATION_SEEDS``, and number of cities for each rig.
_PAIRS, PAIR_CITIES = 10, 2
#: Exposure above the metered one in the traversals in hard light, stops. Sunlit roads clip there, and stereo matching fails without
#: texture. On KITTI drive 0005 half of the outliers without texture lie in such pixels (decision 0138).
HARD_LIGHT_EV = (0.0, 0.4, 0.8)
#: The depth presets.
BOTH = ("precise", "stereo")


def calibration_plan(index: int, *, queries: int = 350, hard: int = 40, sequences: int = 80) -> SimulationPlan:
    """Plan one of the ``CITIES``: a traversal on a clear day and one in each hard condition, with both depth presets.

    The last city has sequences too.

    Args:
        index: index of the city, from 0.
        queries: number of queries on the clear day.
        hard: number of queries in each hard condition.
        sequences: number of sequences of ``SEQUENCE`` frames in the last city.
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
    """Plan a street of equal blocks with a landmark every few blocks. The place is often ambiguous there.

    Args:
        singles: number of single queries.
        sequences: number of sequences of ``SEQUENCE`` frames.
    """
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
    """A stereo rig with rendered and matched image pairs, and the survey of its map.

    Stereo-matched depth has other errors than modelled ones. A calibration on modelled errors alone takes real stereo depth for that of
    out-of-map queries (decision 0134).

    Attributes:
        name: name of the rig in its kinds of queries.
        camera: camera of the left image.
        camera_height_m: height of the camera above the ground, metres.
        stereo: focal length times baseline, and errors of the rectification.
        depths: names of the stereo matchers.
        lidar: name of the survey's LiDAR model.
        lidar_height_m: height of the LiDAR above the ground, metres.
        spacing_m: distance between scans, metres.
        survey: errors and speed of the survey, and the share of it behind other vehicles.
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


#: The stereo rigs of the calibration.
PAIR_RIGS = (
    # A car like KITTI's (Geiger et al., Vision meets Robotics, IJRR 2013). Poses of GNSS and inertial sensors have errors of about 0.1 m.
    PairRig(
        "car", CameraPlan(width=1242, height=376, horizontal_deg=81.4), 1.65, StereoParameters(focal_baseline_px_m=384.0), ("sgbm",),
        "hdl_64", 1.73, 2.5, SurveyParameters(position_m=0.08, angle_deg=0.1, speed_m_s=8.0, followed=0.3),
    ),
    # A small robot with a stereo baseline of 0.2 m, block matching or semi-global matching, and a survey by a LiDAR with 32 beams. Its
    # rectification errors equal the car's in angle, so they are half as many pixels.
    PairRig(
        "robot", CameraPlan(width=640, height=400, horizontal_deg=80.0), 0.9,
        StereoParameters(focal_baseline_px_m=76.0, offset_px=0.29, vertical_px=0.21, roll_px=0.21), ("bm", "sgbm3way"), "hdl_32", 1.6, 1.5,
        SurveyParameters(position_m=0.04, angle_deg=0.1, speed_m_s=1.5),
    ),
)  # fmt: skip


def pair_plan(rig: PairRig, index: int, *, drives: int = 6, queries: int = 25, sequences: int = 30) -> SimulationPlan:
    """Plan one of the ``PAIR_CITIES`` of a rig; the last one has sequences too.

    Each traversal draws its own rectification errors. Every second traversal is in hard light, where images clip.

    Args:
        rig: the stereo rig, one of ``PAIR_RIGS``, with its survey.
        index: index of the city, from 0.
        drives: number of traversals with single queries.
        queries: number of queries in each traversal.
        sequences: number of sequences of ``SEQUENCE`` frames in the last city.
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
