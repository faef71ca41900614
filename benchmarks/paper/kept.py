"""Answers of each method, kept as JSON so that tables and figures need no new run."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.provenance import Run, this_process
from research.baselines.answers import PlaceAnswers
from research.baselines.learning import CurvePoint

COMMAND = "make paper"
SPLITS = ("same_drive", "other_drive")


@dataclass(frozen=True, eq=False)
class MethodResult:
    """One method: its answers by split and its training.

    Attributes:
        method: name in row ids.
        answers: answers by split.
        training_s: processor seconds of training; 0 for a method without learning, None if it was trained before the
            comparison.
        images: number of images shown in training.
        training_set: number of different training images.
        ended: why the training ended.
        curve: training curve.
        extra: plain values for tables.
        run: the run that gave the answers.
    """

    method: str
    answers: Mapping[str, PlaceAnswers]
    training_s: float | None = 0.0
    images: int = 0
    training_set: int = 0
    ended: str = "no training"
    curve: list[CurvePoint] = field(default_factory=list)
    extra: dict[str, Any] = field(default_factory=dict)
    run: Run = field(default_factory=lambda: this_process(COMMAND))

    @property
    def aside(self) -> float:
        """Street accuracy on the held-out pairs; it selects among variants of a method."""
        told = self.extra.get("aside")
        return float(self.extra["asked"]["aside"]["knn"]["5"][0]) if told is None else float(told)

    def save(self, folder: Path) -> None:
        """Write ``METHOD.json`` atomically.

        Args:
            folder: folder of the results.
        """
        folder.mkdir(parents=True, exist_ok=True)
        told = {
            "method": self.method,
            "run": self.run.as_json(),
            "training_s": self.training_s,
            "images": self.images,
            "training_set": self.training_set,
            "ended": self.ended,
            "extra": self.extra,
            "curve": [[p.images, p.processor_s, p.loss, p.score] for p in self.curve],
            "answers": {
                name: {"xy": _plain(each.xy), "street": each.street.tolist()} for name, each in self.answers.items()
            },
        }
        part = folder / f"{self.method}.part"
        part.write_text(json.dumps(told) + "\n")
        part.rename(folder / f"{self.method}.json")

    @staticmethod
    def load(folder: Path, method: str) -> "MethodResult | None":
        """Load a result; return None if it does not exist.

        Args:
            folder: folder of the results.
            method: name of the method.
        """
        path = folder / f"{method}.json"
        if not path.exists():
            return None
        told = json.loads(path.read_text())
        answers = {
            name: PlaceAnswers(np.array(each["xy"], np.float64).reshape(-1, 2), np.array(each["street"], np.int64))
            for name, each in told["answers"].items()
        }
        return MethodResult(
            told["method"],
            answers,
            told["training_s"],
            told["images"],
            told["training_set"],
            told["ended"],
            [CurvePoint(int(a), b, c, d) for a, b, c, d in told["curve"]],
            told["extra"],
            Run(**told["run"]),
        )


def _plain(xy: NDArray[np.float64]) -> list[list[float | None]]:
    """Return rows of x and y rounded to the millimetre; null for no answer, since JSON has no NaN."""
    return [[round(float(v), 3) if np.isfinite(v) else None for v in row] for row in xy]
