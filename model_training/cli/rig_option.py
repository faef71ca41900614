"""Option ``--rig NAME`` of ``simulate``: the rigs of the calibration, which the reports measure (rows ``rigs.NAME``)."""

from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.calibration.families import FAMILIES, Family
from model_training.calibration.rigs import Rig
from model_training.datasets.dataset import Dataset, query_folder, write_description
from model_training.datasets.files import read_bytes
from model_training.datasets.png import write_png
from model_training.simulation.depth_noise import DEPTHS
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.sensor_parameters import DepthParameters, StereoParameters, SurveyParameters
from model_training.simulation.simulate import simulate
from model_training.simulation.stereo_pair import STEREOS
from service.errors import DatasetError
from service.retrieval.query import Query

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
#: Name in ``dataset.json``, under ``source``, of the beams that the depth images are limited to, degrees.
BEAMS = "depth_beams_deg"
#: What each rig stands for. The numbers are those of ``FAMILIES``.
_TITLES = {
    "car": "KITTI's stereo camera",
    "car_sparse": "KITTI's, sparse survey",
    "robot": "stereo of a small robot",
    "zed2": "ZED 2",
    "oak_d": "OAK-D",
    "d435": "RealSense D435",
    "d455": "RealSense D455",
    "kinect": "Azure Kinect",
    "rings": "depth on LiDAR beams",
    "monocular": "monocular depth",
    "lorry": "stereo of a lorry",
    "every_10_m": "sparse survey",
    "vlp_16": "wide camera",
    "iphone": "iPhone with LiDAR",
    "livox": "survey by a Livox",
    "four_cameras": "four cameras around",
    "quadruped": "stereo near the ground",
    "courier": "delivery robot",
    "bus": "stereo of a bus",
}


def rig_lines() -> list[str]:
    """Return a line for each rig: name, meaning, image size, depth, and the survey's LiDAR with the distance between its scans."""
    lines = []
    for family in FAMILIES:
        camera, depths = family.camera, "/".join(family.depths)
        sensors = f"{camera.width}x{camera.height} {depths}; {family.lidar}, {family.spacing_m:g} m"
        lines.append(f"{family.name:<13}{_TITLES[family.name]}: {sensors}")
    return lines


def rig_named(name: str) -> Family:
    """Return a rig by its name.

    Args:
        name: name of a rig.

    Raises:
        DatasetError: there is no such rig.
    """
    for family in FAMILIES:
        if family.name == name:
            return family
    raise DatasetError(
        f"rig: {name!r} is not a rig; choose one of: {', '.join(family.name for family in FAMILIES)}", field="rig"
    )


def depths_of(rig: Family, given: Iterable[str]) -> tuple[str, ...]:
    """Return the depth presets of a rig, or those that were given instead.

    Args:
        rig: the rig.
        given: presets that replace those of the rig; none keep them.

    Raises:
        DatasetError: a given preset is of another sort, so the rig's numbers do not fit it.
    """
    chosen = tuple(given) or rig.depths
    own, others = (STEREOS, DEPTHS) if rig.matched else (DEPTHS, STEREOS)
    for depth in chosen:
        if depth in others:
            raise DatasetError(
                f"depth: {depth!r} does not fit rig {rig.name!r}; choose one of: {', '.join(own)}, or omit --depth",
                field="depth",
            )
    return chosen


def sensors_of(
    rig: Family, depth: DepthParameters, stereo: StereoParameters, survey: SurveyParameters, *, survey_error: bool
) -> tuple[DepthParameters, StereoParameters, SurveyParameters]:
    """Return the numbers of a rig, replaced by those that were given.

    Args:
        rig: the rig.
        depth: given numbers of modelled depth.
        stereo: given numbers of stereo matching.
        survey: given numbers of the survey.
        survey_error: whether the survey's poses have an error. Without it, the rig's size of the error does not count.
    """
    of_survey = rig.survey if survey_error else rig.survey.model_copy(update={"position_m": None, "angle_deg": None})
    return (
        rig.depth.model_copy(update=depth.model_dump()),
        rig.stereo.model_copy(update=stereo.model_dump()),
        of_survey.model_copy(update=survey.model_dump()),
    )


def simulate_rig(
    plan: SimulationPlan, out: Path, beams_deg: tuple[float, ...], *, workers: int | None, report: Report
) -> None:
    """Simulate a plan, and keep depth on the beams of a LiDAR only if the rig has beams.

    With beams, the dataset appears at ``out`` when it is complete. Until then it is in a hidden folder beside it, and the same call
    continues there.

    Args:
        plan: settings of the dataset.
        out: folder of the dataset.
        beams_deg: elevations of the beams, degrees; empty: a depth in every pixel.
        workers: number of processes; None takes one per core.
        report: called after every frame with the stage, the number of finished frames and their total.

    Raises:
        DatasetError: the plan is not valid, or ``out`` holds something else.
    """
    finished = (out / "dataset.json").is_file()
    if finished and Dataset(out).description.source.get(BEAMS, []) != list(beams_deg):
        raise DatasetError(
            f"{out} contains the simulation of a rig with another depth sensor; choose another --out, or remove it",
            field="out",
        )
    if finished or not beams_deg:
        simulate(plan, out, workers=workers, report=report)
        return
    if out.exists() and any(out.iterdir()):
        raise DatasetError(f"{out} is not empty; choose another --out", field="out")
    dense = out.with_name(f".{out.name}.dense")
    simulate(plan, dense, workers=workers, report=report)
    _keep_beams(Dataset(dense), beams_deg, report)
    dense.rename(out)


def _keep_beams(dataset: Dataset, beams_deg: tuple[float, ...], report: Report) -> None:
    """Remove all depth that is not on a beam, as the calibration does for its queries. A second call changes nothing.

    Raises:
        DatasetError: a depth image is damaged.
    """
    on_beam = _on_beams(dataset, beams_deg)
    names = dataset.query_sets(with_truth=False)
    paths = [path for name in names for path in sorted((query_folder(dataset.folder, name) / "depth").glob("*.png"))]
    for done, path in enumerate(paths, 1):
        depth = cv2.imdecode(np.frombuffer(read_bytes(path), np.uint8), cv2.IMREAD_UNCHANGED)
        if depth is None:
            raise DatasetError(
                f"{path}: not an image; remove {dataset.folder}, and run the command again", field="depth"
            )
        part = path.with_name(f"{path.name}.part")
        write_png(part, np.where(on_beam, depth, 0).astype(np.uint16))
        part.rename(path)
        report("beams", done, len(paths))
    told = dataset.description
    write_description(dataset.folder, told.model_copy(update={"source": {**told.source, BEAMS: list(beams_deg)}}))


def _on_beams(dataset: Dataset, beams_deg: tuple[float, ...]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of the dataset's camera that a beam meets."""
    camera = dataset.description.sensors.cameras[0].pinhole()
    shape = (camera.height, camera.width)
    full = Query(rgb=np.zeros((*shape, 3), np.uint8), depth_m=np.ones(shape, np.float32), camera=camera)
    return np.asarray(Rig("beams", beams_deg=beams_deg).seen(full).depth_m > 0)
