"""Simulation plans of the accuracy report: cities, traversals and conditions with seeds that no training or calibration uses."""

from model_training.simulation.hard import HARD, hard_query
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import SurveyParameters
from model_training.training.recipe import EVALUATION_SEEDS

BOTH = ("precise", "stereo")
HARD_COUNT, AHEAD_COUNT, SEQUENCES, SEQUENCE = 500, 300, 300, 5
LARGE_M = (600.0, 400.0)
#: Distance between the scans of the conditions with a sparse survey, metres.
SPARSE_M = 5.0
#: Heights of the camera, metres; queries of each (with each depth camera), and extent of their city.
HEIGHTS_M, HEIGHT_COUNT, HEIGHT_CITY_M = (0.2, 0.4, 0.8, 1.5, 2.5, 3.5), 100, (300.0, 200.0)
#: Height of the camera on unusual ground, metres; slope of the ramp, and pitch of a camera that looks down steeply, degrees.
GROUND_CAMERA_M, RAMP_DEG, STEEP_DEG = 1.5, 8.0, 20.0
#: Frames of a robot that is followed, the distance between them, robots with each depth camera, and the extent of their city.
TRACK_FRAMES, TRACK_STEP_M, TRACKS, TRACK_CITY_M = 8, 2.0, 40, (250.0, 300.0)
REPEATING_DRIVES = 4  # of 120 sequences each; a sixth of them pass a landmark


def paper_plan() -> SimulationPlan:
    """Plan the paper's city: five other traversals with Table I's counts, and frames of the survey traversal."""
    drives = tuple(QueryPlan(name=f"drive{k}", traversal=k, per_class=True, depths=BOTH) for k in range(1, 6))
    own = QueryPlan(name="survey_drive", traversal=0, count=500, on_track=True, depths=("precise",))
    return SimulationPlan(name="paper-city", city="paper", seed=0, queries=(*drives, own))


def unseen_plan(index: int) -> SimulationPlan:
    """Plan one of three cities that no encoder was trained on: 1,000 queries together, and as many blocked ones.

    Args:
        index: number of the city, 0 to 2.
    """
    count = (334, 333, 333)[index]
    queries = (
        QueryPlan(name="drive1", traversal=1, count=count, depths=BOTH),
        QueryPlan(name="blocked25", traversal=2, count=count, depths=("precise",), blocked=0.25),
    )
    return SimulationPlan(name=f"unseen-{index + 1}", seed=EVALUATION_SEEDS[index + 1], queries=queries)


def large_plan(index: int) -> SimulationPlan:
    """Plan the same queries in a city of twice the size with the same seed, to measure the effect of map size.

    Args:
        index: number of the city, 0 to 2.
    """
    plan = unseen_plan(index)
    return plan.model_copy(update={"name": f"large-{index + 1}", "size_m": LARGE_M})


def more_plan(index: int) -> SimulationPlan:
    """Plan 2,000 further queries of the three unseen cities for registration; their maps are those of ``unseen_plan``.

    Args:
        index: number of the city, 0 to 2.
    """
    count = (666, 667, 667)[index]
    queries = (QueryPlan(name="drive3", traversal=3, count=count, depths=BOTH),)
    return SimulationPlan(name=f"unseen-{index + 1}-more", seed=EVALUATION_SEEDS[index + 1], queries=queries)


def hard_plan() -> SimulationPlan:
    """Plan the first unseen city under every hard condition, and on a clear day."""
    queries = [QueryPlan(name="clear", traversal=10, count=HARD_COUNT)]
    queries += [hard_query(name, traversal=11 + k, count=HARD_COUNT) for k, name in enumerate(HARD)]
    queries.append(
        QueryPlan(
            name="depth_15m_sequence5", traversal=40, count=SEQUENCES, max_depth_m=15.0, sequence=SEQUENCE, step_m=2.0
        )
    )
    return SimulationPlan(name="hard", seed=EVALUATION_SEEDS[1], queries=tuple(queries))


