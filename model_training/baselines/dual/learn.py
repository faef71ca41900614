"""Training of two towers, within a budget: pairs of a picture and a frame near it, told from the batch's other places."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model_training.baselines.dual.encode import encoded_pictures, encoded_places
from model_training.baselines.dual.lidar_views import CameraField, LidarViews, WholePanorama
from model_training.baselines.dual.pairing import frames_near, watched
from model_training.baselines.dual.pictures import CAMERA_PLANES, FIELD, LIDAR_PLANES, WHOLE, Pictures, Sweeps
from model_training.baselines.dual.towers import Tower, Towers
from model_training.baselines.gallery import thinned
from model_training.baselines.learning import Report, Training, cosine_share, one_thread, set_rate
from model_training.training.losses import Side, paired_info_nce
from model_training.training.precision import Precision, forward_in, native_precision
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.imaging.view_grid import ViewGrid

Kind = Literal["dual", "fov"]
WATCH_SPACING_M, WATCH_REACH_M = {"dual": 1.0, "fov": 4.0}, 5.0


@dataclass(frozen=True, slots=True)
class LearnSettings:
    """Everything that decides what is learnt within a budget; kept beside the checkpoint.

    Pilots of 160 processor seconds on the paper city's 3,800 pairs of the survey's own drive, 198 of them kept back; recall at
    1 within 5 m after half of them, and at the end:

    ==================================  =====  =====
    ``dual``, 128 pairs, rate 2e-3      0.010  0.126
    ``dual``, 48 pairs, rate 1.5e-3     0.576  0.783
    ``fov``, 128 pairs, rate 2e-3       0.672  lost
    ``fov``, 48 pairs, rate 1.5e-3      0.636  0.919
    ``fov``, 128 pairs, NetVLAD head    0.005  0.086
    ==================================  =====  =====

    A full budget is 22 times as long, and a batch of 48 is soon too easy (loss 0.07 for ``fov``); so the batches are larger
    than the pilots' best, and the smaller rate stays. Panoramas keep the vehicle's heading: pictures look along it or against
    it, and a street all round says which way it runs; with a random heading that would have to be learnt.
    """

    kind: Kind
    pairs: int = 64  # of a batch
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-2
    warm_up_share: float = 0.03  # of the budget
    gradient_norm: float = 2.0
    largest_scale: float = 60.0
    turn_deg: float = 9.0  # between a picture and its LiDAR view, at most: a fan of 24 is off by up to 7.5
    frames_spacing_m: float = 0.5  # of the frames that pictures are paired with
    widths: tuple[int, ...] = (48, 96, 160)
    descriptor: int = 256
    points: int = 12  # of the curve
    precision: Precision = field(default_factory=native_precision)
    seed: int = 0


BEST = {"dual": LearnSettings("dual"), "fov": LearnSettings("fov", pairs=128)}


def size_of(kind: Kind) -> tuple[int, int]:
    """(height, width) of a picture as the camera's tower reads it."""
    return WHOLE if kind == "dual" else FIELD


def views_of(kind: Kind, camera: PinholeCamera, grid: ViewGrid) -> LidarViews:
    """How the LiDAR's tower is shown a place; ``camera`` is that of the pictures at ``size_of(kind)``."""
    return WholePanorama(grid) if kind == "dual" else CameraField(camera, grid)


def towers_of(settings: LearnSettings, views: LidarViews) -> Towers:
    """New towers of the chosen widths."""
    all_round = settings.kind == "dual"

    def tower(planes: int, size: tuple[int, int], *, around: bool = False) -> Tower:
        return Tower(
            planes, size, widths=settings.widths, patch_pair=not all_round, descriptor=settings.descriptor,
            around=around,
        )  # fmt: skip

    return Towers(tower(CAMERA_PLANES, size_of(settings.kind)), tower(LIDAR_PLANES, views.size, around=all_round))


@dataclass(frozen=True)
class Lesson:
    """What is learnt from: pictures with the frames near each, and those kept back with the places they are sought among."""

    pictures: Pictures
    views: LidarViews
    poses: NDArray[np.float64]  # (n, 4) of the pictures, as ``Pairs.views``
    sweeps: Sweeps
    near: list[NDArray[np.int64]]
    shown: NDArray[np.int64]
    kept_back: NDArray[np.int64]
    watch_places: NDArray[np.int64]  # of ``sweeps``

    @staticmethod
    def of(
        pictures: Pictures, poses: NDArray[np.float64], sweeps: Sweeps, views: LidarViews, settings: LearnSettings
    ) -> "Lesson":
        """Choose what is shown.

        Raises:
            DatasetError: no picture was taken near a frame.
        """
        near = frames_near(poses[:, :2], sweeps.places[:, :2])
        usable = np.array([k for k, rows in enumerate(near) if len(rows)], np.int64)
        if not len(usable):
            raise DatasetError("no pair was taken near a LiDAR frame; are they of one city?", field="pairs")
        held = watched(poses[usable, :2], np.random.default_rng([settings.seed, 1]))
        places = thinned(sweeps.places[:, :2], WATCH_SPACING_M[settings.kind])
        return Lesson(pictures, views, poses, sweeps, near, usable[~held], usable[held], places)

    def batches(
        self, settings: LearnSettings, rng: np.random.Generator
    ) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """For ever: planes and positions (B, 2) of pictures, and of a frame near each, drawn by chance."""
        turn = math.radians(settings.turn_deg)
        size = min(settings.pairs, len(self.shown))
        while True:
            order = rng.permutation(self.shown)
            for first in range(0, len(order) - size + 1, size):
                rows = order[first : first + size]
                frame = np.array([rng.choice(self.near[row]) for row in rows])
                heading = self.poses[rows, 2] - self.sweeps.places[frame, 2] + rng.uniform(-turn, turn, len(rows))
                yield (
                    self.pictures.planes(rows, rng), torch.from_numpy(self.poses[rows, :2]).float(),
                    self.views.planes(self.sweeps, frame, heading), torch.from_numpy(self.sweeps.places[frame, :2]).float(),
                )  # fmt: skip


