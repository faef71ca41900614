"""Shared work of benchmarks: datasets, maps and answers, made once under one folder, and rows of shares.

The name of each kept result includes its inputs: the plan, the encoder, and the code that simulates, builds and
answers. A change of any of them therefore causes a new measurement.
"""

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import ROOT, Report
from model_training.calibration.answer_code import ENDINGS
from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset
from model_training.evaluation.error_measures import wilson_interval
from model_training.evaluation.measures import measure, recall_at
from model_training.evaluation.predict import Predictions, PriorOf, SeenBy, joined, predict
from model_training.evaluation.raw_range import raw_best_views
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.simulate import simulate
from model_training.stock import CALIBRATION
from service.localization.localizer import Localizer
from service.maps.map import Map
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder

#: Only each third query of a set is given to the raw image. It is slow, and a third of the queries suffices to
#: distinguish 0.3 from 0.4.
RAW_EVERY = 3


@cache
def code_hash(*names: str) -> str:
    """Return a short hash of repository files, and of the Python, C and ONNX files of folders.

    Args:
        *names: paths relative to the repository.
    """
    digest = hashlib.sha256()
    for name in names:
        inside = [ROOT / name] if (ROOT / name).is_file() else (ROOT / name).rglob("*")
        for path in sorted(p for p in inside if p.suffix in ENDINGS):
            digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:8]


SIMULATION = (
    "model_training/simulation",
    *(f"service/geometry/{name}.py" for name in ("camera", "distortion", "rigid")),
)
ANSWERING = (
    *("service/imaging", "service/geometry", "service/maps", "service/registration"),
    *("service/retrieval", "service/scoring", "service/confidence", "service/localization"),
)
# includes the answering code: mapping queries its own map to check confidence
MAPPING = ("model_training/mapping", "model_training/datasets", *ANSWERING)


def _calibration_hash() -> str:
    return hashlib.sha256(CALIBRATION.read_bytes()).hexdigest()[:8]