def height_plan(height_m: float) -> SimulationPlan:
    """Plan the queries of a camera at one height in a city that all heights share.

    Args:
        height_m: mean height of the camera above the ground, metres; each query deviates from it by 0.1 m (standard deviation).
    """
    queries = (
        QueryPlan(name="level", traversal=60, count=HEIGHT_COUNT, depths=BOTH),
        QueryPlan(name="pitched", traversal=61, count=HEIGHT_COUNT // 2, pitch_deg=5.0),
    )
    return SimulationPlan(
        name=f"height-{height_m:g}",
        seed=EVALUATION_SEEDS[30],
        size_m=HEIGHT_CITY_M,
        camera_height_m=height_m,
        queries=queries,
    )


def ground_plan() -> SimulationPlan:
    """Plan queries in the city of ``height_plan``: a level camera, one that looks up by the slope of a ramp, and one that looks down."""
    queries = (
        QueryPlan(name="level", traversal=62, count=2 * HEIGHT_COUNT),
        QueryPlan(name="ramp", traversal=63, count=2 * HEIGHT_COUNT, pitch_deg=-RAMP_DEG),
        QueryPlan(name="steep", traversal=64, count=2 * HEIGHT_COUNT, pitch_deg=STEEP_DEG),
    )
    return height_plan(GROUND_CAMERA_M).model_copy(update={"name": "ground", "queries": queries})


def lidar_16_plan() -> SimulationPlan:
    """Plan the same city and clear day, with a survey of 16 beams."""
    queries = (QueryPlan(name="clear", traversal=10, count=HARD_COUNT),)
    return SimulationPlan(name="hard-lidar-16", seed=EVALUATION_SEEDS[1], lidar="vlp_16", queries=queries)


def lidar_os0_plan() -> SimulationPlan:
    """Plan a survey of the same city by an Ouster OS0 with 128 beams over 90 degrees. The queries are those of ``hard_plan``.

    A scan every 5 m, as in ``survey_5m``: the two differ by the LiDAR only, and a scan every metre would take over 4 GB.
    """
    return SimulationPlan(
        name="hard-lidar-os0", seed=EVALUATION_SEEDS[1], lidar="os0_128", spacing_m=SPARSE_M, queries=()
    )


def vehicle_ahead_plan() -> SimulationPlan:
    """Plan the same city on a clear day, with a vehicle ahead of the camera in every image and ahead of the survey on its whole way."""
    queries = (QueryPlan(name="vehicle_ahead", traversal=41, count=AHEAD_COUNT, depths=BOTH, followed=1.0),)
    return SimulationPlan(
        name="hard-vehicle-ahead",
        seed=EVALUATION_SEEDS[1],
        survey_parameters=SurveyParameters(speed_m_s=8.0, followed=1.0),
        queries=queries,
    )


def repeating_plan() -> SimulationPlan:
    """Plan a street of identical blocks with a landmark every few blocks, and sequences along it."""
    queries = tuple(
        QueryPlan(name=f"drive{k}", traversal=k, count=120, sequence=SEQUENCE, step_m=3.0, aside_m=1.5)
        for k in range(1, REPEATING_DRIVES + 1)
    )
    return SimulationPlan(name="repeating", city="repeating", seed=EVALUATION_SEEDS[21], queries=queries)


def track_plan() -> SimulationPlan:
    """Plan robots that drive through a city of mixed districts, some of them behind other vehicles."""
    drive = QueryPlan(
        name="track",
        traversal=70,
        count=TRACKS,
        depths=BOTH,
        sequence=TRACK_FRAMES,
        step_m=TRACK_STEP_M,
        aside_m=1.5,
        followed=0.2,
    )
    return SimulationPlan(
        name="track", city="mixed", seed=EVALUATION_SEEDS[31], size_m=TRACK_CITY_M, lidar="hdl_32", queries=(drive,)
    )


def other_track_plan() -> SimulationPlan:
    """Plan another city, whose map does not show where these robots are."""
    return SimulationPlan(
        name="track-elsewhere", city="mixed", seed=EVALUATION_SEEDS[32], size_m=TRACK_CITY_M, lidar="hdl_32", queries=()
    )
