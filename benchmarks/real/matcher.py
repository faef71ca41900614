"""Compare the errors of simulated and real stereo matching. Both are measured against LiDAR scans by one procedure.

The simulated pairs are from validation cities, not from calibration, training or evaluation cities. As in a recorded drive, the survey
passes the same vehicles on the same path.
"""

from dataclasses import fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
    """Add the error statistics of a recording and of the simulated pairs, and the ratios of their error sizes.

    The statistics are error size and share of unmatched points by texture, outlier share by texture and distance, and correlation length.

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
    both, ratios = (("", recorded), (".simulated", simulated)), list[float]()
    for textured, kind in ((True, "textured"), (False, "untextured")):
        real, ours = recorded.sizes(textured=textured), simulated.sizes(textured=textured)
        for name, measure in (("median", np.median), ("percentile_90", lambda sizes: np.percentile(sizes, 90))):
            row = f"real.matcher.{kind}.{name}"
            report.row(f"{row}_px", float(measure(real)), "px", n=len(real))
            report.row(f"{row}_px.simulated", float(measure(ours)), "px", n=len(ours))
            ratios.append(float(measure(ours) / measure(real)))
            report.row(f"real.matcher.error_ratio.{kind}.{name}", ratios[-1], "ratio", bar=RATIO)
        for name, errors in both:
            points, row = int((errors.textured == textured).sum()), f"real.matcher.{kind}"
            report.row(f"{row}.unmatched{name}", errors.unmatched(textured=textured), "share", n=points)
            _outlier_rows(report, row, name, of_points(errors, errors.textured == textured))
    worst = max(ratios, key=lambda ratio: abs(np.log(ratio)))
    report.row(
        "real.matcher.error_ratio", worst, "ratio", bar=RATIO, why="the ratio of the four that is farthest from 1"
    )
    for name, errors in both:
        matched = int(np.isfinite(errors.error_px).sum())
        report.row(f"real.matcher.correlation_length{name}", errors.correlation_length_px(), "px", n=matched)
        _outlier_rows(report, "real.matcher", name, errors)


def of_points(errors: DisparityErrors, kept: NDArray[np.bool_]) -> DisparityErrors:
    """Return the errors of some of the points.

    Args:
        errors: errors of n points.
        kept: True for each point to keep (n,).
    """
    return DisparityErrors(*(getattr(errors, field.name)[kept] for field in fields(DisparityErrors)))


def _outlier_rows(report: Report, row: str, name: str, errors: DisparityErrors) -> None:
    """Add the outlier share at each distance. The number of samples is that of the matched points."""
    for nearest_m, farthest_m in RANGES_M:
        inside = (errors.z_m >= nearest_m) & (errors.z_m < farthest_m)
        matched = int(np.isfinite(errors.error_px[inside]).sum())
        share = errors.outliers(nearest_m=nearest_m, farthest_m=farthest_m) if matched else None
        why = None if matched else "no matched point at this distance"
        report.row(f"{row}.outliers_{nearest_m}_to_{farthest_m}_m{name}", share, "share", n=matched, why=why)
