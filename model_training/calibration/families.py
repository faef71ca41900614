"""Rig families of the calibration: cameras, depth sensors and LiDAR surveys that differ from each other.

A confidence that is fitted on one rig holds for this rig only. So the calibration has many families, and each family is predicted by a fit
without it (``cross_check``). Those figures say what a user with a rig of his own can expect.
"""

from collections import defaultdict
from dataclasses import dataclass

from model_training.calibration.plans import BOTH, SEQUENCE, calibration_plan
from model_training.calibration.rigs import RIGS
from model_training.simulation.depth_noise import DepthModel
from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import (
    DepthParameters,
    RgbParameters,
    StereoParameters,
    SurveyParameters,
)
from model_training.training.recipe import CALIBRATION_SEEDS

#: Number of cities for each family. Each serves the other as the map of another city.
FAMILY_CITIES = 2
#: Index of the seed of the first family in ``CALIBRATION_SEEDS``. A new family goes to the end of ``FAMILIES``, or the seeds move.
_FIRST = 100
#: Exposure above the metered one in the traversals in hard light, stops. Sunlit roads clip there, and stereo matching fails without
#: texture. On KITTI drive 0005 half of the outliers without texture lie in such pixels (decision 0138).
HARD_LIGHT_EV = (0.0, 0.4, 0.8)
#: Kinds of city of a family's first and second city. The mixed city has suburbs, trees and hedges.
_BOTH_KINDS = ("city", "mixed")
_STILL, _MODELLED, _PRESET = SurveyParameters(), StereoParameters(), DepthParameters()


@dataclass(frozen=True)
class Family:
    """A camera with its depth sensor, and the LiDAR survey of its maps.

    Attributes:
        name: name of the family.
        camera: camera of the colour image.
        camera_height_m: height of the camera above the ground, metres.
        depths: depth presets: one modelled preset, or stereo matchers.
        lidar: name of the survey's LiDAR model.
        spacing_m: distance between scans, metres.
        lidar_height_m: height of the LiDAR above the ground, metres.
        survey: errors and speed of the survey, and the share of it behind other vehicles.
        stereo: focal length times baseline, and errors of the rectification; empty for modelled depth.
        depth: numbers that replace those of the modelled preset; empty for stereo matchers.
        beams: beams of a spinning LiDAR that measures the depth, degrees of elevation; empty for a depth image.
        cameras: number of cameras around the vehicle whose frames are one query.
        kinds: kinds of the two cities.
        fitted: whether the calibration is fitted to it. Rigs that see too little are not: fewer than half of their answers are right, and
            they would lower the confidence of all other rigs. The service refuses their answers, because they lie outside of the range
            of the calibration data (decision 0149).
    """

    name: str
    camera: CameraPlan
    camera_height_m: float
    depths: tuple[str, ...]
    lidar: str
    spacing_m: float
    lidar_height_m: float = 1.8
    survey: SurveyParameters = _STILL
    stereo: StereoParameters = _MODELLED
    depth: DepthParameters = _PRESET
    beams: tuple[float, ...] = ()
    cameras: int = 1
    kinds: tuple[str, str] = _BOTH_KINDS
    fitted: bool = True

    @property
    def matched(self) -> bool:
        """Whether its depth comes from rendered and matched image pairs."""
        return self.stereo != _MODELLED

    @property
    def depth_type(self) -> str:
        """How its depth is measured, in one word or two."""
        if self.matched:
            return "stereo_matching"
        if self.beams:
            return "spinning_lidar"
        if self.depth.scale_error:
            return "monocular"
        return "modelled_stereo" if self.depths == ("stereo",) else "rgbd"

    def depth_model(self) -> DepthModel:
        """Return the modelled depth camera that measures walls and rooms. For stereo matchers it is the preset ``stereo``."""
        return _PRESET.on("stereo") if self.matched else self.depth.on(self.depths[0])


#: A car with GNSS and inertial sensors, whose poses have errors of about 0.1 m.
_CAR = SurveyParameters(position_m=0.08, angle_deg=0.1, speed_m_s=8.0, followed=0.3)
_SLOW = SurveyParameters(position_m=0.04, angle_deg=0.1, speed_m_s=1.5)
#: A car like KITTI's (Geiger et al., Vision meets Robotics, IJRR 2013).
_KITTI, _KITTI_STEREO = (
    CameraPlan(width=1242, height=376, horizontal_deg=81.4),
    StereoParameters(focal_baseline_px_m=384.0),
)


def _rectified(focal_baseline_px_m: float, share: float, **more: float) -> StereoParameters:
    """Return a stereo rig whose rectification errors are a share of the car's, because it has fewer pixels per degree."""
    return StereoParameters(
        focal_baseline_px_m=focal_baseline_px_m, offset_px=0.55 * share, vertical_px=0.4 * share, roll_px=0.4 * share, **more
    )  # fmt: skip


