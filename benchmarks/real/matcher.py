"""Compare the errors of simulated and real stereo matching. Both are measured against LiDAR scans by one procedure.

The simulated pairs are from validation cities, not from calibration, training or evaluation cities. As in a recorded drive, the survey
passes the same vehicles on the same path.
"""

from pathlib import Path

import numpy as np

from benchmarks.real.streets import QUERIES, imported
from benchmarks.report import Report
from model_training.calibration.families import FAMILIES
from model_training.datasets.dataset import Dataset
from model_training.evaluation.disparity_errors import DisparityErrors, disparity_errors
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import RgbParameters
from model_training.simulation.simulate import simulate
from model_training.training.recipe import VALIDATION_SEEDS

DRIVES, FRAMES, FIRST_SEED = 6, 6, 20
#: A machine-vision camera that is exposed for the shade, so that sunlit roads clip, as 0005's are.
EXPOSURE = RgbParameters(exposure_ev=0.6)
RATIO = (0.8, 1.25)
RANGES_M = ((5, 10), (10, 20), (20, 40))


def simulated_errors(work: Path) -> DisparityErrors:
    """Return the matching errors of simulated pairs of KITTI's rig. Each city has its own rectification error.

    Args:
        work: folder of the datasets.
    """
    (rig,) = (rig for rig in FAMILIES if rig.name == "car")
    found = []
    for k in range(DRIVES):
        query = QueryPlan(
            name="own",
            traversal=0,
            count=FRAMES,
            depths=("sgbm",),
            aside_m=0.3,
            heading_deg=3.0,
            stereo_parameters=rig.stereo,
            condition="hard_light",
            rgb="machine",
            rgb_parameters=EXPOSURE,
        )
        plan = SimulationPlan(
            name=f"matcher-{k}",
            seed=VALIDATION_SEEDS[FIRST_SEED + k],
            size_m=(120.0, 120.0),
            lidar=rig.lidar,
            lidar_height_m=rig.lidar_height_m,
            spacing_m=rig.spacing_m,
            survey_error=False,
            camera=rig.camera,
            camera_height_m=rig.camera_height_m,
            queries=(query,),
        )
        simulate(plan, work / plan.name)
        found.append(disparity_errors(Dataset(work / plan.name), "own_sgbm"))
    return DisparityErrors.joined(found)


def matcher_rows(report: Report, data: Path, work: Path, recording: str = "kitti_0005") -> None:
    """Add the error sizes of a recording and of the simulated pairs, and their ratios.

    Args:
        report: receives the rows.
        data: folder of the recordings.
        work: folder of the datasets.
        recording: name of the recording.
    """
    dataset = imported(data, work, recording)
    if dataset is None:
        report.row("real.matcher.error_ratio", None, "ratio", bar=RATIO, why=f"no recordings at {data.name}")
        return
    recorded, simulated = disparity_errors(dataset, QUERIES), simulated_errors(work)
    ratios: list[float] = []
    for textured, kind in ((True, "textured"), (False, "untextured")):
        real, ours = recorded.sizes(textured=textured), simulated.sizes(textured=textured)
        for name, measure in (("median", np.median), ("percentile_90", lambda sizes: np.percentile(sizes, 90))):
            row = f"real.matcher.{kind}.{name}"
            report.row(f"{row}_px", float(measure(real)), "px", n=len(real))
            report.row(f"{row}_px.simulated", float(measure(ours)), "px", n=len(ours))
            ratios.append(float(measure(ours) / measure(real)))
            report.row(f"real.matcher.error_ratio.{kind}.{name}", ratios[-1], "ratio", bar=RATIO)
        report.row(f"real.matcher.{kind}.unmatched", recorded.unmatched(textured=textured), "share")
        report.row(f"real.matcher.{kind}.unmatched.simulated", simulated.unmatched(textured=textured), "share")
    worst = max(ratios, key=lambda ratio: abs(np.log(ratio)))
    report.row(
        "real.matcher.error_ratio", worst, "ratio", bar=RATIO, why="the ratio of the four that is farthest from 1"
    )
    for name, errors in (("", recorded), (".simulated", simulated)):
        report.row(f"real.matcher.correlation_length{name}", errors.correlation_length_px(), "px")
        for nearest_m, farthest_m in RANGES_M:
            share = errors.outliers(nearest_m=nearest_m, farthest_m=farthest_m)
            report.row(f"real.matcher.outliers_{nearest_m}_to_{farthest_m}_m{name}", share, "share")
