"""Training of two towers within a budget: pairs of an image and a near frame, against the other places of the batch."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from model_training.training.losses import Side, paired_info_nce
from model_training.training.precision import Precision, forward_in, native_precision
from research.baselines.dual.encode import encoded_pictures, encoded_places
from research.baselines.dual.lidar_views import CameraField, LidarViews, WholePanorama
from research.baselines.dual.pairing import frames_near, watched
from research.baselines.dual.pictures import CAMERA_PLANES, FIELD, LIDAR_PLANES, WHOLE, Pictures, Sweeps
from research.baselines.dual.towers import Tower, Towers
from research.baselines.gallery import thinned
from research.baselines.learning import Report, Training, cosine_share, one_thread, set_rate
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.imaging.view_grid import ViewGrid

Kind = Literal["dual", "fov"]
WATCH_SPACING_M, WATCH_REACH_M = {"dual": 1.0, "fov": 4.0}, 5.0


@dataclass(frozen=True, slots=True)
class LearnSettings:
    """All settings that determine the result of a training; kept beside the checkpoint.

    The table gives pilots of 160 processor seconds on the paper city's 3,800 pairs of the survey traversal, 198 of them
    held out. The figures are recall at 1 within 5 m, after half of the pilot and at its end:

    ==================================  =====  =====
    ``dual``, 128 pairs, rate 2e-3      0.010  0.126
    ``dual``, 48 pairs, rate 1.5e-3     0.576  0.783
    ``fov``, 128 pairs, rate 2e-3       0.672  lost
    ``fov``, 48 pairs, rate 1.5e-3      0.636  0.919
    ``fov``, 128 pairs, NetVLAD head    0.005  0.086
    ==================================  =====  =====

    A full budget is 22 times as long. A batch of 48 then becomes too easy (loss 0.07 for ``fov``). So the batches are
    larger than the pilots' best, and the smaller rate stays. Panoramas keep the vehicle's heading. Images look along it
    or against it, and a panorama of a street shows its direction. With a random heading the network would have to learn
    this.

    Attributes:
        kind: ``dual`` or ``fov``.
        pairs: pairs per batch.
        learning_rate: largest learning rate of AdamW.
        weight_decay: weight decay of AdamW.
        warm_up_share: share of the budget for the warm-up.
        gradient_norm: limit of the gradient norm.
        largest_scale: limit of the inverse temperature.
        turn_deg: largest turn between an image and its LiDAR view, degrees; the nearest of 24 headings is off by up to
            7.5.
        frames_spacing_m: spacing of the frames that are paired with images, metres.
        widths: channels of the patches and of each stage of a tower.
        descriptor: size of the descriptor.
        points: number of points of the curve.
        precision: precision of the forward pass.
        seed: seed of weights and batches.
    """

    kind: Kind
    pairs: int = 64
    learning_rate: float = 1.5e-3
    weight_decay: float = 1e-2
    warm_up_share: float = 0.03
    gradient_norm: float = 2.0
    largest_scale: float = 60.0
    turn_deg: float = 9.0
    frames_spacing_m: float = 0.5
    widths: tuple[int, ...] = (48, 96, 160)
    descriptor: int = 256
    points: int = 12
    precision: Precision = field(default_factory=native_precision)
    seed: int = 0


BEST = {"dual": LearnSettings("dual"), "fov": LearnSettings("fov", pairs=128)}


def size_of(kind: Kind) -> tuple[int, int]:
    """Return the size (height, width) of an image for the camera tower, pixels.

    Args:
        kind: ``dual`` or ``fov``.
    """
    return WHOLE if kind == "dual" else FIELD


def views_of(kind: Kind, camera: PinholeCamera, grid: ViewGrid) -> LidarViews:
    """Return the views of a place for the LiDAR tower.

    Args:
        kind: ``dual`` or ``fov``.
        camera: camera of the images at ``size_of(kind)``.
        grid: view grid of the panoramas.
    """
    return WholePanorama(grid) if kind == "dual" else CameraField(camera, grid)


def towers_of(settings: LearnSettings, views: LidarViews) -> Towers:
    """Create new towers of the chosen widths.

    Args:
        settings: settings of the training.
        views: views of a place for the LiDAR tower.
    """
    all_round = settings.kind == "dual"

    def tower(planes: int, size: tuple[int, int], *, around: bool = False) -> Tower:
        return Tower(
            planes,
            size,
            widths=settings.widths,
            patch_pair=not all_round,
            descriptor=settings.descriptor,
            around=around,
        )

    return Towers(tower(CAMERA_PLANES, size_of(settings.kind)), tower(LIDAR_PLANES, views.size, around=all_round))


@dataclass(frozen=True)
class Lesson:
    """Training data: images with the frames near each, and held-out images with the places to search.

    Attributes:
        pictures: all images.
        views: views of a place for the LiDAR tower.
        poses: poses of the images (n, 4), as in ``Pairs.views``.
        sweeps: LiDAR frames.
        near: for each image, the rows of ``sweeps`` near it.
        shown: rows of the training images.
        kept_back: rows of the held-out images.
        watch_places: rows of ``sweeps`` that the validation searches.
    """

    pictures: Pictures
    views: LidarViews
    poses: NDArray[np.float64]
    sweeps: Sweeps
    near: list[NDArray[np.int64]]
    shown: NDArray[np.int64]
    kept_back: NDArray[np.int64]
    watch_places: NDArray[np.int64]

    @staticmethod
    def of(
        pictures: Pictures, poses: NDArray[np.float64], sweeps: Sweeps, views: LidarViews, settings: LearnSettings
    ) -> "Lesson":
        """Split the images into training and held-out images.

        Args:
            pictures: all images.
            poses: poses of the images (n, 4), as in ``Pairs.views``.
            sweeps: LiDAR frames.
            views: views of a place for the LiDAR tower.
            settings: settings of the training.

        Raises:
            DatasetError: no image is near a frame.
        """
        near = frames_near(poses[:, :2], sweeps.places[:, :2])
        usable = np.array([k for k, rows in enumerate(near) if len(rows)], np.int64)
        if not len(usable):
            raise DatasetError("no pair is near a LiDAR frame; check that both belong to the same city", field="pairs")
        held = watched(poses[usable, :2], np.random.default_rng([settings.seed, 1]))
        places = thinned(sweeps.places[:, :2], WATCH_SPACING_M[settings.kind])
        return Lesson(pictures, views, poses, sweeps, near, usable[~held], usable[held], places)

    def batches(
        self, settings: LearnSettings, rng: np.random.Generator
    ) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Yield batches without end: planes and positions (B, 2) of images, and of a random near frame for each.

        Args:
            settings: settings of the training.
            rng: source of randomness.
        """
        turn = math.radians(settings.turn_deg)
        size = min(settings.pairs, len(self.shown))
        while True:
            order = rng.permutation(self.shown)
            for first in range(0, len(order) - size + 1, size):
                rows = order[first : first + size]
                frame = np.array([rng.choice(self.near[row]) for row in rows])
                heading = self.poses[rows, 2] - self.sweeps.places[frame, 2] + rng.uniform(-turn, turn, len(rows))
                yield (
                    self.pictures.planes(rows, rng),
                    torch.from_numpy(self.poses[rows, :2]).float(),
                    self.views.planes(self.sweeps, frame, heading),
                    torch.from_numpy(self.sweeps.places[frame, :2]).float(),
                )