#: All families. Focal length times baseline of a modelled camera refers to an image that is 640 pixels wide.
FAMILIES = (
    Family("car", _KITTI, 1.65, ("sgbm",), "hdl_64", 2.5, 1.73, _CAR, _KITTI_STEREO),
    Family("car_sparse", _KITTI, 1.65, ("sgbm",), "hdl_64", 5.0, 1.73, SurveyParameters(position_m=0.08, angle_deg=0.1, speed_m_s=12.0,
           followed=0.1), _KITTI_STEREO, kinds=("mixed", "mixed")),
    # A small robot with block matching or semi-global matching.
    Family("robot", CameraPlan(width=640, height=400, horizontal_deg=80.0), 0.9, ("bm", "sgbm3way"), "hdl_32", 1.5, 1.6, _SLOW,
           _rectified(76.0, 0.53)),
    # ZED 2: baseline 0.12 m, 110 degrees.
    Family("zed2", CameraPlan(width=672, height=376, horizontal_deg=105.0), 1.1, ("sgbm",), "vlp_16", 1.0, 1.6, _SLOW,
           _rectified(31.0, 0.4, max_range_m=25.0)),
    # OAK-D: baseline 0.075 m, 72 degrees, block matching on the device.
    Family("oak_d", CameraPlan(width=640, height=400, horizontal_deg=72.0), 0.5, ("sgbm3way",), "os1_64", 1.0, 1.2, _SLOW,
           _rectified(33.0, 0.5, max_range_m=20.0), fitted=False),
    # RealSense D435 and D455: projected texture, baselines 0.05 and 0.095 m, 69 and 90 degrees in colour.
    Family("d435", CameraPlan(width=640, height=360, horizontal_deg=69.0), 0.6, ("precise",), "os1_64", 1.0, 1.2, _SLOW,
           depth=DepthParameters(focal_baseline_px_m=23.0, noise_px=0.12, offset_px=0.02, max_range_m=12.0)),
    Family("d455", CameraPlan(width=640, height=400, horizontal_deg=87.0), 1.0, ("precise",), "vlp_16", 2.0, 1.6, _SLOW,
           depth=DepthParameters(focal_baseline_px_m=32.0, noise_px=0.12, offset_px=0.02, max_range_m=20.0)),
    # Azure Kinect: time of flight, wide field of view binned, 5.5 m.
    Family("kinect", CameraPlan(width=640, height=576, horizontal_deg=75.0), 1.3, ("precise",), "os1_128", 1.0, 1.6, _SLOW,
           depth=DepthParameters(focal_baseline_px_m=200.0, noise_px=0.1, step_px=0.0, max_range_m=5.5), fitted=False),
    # A spinning LiDAR of 32 beams as depth sensor: sparse rings in the image.
    Family("rings", CameraPlan(width=640, height=480, horizontal_deg=90.0), 1.6, ("precise",), "hdl_32", 1.0, 1.8, _CAR,
           depth=DepthParameters(focal_baseline_px_m=800.0, noise_px=0.05, step_px=0.0, max_range_m=60.0, bleeding=0.05, scale_error=0.0),
           beams=tuple(10.67 - k * 41.34 / 31 for k in range(32)), fitted=False),
    # Monocular depth: dense, smooth, with a scale error of 8 %.
    Family("monocular", CameraPlan(width=640, height=480, horizontal_deg=80.0), 1.5, ("precise",), "os1_64", 1.0, 1.8, _SLOW,
           depth=DepthParameters(focal_baseline_px_m=80.0, noise_px=0.8, correlated=0.95, step_px=0.0, scale_error=0.08, bleeding=0.9,
                                 hole_level=99.0)),
    # A lorry: high, narrow view, long baseline, survey with a Pandar64.
    Family("lorry", CameraPlan(width=960, height=540, horizontal_deg=60.0), 2.6, ("sgbm",), "pandar_64", 2.0, 2.0, _CAR,
           _rectified(330.0, 0.9)),
    # A survey with a scan every 10 m, in good light and with a good RGB-D camera.
    Family("every_10_m", CameraPlan(width=640, height=480, horizontal_deg=90.0), 1.5, ("stereo",), "os1_128", 10.0, 1.8, _CAR),
    # The camera of the simulator, with a 16-beam survey.
    Family("vlp_16", CameraPlan(width=848, height=480, horizontal_deg=110.0), 1.5, ("stereo",), "vlp_16", 1.0, 1.8, _SLOW),
    # An iPhone with LiDAR, held upright, 5 m. Its 256 x 192 depth pixels are simulated at the size of the colour image.
    Family("iphone", CameraPlan(width=480, height=640, horizontal_deg=50.0), 1.4, ("precise",), "os1_64", 1.0, 1.6, _SLOW,
           depth=DepthParameters(focal_baseline_px_m=200.0, noise_px=0.1, step_px=0.0, max_range_m=5.0), fitted=False),
    # A survey with a LiDAR whose scans do not repeat and that hardly looks down.
    Family("livox", CameraPlan(width=640, height=480, horizontal_deg=90.0), 1.2, ("stereo",), "livox_mid_360", 1.0, 1.5, _SLOW),
    # Four cameras around the vehicle.
    Family("four_cameras", CameraPlan(width=640, height=400, horizontal_deg=90.0), 1.5, ("stereo",), "hdl_32", 2.5, 1.8, _CAR, cameras=4),
    # Cameras near the ground and high above it: a quadruped, a delivery robot and a bus.
    Family("quadruped", CameraPlan(width=640, height=480, horizontal_deg=85.0), 0.25, ("stereo",), "hdl_32", 1.0, 1.6, _SLOW),
    Family("courier", CameraPlan(width=640, height=480, horizontal_deg=80.0), 0.4, ("precise",), "os1_64", 1.5, 1.8, _SLOW),
    Family("bus", CameraPlan(width=800, height=450, horizontal_deg=95.0), 3.4, ("stereo",), "os1_128", 2.0, 1.9, _CAR),
)  # fmt: skip