class Runs:
    """Datasets, maps and figures under one folder, made once.

    Args:
        work: folder of the results.
        encoder: ONNX file of the encoder.
    """

    def __init__(self, work: Path, encoder: Path) -> None:
        self.work, self.encoder = work, encoder

    def dataset(self, plan: SimulationPlan) -> Dataset:
        """Simulate a plan, or reuse the dataset.

        Args:
            plan: simulation plan.
        """
        folder = self.work / f"{plan.name}-{code_hash(*SIMULATION)}"
        with bars() as report:
            simulate(plan, folder, report=report)
        return Dataset(folder)

    def bundle(self, dataset: Dataset, settings: BuildSettings | None = None) -> MapBundle:
        """Build a map, or reuse the one of the same encoder, code and dataset.

        Args:
            dataset: dataset to map.
            settings: settings of the map; None takes the defaults.
        """
        settings = settings or BuildSettings(name=dataset.name)
        folder = self.map_folder(settings.name, dataset)
        if not folder.exists():
            folder.parent.mkdir(parents=True, exist_ok=True)
            with bars() as report:
                build_map(dataset, self.encoder, folder, settings, report=report)
        return MapBundle.open(folder)

    def map_folder(self, name: str, dataset: Dataset) -> Path:
        """Return the folder of a map. Its name contains the encoder and the hashes of the code and of the stock calibration.

        Args:
            name: first part of the folder's name.
            dataset: dataset of the map. The name of its folder ends with the hash of the code that made it.
        """
        made_of = (
            f"{dataset.folder.name.rsplit('-', 1)[-1]}-{Encoder.open(self.encoder).sha256[:12]}-{code_hash(*MAPPING)}"
            f"-{_calibration_hash()}"
        )
        return self.work / "maps" / f"{name}-{made_of}"

    def figures(self, bundle: MapBundle, dataset: Dataset, names: list[str], *, refine: bool = False) -> dict[str, Any]:
        """Evaluate query sets by retrieval alone or with registration; the result also holds the answers.

        Args:
            bundle: the map.
            dataset: dataset of the queries.
            names: names of the query sets.
            refine: whether to register.
        """
        found = {name: self.predictions(bundle, dataset, name, refine=refine) for name in names}
        classes = [] if bundle.streets is None else [street.name for street in bundle.streets.features]
        return measure(joined(list(found.values())), classes) | {"predictions": found}

    def predictions(
        self,
        bundle: Map,
        dataset: Dataset,
        name: str,
        *,
        refine: bool = True,
        frames_each: int = 1,
        prior: tuple[str, PriorOf] | None = None,
        rig: tuple[str, SeenBy] | None = None,
    ) -> Predictions:
        """Answer a query set or its sequences, or reuse the answers.

        Args:
            bundle: the map.
            dataset: dataset of the queries.
            name: name of the query set.
            refine: whether to register.
            frames_each: frames per sequence; 1 for single queries.
            prior: name of a kind of prior, and its function; None for no prior.
            rig: name of a change of the queries, and its function; None leaves them as they are.
        """
        mode = ("full" if refine else "retrieval") + (f"-{frames_each}" if frames_each > 1 else "")
        mode += "".join(f"-{changed[0]}" for changed in (prior, rig) if changed is not None)
        folder = self.work / "predictions" / f"{mode}-{code_hash(*ANSWERING)}" / bundle.path.name / dataset.folder.name
        folder.mkdir(parents=True, exist_ok=True)
        kept = folder / f"{name}.npz"
        if not kept.exists():
            with bars() as report:
                asked = predict(
                    Localizer.open(bundle),
                    dataset,
                    name,
                    refine=refine,
                    frames_each=frames_each,
                    report=report,
                    prior_of=None if prior is None else prior[1],
                    seen_by=None if rig is None else rig[1],
                )
            asked.save(kept)
        return Predictions.load(kept)

    @staticmethod
    def forced_within(predictions: Predictions, reach_m: float) -> float:
        """Return the share of answers within a distance, whatever their status.

        Args:
            predictions: answers with ground truth.
            reach_m: distance, metres.
        """
        return float(within(predictions, reach_m).mean())

    def raw(self, bundle: MapBundle, dataset: Dataset, name: str) -> dict[str, tuple[int, int]]:
        """Return correct answers and number of queries of the raw range image by setting, over each third query.

        Args:
            bundle: the map.
            dataset: dataset of the queries.
            name: name of the query set.
        """
        code = code_hash(*MAPPING, "model_training/evaluation/raw_range.py")
        # Conditions of the survey share their queries, and only their maps differ.
        kept = self.work / "raw" / bundle.path.name / f"{dataset.folder.name}-{code}-{name}-every{RAW_EVERY}.json"
        if not kept.exists():
            kept.parent.mkdir(parents=True, exist_ok=True)
            with bars() as report:
                best = raw_best_views(bundle, dataset, [name], every=RAW_EVERY, report=report)
            truth = [f.T_map_camera[:2, 3] for f in dataset.queries(name) if f.T_map_camera is not None][::RAW_EVERY]
            xy = bundle.T_map_place[:, :2, 3]
            counts = {}
            for setting, place in best.items():
                right = recall_at(xy[place][:, None], np.array(truth), 1) & (place >= 0)
                counts[setting] = (int(right.sum()), len(truth))
            kept.write_text(json.dumps(counts))
        return {setting: (right, count) for setting, (right, count) in json.loads(kept.read_text()).items()}


def within(predictions: Predictions, reach_m: float) -> NDArray[np.bool_]:
    """Return whether each answer (n,) lies within a distance, whatever its status.

    Args:
        predictions: answers with ground truth.
        reach_m: distance, metres.
    """
    away = np.linalg.norm(predictions.T_answer[:, :2, 3] - predictions.T_true[:, :2, 3], axis=1)
    return np.asarray(np.nan_to_num(away, nan=np.inf) <= reach_m)


def accepted_within(predictions: Predictions, reach_m: float) -> NDArray[np.bool_]:
    """Return whether each answer (n,) was accepted and lies within a distance.

    Args:
        predictions: answers with ground truth.
        reach_m: distance, metres.
    """
    return predictions.localized & within(predictions, reach_m)


def pooled(parts: list[dict[str, Any]], key: str) -> tuple[float, int, list[float]]:
    """Pool a share over several cities: return value, count and Wilson interval.

    Args:
        parts: figures of each city.
        key: name of the share.
    """
    of = "street_queries" if key == "street_accuracy" else "queries"
    count = sum(part[of] for part in parts)
    right = round(sum(part[key] * part[of] for part in parts))
    return right / count, count, list(wilson_interval(right, count))


def share(
    report: Report, row_id: str, figures: dict[str, Any] | list[dict[str, Any]], key: str, bar: float | None = None
) -> None:
    """Add the row of one share, over one or several evaluations.

    Args:
        report: collects the rows.
        row_id: id of the row.
        figures: figures of one evaluation, or of several.
        key: name of the share.
        bar: limit of the share; None for no bar.
    """
    value, count, interval = pooled(figures if isinstance(figures, list) else [figures], key)
    report.row(row_id, value, "share", bar=bar, n=count, ci95=interval)
