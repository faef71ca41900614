"""A learned baseline from its data to its answers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from model_training.baselines.answers import PlaceAnswers
from model_training.baselines.dual.encode import encoded_pictures, encoded_places
from model_training.baselines.dual.learn import BEST, Kind, LearnSettings, Lesson, learn, size_of, towers_of, views_of
from model_training.baselines.dual.lidar_views import LidarViews
from model_training.baselines.dual.pictures import Sweeps, pictures_of
from model_training.baselines.dual.towers import Towers
from model_training.baselines.gallery import answers_of, thinned
from model_training.baselines.paper_data.frames import Frames
from model_training.baselines.paper_data.pairs import Pairs
from service.imaging.view_grid import ViewGrid

SPACING_M = 1.0  # between the places that answers are chosen from


@dataclass(frozen=True, slots=True)
class DualResult:
    """Answers to each test; the training's processor time (s), images shown (both sides'), and its curve's file."""

    answers: dict[str, PlaceAnswers]
    processor_s: float
    images: int
    curve: Path


def run(
    frames: Frames, pairs: Pairs, tests: Mapping[str, Pairs], work: Path, *, kind: Kind, budget_s: float = 3600.0,
    report: Callable[[str, int, int], None] = lambda *_: None, settings: LearnSettings | None = None,
) -> DualResult:  # fmt: skip
    """Train the towers of a kind, or go on, and answer the tests by the best of their points.

    Args:
        frames: the LiDAR's side: what pictures are paired with, and the places of the answers.
        pairs: to learn from.
        tests: by name; of the pairs' camera.
        work: folder of the training.
        kind: ``dual`` sees whole panoramas, ``fov`` what a camera would see of them, at 24 headings a place.
        budget_s: processor seconds of the process for the training, those of earlier sessions included; so two trainings need
            two processes.
        report: told of the training (per mille of its budget) and of places encoded.
        settings: of the training; the best known by default.

    Raises:
        DatasetError: ``work`` is of other settings, or no pair was taken near a frame.
    """
    settings = settings or BEST[kind]
    grid, size = ViewGrid(), size_of(kind)
    pictures = pictures_of(pairs, size)
    views = views_of(kind, pictures.camera, grid)
    dense = Sweeps.of(frames, thinned(frames.places[:, :2], settings.frames_spacing_m))
    lesson = Lesson.of(pictures, np.array(pairs.views), dense, views, settings)
    training = learn(lesson, settings, work, budget_s=budget_s, report=report)
    towers = towers_of(settings, views)
    towers.load_state_dict(training.best()["towers"])
    towers = towers.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch documents it, its stub does not
    answers = answered(towers, views, frames, tests, settings, report)
    return DualResult(answers, training.curve[-1].processor_s, training.images, work / "curve.jsonl")


def answered(
    towers: Towers, views: LidarViews, frames: Frames, tests: Mapping[str, Pairs], settings: LearnSettings,
    report: Callable[[str, int, int], None],
) -> dict[str, PlaceAnswers]:  # fmt: skip
    """Answers to each test: the place with the most similar view, and the street that most of the five nearest lie in."""
    places = Sweeps.of(frames, thinned(frames.places[:, :2], SPACING_M))
    rows = np.arange(len(places))
    total = len(places) * views.headings
    known = encoded_places(towers, views, places, rows, lambda done: report(f"{settings.kind}: places", done, total))
    found = {}
    for name, test in tests.items():
        pictures = pictures_of(test, size_of(settings.kind))
        asked = encoded_pictures(towers, pictures, np.arange(len(test)))
        found[name] = answers_of(asked @ known.T, places.places[:, :2], places.street, views=views.headings)
    return found
