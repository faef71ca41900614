"""Several frames as one question: a street of repeating blocks, and depth that ends at 15 m."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.plans import SEQUENCE, repeating_plan
from benchmarks.report import Report
from benchmarks.runs import Runs
from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.simulation.repeating import landmarks_m
from service.errors import NoDepthError
from service.geometry.rigid import Transform, inverse, rotation_z, transform_from
from service.localization.localizer import Localizer
from service.localization.query import Query
from service.maps.reader import MapBundle

#: Errors of the odometry from frame to frame: a share of the way, and a turn.
_WAY, _TURN_RAD = 0.01, float(np.deg2rad(0.2))
PASSED_M, FAR_M = 18.0, 58.0  # a landmark's middle this near is passed; so far away it cannot be seen


@dataclass(frozen=True)
class AskedSequences:
    """One row a sequence: truth of the last frame, whether answered within 1 m, status."""

    T_true: NDArray[np.float64]
    within_1_m: NDArray[np.bool_]
    status: NDArray[np.str_]


def ask_sequences(bundle: MapBundle, dataset: Dataset, name: str, *, length: int = SEQUENCE) -> AskedSequences:
    """Ask all sequences of a set, each with an odometry that errs."""
    localizer = Localizer.open(bundle)
    truth, within, status = [], [], []
    with bars() as report:
        sequences = list(_sequences(dataset, name, length))
        for number, frames in enumerate(sequences):
            T_last = frames[-1].T_map_camera
            if T_last is None:
                raise ValueError(f"{name} has no truth")
            truth.append(T_last)
            try:
                answer = localizer.localize_frames(*_as_query(frames, np.random.default_rng([77, number])))
            except NoDepthError:
                within.append(False)
                status.append("OUT_OF_MAP")
                continue
            near = np.linalg.norm(answer.T_map_camera[:2, 3] - T_last[:2, 3]) <= 1.0
            within.append(bool(near) and answer.status == "LOCALIZED")
            status.append(answer.status)
            report(f"sequences {name}", number + 1, len(sequences))
    return AskedSequences(np.array(truth), np.array(within), np.array(status))


def _sequences(dataset: Dataset, name: str, length: int) -> Iterator[list[QueryFrame]]:
    frames = list(dataset.queries(name))
    yield from (frames[k : k + length] for k in range(0, len(frames), length))


def _as_query(frames: list[QueryFrame], rng: np.random.Generator) -> tuple[tuple[Query, ...], tuple[Transform, ...]]:
    """The last frame first, and where the others stood against it, by odometry."""
    queries, poses, T_last_this = [], [], np.eye(4)
    for k in range(len(frames) - 1, -1, -1):
        frame, later = frames[k], frames[k + 1] if k + 1 < len(frames) else None
        if later is not None and frame.T_map_camera is not None and later.T_map_camera is not None:
            step = inverse(later.T_map_camera) @ frame.T_map_camera
            way = float(np.linalg.norm(step[:3, 3]))
            error = transform_from(rotation_z(rng.normal(0, _TURN_RAD)), rng.normal(0, _WAY * way, 3))
            T_last_this = T_last_this @ step @ error
        queries.append(Query(rgb=frame.rgb(), depth_m=frame.depth_m(), camera=frame.camera.pinhole()))
        poses.append(T_last_this)
    return tuple(queries), tuple(poses)


def sequence_rows(report: Report, runs: Runs) -> None:
    """Sequences that pass a landmark are told apart, those that pass none are said to be ambiguous."""
    dataset = runs.dataset(repeating_plan())
    found = ask_sequences(runs.bundle(dataset), dataset, "sequences_precise")
    away = np.abs(found.T_true[:, 0, 3, None] - landmarks_m()).min(axis=1)
    inside = np.abs(found.T_true[:, 0, 3]) < landmarks_m().max() + PASSED_M  # the street's ends tell where they are
    passed, far = away <= PASSED_M, (away >= FAR_M) & inside
    report.share("sequence.landmark.within_1_m", found.within_1_m[passed], bar=0.99)
    report.share("sequence.no_landmark.ambiguous", found.status[far] == "AMBIGUOUS", bar=0.95)