def learn(lesson: Lesson, settings: LearnSettings, folder: Path, *, budget_s: float, report: Report) -> Training:
    """Train until the budget is spent, or resume a stopped run; Ctrl-C loses the work after the last point.

    The learning rate rises, then falls to zero along a cosine over the budget. The run therefore does not stop at a
    plateau of the score.

    Args:
        lesson: training data.
        settings: settings of the training.
        folder: folder of the run.
        budget_s: budget, processor seconds.
        report: receives the kind and the progress per mille.
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
        if (training.curve or losses) and training.ended is not None:  # even a short budget gets one step
            break
        set_rate(optimiser, settings.learning_rate * cosine_share(training.share_spent, warm_up=settings.warm_up_share))
        losses.append(step(towers.train(), optimiser, batch, settings))
        images += 2 * len(batch[0])
        report(settings.kind, round(1000 * training.share_spent), 1000)
        if training.share_spent >= _next_point(training, settings, budget_s):
            point()
    if losses:  # losses since the last point: the budget ended while a batch was drawn
        point()
    return training


def step(
    towers: Towers,
    optimiser: torch.optim.Optimizer,
    batch: tuple[Tensor, Tensor, Tensor, Tensor],
    settings: LearnSettings,
) -> float:
    """Take a step on the symmetric loss of CLIP, without negatives within 6 m; return the loss before the step.

    Args:
        towers: towers in training.
        optimiser: optimiser of the towers.
        batch: planes and positions of images and of views, as ``Lesson.batches`` yields them.
        settings: settings of the training.
    """
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
    """Return the share of held-out images whose best place is within ``WATCH_REACH_M``, among places of the whole traversal.

    Args:
        towers: towers in training.
        lesson: training data.
    """
    rows = lesson.watch_places
    places = encoded_places(towers, lesson.views, lesson.sweeps, rows)
    pictures = encoded_pictures(towers, lesson.pictures, lesson.kept_back)
    xy = lesson.sweeps.places[rows, :2]
    best = (pictures @ places.T).reshape(len(pictures), len(rows), -1).max(axis=2).argmax(axis=1)
    away = np.linalg.norm(xy[best] - lesson.poses[lesson.kept_back, :2], axis=1)
    return float(np.mean(away <= WATCH_REACH_M))


def _next_point(training: Training, settings: LearnSettings, budget_s: float) -> float:
    """Return the share of the budget at which the curve gets its next point."""
    last_s = training.curve[-1].processor_s if training.curve else 0.0
    return min(1.0, (math.floor(settings.points * last_s / budget_s) + 1) / settings.points)