def learn(lesson: Lesson, settings: LearnSettings, folder: Path, *, budget_s: float, report: Report) -> Training:
    """Train until the budget is spent, or go on with what a stopped run left; Ctrl-C loses what came after the last point.

    The learning rate rises, then falls to nothing along a cosine over the budget, so the run is not stopped for a score that
    rests on a plateau.
    """
    with one_thread():
        return _learn(lesson, settings, folder, budget_s, report)


def _learn(lesson: Lesson, settings: LearnSettings, folder: Path, budget_s: float, report: Report) -> Training:
    training = Training(folder, asdict(settings), budget_s=budget_s, patience=settings.points * 100)
    torch.manual_seed(settings.seed)
    towers = towers_of(settings, lesson.views).to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch documents it, its stub does not
    optimiser = torch.optim.AdamW(towers.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay)
    state = training.checkpoint()
    if state is not None:
        towers.load_state_dict(state["towers"])
        optimiser.load_state_dict(state["optimiser"])
    images, losses = training.images, list[float]()

    def point() -> None:
        state = {"towers": towers.state_dict(), "optimiser": optimiser.state_dict()}
        training.point(images, float(np.mean(losses)), watch_score(towers, lesson), state)
        losses.clear()

    for batch in lesson.batches(settings, np.random.default_rng([settings.seed, 2, images])):
        if (training.curve or losses) and training.ended is not None:  # a short budget buys a step too
            break
        set_rate(optimiser, settings.learning_rate * cosine_share(training.share_spent, warm_up=settings.warm_up_share))
        losses.append(step(towers.train(), optimiser, batch, settings))
        images += 2 * len(batch[0])
        report(settings.kind, round(1000 * training.share_spent), 1000)
        if training.share_spent >= _next_point(training, settings, budget_s):
            point()
    if losses:  # since the last point, where the budget ended while a batch was drawn
        point()
    return training


def step(
    towers: Towers, optimiser: torch.optim.Optimizer, batch: tuple[Tensor, Tensor, Tensor, Tensor], settings: LearnSettings
) -> float:  # fmt: skip
    """One step down the symmetric loss (CLIP's), places within 6 m of each other left out; returns it before the step."""
    planes, xy, views, views_xy = batch
    scale = towers.log_scale.exp().clamp(max=settings.largest_scale)
    with forward_in(settings.precision):
        pictures, places = towers.camera(planes), towers.lidar(views)
    each, _ = paired_info_nce(Side(pictures.float(), xy), Side(places.float(), views_xy), scale=scale)
    loss = each.mean()
    optimiser.zero_grad(set_to_none=True)
    loss.backward()  # type: ignore[no-untyped-call]  # torch's own stub leaves it untyped
    torch.nn.utils.clip_grad_norm_(towers.parameters(), settings.gradient_norm)
    optimiser.step()
    return float(loss.detach())


def watch_score(towers: Towers, lesson: Lesson) -> float:
    """Share of the pictures kept back whose best place lies within ``WATCH_REACH_M``, of places all over the drive."""
    rows = lesson.watch_places
    places = encoded_places(towers, lesson.views, lesson.sweeps, rows)
    pictures = encoded_pictures(towers, lesson.pictures, lesson.kept_back)
    xy = lesson.sweeps.places[rows, :2]
    best = (pictures @ places.T).reshape(len(pictures), len(rows), -1).max(axis=2).argmax(axis=1)
    away = np.linalg.norm(xy[best] - lesson.poses[lesson.kept_back, :2], axis=1)
    return float(np.mean(away <= WATCH_REACH_M))


def _next_point(training: Training, settings: LearnSettings, budget_s: float) -> float:
    """Share of the budget at which the curve gets its next point."""
    last_s = training.curve[-1].processor_s if training.curve else 0.0
    return min(1.0, (math.floor(settings.points * last_s / budget_s) + 1) / settings.points)
