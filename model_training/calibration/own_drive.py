"""Labelled frames from a recording of the robot itself: ``streetfix calibrate --map M --drive DATASET``.

Each image pair is one query. Ground truth labels its answer, else the odometry does (``odometry_labels``). Each in-map frame
is localized a second time, in the map without the places around it (``elsewhere``). So the same images also show the confidence of
out-of-map queries of this rig.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.calibration.elsewhere import is_outside, without_surroundings
from model_training.calibration.labelled_frames import LabelledFrames, blocks_of, frames_of, joined_frames
from model_training.calibration.odometry_labels import LABEL_NOISE, MARGIN, Labels, labels_by_odometry
from model_training.datasets.dataset import ODOMETRY_FILE, Dataset, QueryFrame, query_folder
from model_training.evaluation.predict import in_order
from service.errors import DatasetError, NoDepthError
from service.localization.answer import Answer
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.maps.rig_key import RigKey

#: Largest number of frames that are localized a second time, evenly spread over a query set.
MOST_ELSEWHERE = 300
#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class DriveFrames:
    """Labelled frames of a recording, and what they come from.

    Attributes:
        frames: the labelled frames. Out-of-map frames are those of the recording and those in the map without their surroundings.
        label_noise: share of wrong labels.
        described: description of the recording for readers.
        unlabelled: number of images without a label.
        unregistered: number of images with too few points to register.
        name: name of the recording, and of its camera if one was chosen.
        rig: the rig of the images.
    """

    frames: LabelledFrames
    label_noise: float
    described: str
    unlabelled: int
    unregistered: int
    name: str
    rig: RigKey


def images_of_drive(dataset: Dataset, names: Sequence[str], camera: str | None = None) -> list[QueryFrame]:
    """Return the images of a recording that ``frames_of_drive`` labels, of one rig.

    Args:
        dataset: the recording.
        names: names of the query sets; empty for all.
        camera: name of a camera in ``dataset.json``; None for all, which must then be one rig.

    Raises:
        DatasetError: there are no query sets or no images, no image is of the camera, or the images come from several rigs.
    """
    names = list(names) or dataset.query_sets()
    if not names:
        raise DatasetError(f"{dataset.folder} has no query sets; import the recording with its images", field="queries")
    images = list[QueryFrame]()
    for name in names:
        found = list(dataset.queries(name))
        if not found:
            folder = query_folder(dataset.folder, name)
            raise DatasetError(f"{folder} has no images; choose another set with --queries", field="queries")
        images += found
    known = {each.camera.name: rig_of(each) for each in images}
    if camera is not None and camera not in known:
        raise DatasetError(
            f"--camera: no image of {', '.join(names)} is of the camera {camera!r}; choose one of {', '.join(known)}",
            field="camera",
        )
    chosen = [each for each in images if camera in (None, each.camera.name)]
    first = rig_of(chosen[0])
    if any(not first.is_same(rig) for name, rig in known.items() if camera in (None, name)):
        rigs = "; ".join(f"{name}: {rig.described()}" for name, rig in known.items())
        raise DatasetError(
            f"{dataset.folder}: the images come from several rigs ({rigs}), and a correction is for one; choose one with --camera",
            field="camera",
        )
    return chosen


def rig_of(frame: QueryFrame) -> RigKey:
    """Return the rig of an image, as its query states it.

    Args:
        frame: the image.
    """
    depth = frame.camera.depth
    return RigKey.of(frame.camera.pinhole(), baseline_m=depth.baseline_m, max_range_m=depth.max_range_m)


def frames_of_drive(
    localizer: Localizer,
    dataset: Dataset,
    names: Sequence[str],
    *,
    odometry_noise: float,
    camera: str | None = None,
    most_elsewhere: int | None = MOST_ELSEWHERE,
    workers: int = 2,
    report: Report = lambda *_: None,
) -> DriveFrames:
    """Localize and label the images of a recording.

    Args:
        localizer: localizer of the map.
        dataset: the recording, in the map frame.
        names: names of the query sets; empty for all.
        odometry_noise: standard deviation of the odometry's end point, as a share of the travelled distance. Ground truth needs none.
        camera: name of the camera whose images count; None for all, which must then be one rig.
        most_elsewhere: largest number of images of a query set that are localized a second time; None for all.
        workers: number of queries that are localized at the same time.
        report: called after every query.

    Raises:
        DatasetError: as ``images_of_drive``, or a set has neither ground truth nor odometry, or its odometry lacks a line.
    """
    rig = rig_of(images_of_drive(dataset, names, camera)[0])
    names = list(names) or dataset.query_sets()
    sets = [found for name in names if (found := _QuerySet.of(dataset, name, camera)).frames]
    names = [each.name for each in sets]
    parts, unlabelled, unregistered, outside = list[LabelledFrames](), 0, 0, 0
    for each in sets:
        answers = _answers(f"queries {each.name}", [(frame, localizer) for frame in each.frames], workers, report)
        labels = each.labels(answers, odometry_noise)
        is_out = is_outside(localizer.bundle.T_map_place[:, :2, 3], labels.reference_xy, MARGIN * labels.sigma_m)
        labelled = labels.right | labels.wrong
        evidence = [None if answer is None else answer.evidence for answer in answers]
        unlabelled += int((~labelled).sum())
        unregistered += sum(1 for row, known in zip(evidence, labelled, strict=True) if row is None and known)
        outside += int((is_out & labelled).sum())
        block = blocks_of(len(answers))
        of_label = [row if known else None for row, known in zip(evidence, labelled, strict=True)]
        parts.append(frames_of(of_label, labels.right, is_out, block))
        parts.append(_elsewhere(localizer, each, labels, is_out, block, most_elsewhere, workers, report))
    how = {True: "ground truth", False: "odometry"}
    sources = " and ".join(dict.fromkeys(how[each.has_truth] for each in sets))
    noise = 0.0 if all(each.has_truth for each in sets) else LABEL_NOISE
    described = f"{dataset.name}, {', '.join(names)}, labelled by {sources}, {outside} images from outside the map"
    named = dataset.name if camera is None else f"{dataset.name} {camera}"
    return DriveFrames(joined_frames(parts), noise, described, unlabelled, unregistered, named, rig)


@dataclass(frozen=True, eq=False)
class _QuerySet:
    """Images of a query set with ground truth or odometry, a pose per image (n, 4, 4)."""

    name: str
    frames: list[QueryFrame]
    poses: NDArray[np.float64]
    has_truth: bool

    @classmethod
    def of(cls, dataset: Dataset, name: str, camera: str | None) -> "_QuerySet":
        """Read a query set; it has no frames if no image is of the camera."""
        frames = [frame for frame in dataset.queries(name) if camera in (None, frame.camera.name)]
        folder = query_folder(dataset.folder, name)
        if not frames:
            return cls(name, frames, np.zeros((0, 4, 4)), True)
        truth = [frame.T_map_camera for frame in frames if frame.T_map_camera is not None]
        if truth:
            return cls(name, frames, np.array(truth), True)
        odometry = dataset.odometry(name)
        if odometry is None:
            raise DatasetError(
                f"{folder} has neither poses.txt nor {ODOMETRY_FILE}, so nothing labels its answers; add one of them: "
                f"poses.txt with T_map_camera (ground truth) or {ODOMETRY_FILE} with T_odom_camera (drift is allowed), TUM "
                "format, a line per image",
                field="queries",
            )
        if frames[-1].number >= len(odometry):
            raise DatasetError(
                f"{folder / ODOMETRY_FILE} has {len(odometry)} lines, none for {frames[-1].rgb_path.name}; write a line per image",
                field=ODOMETRY_FILE,
            )
        return cls(name, frames, odometry[[frame.number for frame in frames]], False)

    def labels(self, answers: list[Answer | None], odometry_noise: float) -> Labels:
        """Return the labels of the answers; ground truth is exact and labels all."""
        T_answer, covariance = np.full((len(answers), 4, 4), np.nan), np.full((len(answers), 6, 6), np.nan)
        for k, answer in enumerate(answers):
            if answer is not None and answer.evidence is not None:
                T_answer[k] = answer.T_map_camera_guess
                if answer.covariance is not None:
                    covariance[k] = answer.covariance
        if not self.has_truth:
            return labels_by_odometry(T_answer, covariance, self.poses, odometry_noise)
        true_xy = self.poses[:, :2, 3]
        right = np.linalg.norm(T_answer[:, :2, 3] - true_xy, axis=1) <= RIGHT_M  # NaN compares as False
        return Labels(right, ~right, true_xy, np.zeros(len(answers)))


def _elsewhere(
    localizer: Localizer,
    query_set: _QuerySet,
    labels: Labels,
    is_out: NDArray[np.bool_],
    block: NDArray[np.int64],
    most: int | None,
    workers: int,
    report: Report,
) -> LabelledFrames:
    """Ask frames in the map again, in the map without the places around them."""
    rows = _spread(np.flatnonzero(np.isfinite(labels.sigma_m) & ~is_out), most)
    rests = [without_surroundings(localizer, labels.reference_xy[k]) for k in rows]
    pairs = [(query_set.frames[k], rest) for k, rest in zip(rows, rests, strict=True) if rest is not None]
    answers = _answers(f"out-of-map {query_set.name}", pairs, workers, report)
    evidence = [None if answer is None else answer.evidence for answer in answers]
    blocks = block[rows][[rest is not None for rest in rests]]
    return frames_of(evidence, np.zeros(len(pairs), bool), np.ones(len(pairs), bool), blocks)


def _spread(rows: NDArray[np.int64], most: int | None) -> NDArray[np.int64]:
    """Return at most this number of the rows, evenly spread."""
    count = len(rows) if most is None else min(len(rows), most)
    return rows[np.linspace(0, len(rows) - 1, count).astype(int)] if count else rows


def _answers(
    stage: str, pairs: list[tuple[QueryFrame, Localizer]], workers: int, report: Report
) -> list[Answer | None]:
    """Localize images, each by its own localizer; None for an image without depth in the view grid."""

    def ask(pair: tuple[QueryFrame, Localizer]) -> Answer | None:
        frame, localizer = pair
        try:
            return localizer.localize(frame.query(localizer.bundle.grid))
        except NoDepthError:
            return None

    found = list[Answer | None]()
    with ThreadPoolExecutor(workers) as pool:
        for answer in in_order(pool, ask, pairs, ahead=4 * workers):
            found.append(answer)
            report(stage, len(found), len(pairs))
    return found
