"""A learned baseline from its data to its answers."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from research.baselines.answers import PlaceAnswers
from research.baselines.dual.encode import encoded_pictures, encoded_places
from research.baselines.dual.learn import BEST, Kind, LearnSettings, Lesson, learn, size_of, towers_of, views_of
from research.baselines.dual.lidar_views import LidarViews
from research.baselines.dual.pictures import Sweeps, pictures_of
from research.baselines.dual.towers import Towers
from research.baselines.gallery import answers_of, thinned
from research.baselines.paper_data.frames import Frames
from research.baselines.paper_data.pairs import Pairs
from service.imaging.view_grid import ViewGrid

#: Spacing of the places that can be answered, metres.
SPACING_M = 1.0


@dataclass(frozen=True, slots=True)
class DualResult:
    """Answers and cost of a dual encoder.

    Attributes:
        answers: answers by test.
        processor_s: processor time of the training, seconds.
        images: images shown in training, of both sides.
        curve: file of the training curve.
    """

    answers: dict[str, PlaceAnswers]
    processor_s: float
    images: int
    curve: Path


def run(
    frames: Frames,
    pairs: Pairs,
    tests: Mapping[str, Pairs],
    work: Path,
    *,
    kind: Kind,
    budget_s: float = 3600.0,
    report: Callable[[str, int, int], None] = lambda *_: None,
    settings: LearnSettings | None = None,
) -> DualResult:
    """Train the towers of a kind, or resume, and answer the tests by the best checkpoint.

    Args:
        frames: LiDAR frames, the partners of the images and the places of the answers.
        pairs: RGB-D training pairs.
        tests: RGB-D queries by name, from the camera of ``pairs``.
        work: folder of the training.
        kind: ``dual`` sees whole panoramas; ``fov`` sees a camera's field of view at 24 headings per place.
        budget_s: training budget, processor seconds of this process and of earlier ones; two trainings need two
            processes.
        report: receives the progress of the training (per mille of the budget) and of the encoded places.
        settings: settings of the training; the best known by default.

    Raises:
        DatasetError: ``work`` belongs to other settings, or no pair is near a frame.
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
    towers: Towers,
    views: LidarViews,
    frames: Frames,
    tests: Mapping[str, Pairs],
    settings: LearnSettings,
    report: Callable[[str, int, int], None],
) -> dict[str, PlaceAnswers]:
    """Answer each test: the place with the most similar view, and the majority street of the five nearest places.

    Args:
        towers: trained towers.
        views: views of a place for the LiDAR tower.
        frames: LiDAR frames, the places of the answers.
        tests: RGB-D queries by name.
        settings: settings of the training.
        report: receives a label, the number of encoded views and their total.
    """
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