#: Names of the families that the calibration is not fitted to.
NOT_FITTED = tuple(family.name for family in FAMILIES if not family.fitted)


def related() -> dict[str, tuple[str, ...]]:
    """Return the families that share a LiDAR model, a camera, a depth type or a survey spacing.

    A family that was left out of a fit is predicted too well if a relative with the same sensor takes part in it. So these families are
    left out together (``cross_check``).

    Returns:
        Names of two or more families, by the factor and the value that they share, such as ``lidar.hdl_64``.
    """
    plan, sharing = calibration_plan(0), defaultdict[str, list[str]](list)
    city = {"lidar": plan.lidar, "spacing": f"{plan.spacing_m:g}_m"}
    shared = {
        name: city | {"camera": _named(plan.camera), "depth": depth}
        for name, depth in zip(BOTH, ("rgbd", "modelled_stereo"), strict=True)
    }
    shared |= {rig.name: city for rig in RIGS}
    shared |= {
        each.name: {
            "lidar": each.lidar,
            "camera": _named(each.camera),
            "depth": each.depth_type,
            "spacing": f"{each.spacing_m:g}_m",
        }
        for each in FAMILIES
    }
    for family, values in shared.items():
        for factor, value in values.items():
            sharing[f"{factor}.{value}"].append(family)
    return {key: tuple(names) for key, names in sharing.items() if len(names) > 1}


def _named(camera: CameraPlan) -> str:
    return f"{camera.width}x{camera.height}_{camera.horizontal_deg:g}_deg"


def family_plan(
    family: Family, index: int, *, drives: int = 6, queries: int = 40, sequences: int = 20
) -> SimulationPlan:
    """Plan one of the ``FAMILY_CITIES`` of a family; the last one has sequences too.

    Each traversal of a stereo rig draws its own rectification errors. Every second traversal is in hard light, where images clip.

    Args:
        family: the family.
        index: index of the city, from 0.
        drives: number of traversals with single queries.
        queries: number of queries in each traversal.
        sequences: number of sequences of ``SEQUENCE`` frames in the last city.
    """

    def drive(traversal: int, name: str, count: int, sequence: int | None = None) -> QueryPlan:
        plan = QueryPlan(
            name=name, traversal=traversal, count=count, depths=family.depths, stereo_parameters=family.stereo,
            depth_parameters=family.depth, aside_m=1.5, heading_deg=10.0, followed=family.survey.followed, sequence=sequence,
            step_m=None if sequence is None else 2.0, cameras=family.cameras if family.cameras > 1 and sequence is None else None,
        )  # fmt: skip
        if traversal % 2:
            return plan
        brighter = RgbParameters(exposure_ev=HARD_LIGHT_EV[traversal // 2 % len(HARD_LIGHT_EV)])
        return plan.model_copy(update={"condition": "hard_light", "rgb": "machine", "rgb_parameters": brighter})

    count = max(1, queries // len(family.depths))
    asked = [drive(k, f"drive{k}", count) for k in range(1, drives + 1)]
    if index == FAMILY_CITIES - 1:
        asked.append(drive(drives + 1, "sequences", sequences, SEQUENCE))
    number = _FIRST + FAMILY_CITIES * FAMILIES.index(family) + index
    return SimulationPlan.model_validate(
        {
            "name": f"calibration-{family.name}-{index + 1}", "city": family.kinds[index], "seed": CALIBRATION_SEEDS[number],
            "size_m": (200.0, 250.0), "lidar": family.lidar, "lidar_height_m": family.lidar_height_m, "spacing_m": family.spacing_m,
            "camera": family.camera, "camera_height_m": family.camera_height_m, "queries": tuple(asked),
            "survey_parameters": family.survey,
        }
    )  # fmt: skip
