"""Examples for the verifier: comparisons of poses with maps, each with the distance to the true position.

The localizer itself chooses the poses, so the wrong ones are those that look right to registration and to all other scores. No verifier
takes part in the choice (``EvenOdds``), so a training does not depend on an earlier one. Images of the city before are asked in the map of
a city: there every answer is wrong. Further poses start up to 8 m beside an answer and are adjusted to the map. They end in other minima
near the right one.
"""

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int8, UInt8
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.datasets.files import read_arrays
from model_training.evaluation.odometry import as_query
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.simulate import simulate
from model_training.verification.even_odds import EvenOdds
from model_training.verification.made_with import REMEDY, MadeWith
from model_training.verification.plans import verification_plan
from service.errors import DatasetError, NoDepthError
from service.geometry.rigid import heading_of_camera
from service.localization.localizer import Localizer
from service.localization.refine import measured_frames
from service.maps.reader import MapBundle
from service.registration.visibility import Raycasters
from service.scoring.candidates import Refined
from service.scoring.comparison import COLUMNS, PLANES, ROWS
from service.scoring.ray_evidence import RayPose, RayScorer

#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]
#: Origin of an example: the answer to a query, another candidate that was compared, or a pose beside the answer.
ANSWER, CANDIDATE, BESIDE = 0, 1, 2
#: Numbers of examples of a query besides its answer: other candidates, and poses beside the answer.
_CANDIDATES, _BESIDE = 2, 2
#: Smallest and largest distance of a start beside the answer, m, and share of them that lie along the street.
_BESIDE_M, _ALONG = (1.2, 8.0), 0.75
#: Query sets of the city before that are asked in the map of a city.
_FOREIGN_SETS = 2
#: Name of the folder with the cities and maps of unfinished examples: this word and what they are made with (``MadeWith.key``).
_UNFINISHED, _ANY_UNFINISHED = "unfinished", re.compile(r"unfinished-[0-9a-f]{12}-[0-9a-f]{16}")
#: Planes are stored with this many steps to each side of 0.
STEPS = 127


@dataclass(frozen=True, eq=False)
class Examples:
    """Examples of one city.

    Attributes:
        planes: comparisons, in steps of 1/127 (n, planes, rows, columns).
        error_m: horizontal distance of the pose from the true position, m; infinite on the map of another city (n,).
        origin: ``ANSWER``, ``CANDIDATE`` or ``BESIDE`` (n,).
    """

    planes: Int8[NDArray[np.int8], "n 12 64 128"]
    error_m: Float32[NDArray[np.float32], " n"]
    origin: UInt8[NDArray[np.uint8], " n"]

    def write(self, path: Path, made_with: MadeWith) -> None:
        """Write the examples atomically.

        Args:
            path: NPZ file.
            made_with: what the examples depend on.
        """
        part = path.with_suffix(".part.npz")
        arrays: dict[str, Any] = {"planes": self.planes, "error_m": self.error_m, "origin": self.origin}
        np.savez_compressed(part, **arrays | made_with.arrays())
        part.rename(path)

    @staticmethod
    def read(path: Path) -> "Examples":
        """Read examples.

        Args:
            path: NPZ file of ``write``.

        Raises:
            DatasetError: the file is missing or damaged.
        """

        def content() -> Examples:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return Examples(arrays["planes"], arrays["error_m"], arrays["origin"])

        return read_arrays(path, content, remedy=REMEDY)


def make_examples(work: Path, encoder: Path, cities: int, *, report: Report = lambda *_: None) -> Iterator[Path]:
    """Simulate cities, build their maps, localize the queries, and store what was compared; yield one file for each city.

    A finished file is not made again. Cities and maps are removed after their last use: a city takes half a gigabyte. What an interrupted
    run has left is used or removed.

    Args:
        work: folder of the examples.
        encoder: the encoder, ONNX.
        cities: number of cities.
        report: called after every frame, place and query.

    Raises:
        EncoderError: the encoder cannot be used.
        DatasetError: the folder has damaged examples, or those of another encoder or of another version of the code.
    """
    made_with = MadeWith.of(encoder)  # refuses a bad encoder before the work
    work.mkdir(parents=True, exist_ok=True)
    files = [work / f"examples-{k}.npz" for k in range(cities)]
    _require_made_with(made_with, work, [file for file in files if file.exists()])
    unfinished = work / f"{_UNFINISHED}-{made_with.key}"
    _clean(work, unfinished, files)
    before: Dataset | None = None
    for k, file in enumerate(files):
        if not _needs_city(files, k):
            _removed(before)
            before = None
            yield file
            continue
        city = _city(unfinished, k, report)
        if city is None:
            _joined([]).write(file, made_with)
        elif not file.exists():
            folder = _map_folder(unfinished, k)
            if not folder.exists():
                build_map(city, encoder, folder, BuildSettings(name=folder.name, calibration=None), report=report)
            localizer = Localizer.open(MapBundle.open(folder), verifier=EvenOdds())
            found = [*_examples(localizer, city, True, report)]
            if before is not None:
                found += _examples(localizer, before, False, report)
            _joined(found).write(file, made_with)
            shutil.rmtree(folder)
        _removed(before)
        before = city
        yield file
    _removed(before)
    _clean(work, unfinished, files)


def _require_made_with(made_with: MadeWith, work: Path, files: list[Path]) -> None:
    """Refuse finished files that other code or another encoder has made. A training would mix them with new ones."""
    others = {file.name: found for file in files if (found := MadeWith.read(file)) != made_with}
    if others:
        name, found = next(iter(others.items()))
        raise DatasetError(
            f"{work}: {len(others)} of {len(files)} files of examples cannot be used ({name} comes from {made_with.difference_to(found)}); "
            "choose another --work, or remove these files",
            field="work",
        )


def _needs_city(files: list[Path], index: int) -> bool:
    """Return whether the images of a city are needed: for its own examples, or for those on the map of the next city."""
    return not all(file.exists() for file in files[index : index + 2])


def _clean(work: Path, unfinished: Path, files: list[Path]) -> None:
    """Remove the cities and maps of other code or of another encoder, and those that no unfinished example needs."""
    for folder in list(work.iterdir()):
        if folder != unfinished and _ANY_UNFINISHED.fullmatch(folder.name):
            shutil.rmtree(folder)
    for k, file in enumerate(files):
        for folder, needed in (
            (_map_folder(unfinished, k), not file.exists()),
            (unfinished / verification_plan(k).name, _needs_city(files, k)),
        ):
            if folder.exists() and not needed:
                shutil.rmtree(folder)
    if unfinished.exists() and not any(unfinished.iterdir()):
        unfinished.rmdir()


def _map_folder(unfinished: Path, index: int) -> Path:
    return unfinished / f"map-{index}"


def _removed(city: Dataset | None) -> None:
    if city is not None:
        shutil.rmtree(city.folder)


def _city(unfinished: Path, index: int, report: Report) -> Dataset | None:
    """Simulate a city, or return None if its streets have no room for the queries."""
    plan = verification_plan(index)
    folder = unfinished / plan.name
    try:
        simulate(plan, folder, report=report)
    except DatasetError as error:
        if error.field != "queries":
            raise
        shutil.rmtree(folder)
        return None
    return Dataset(folder)


def _examples(localizer: Localizer, city: Dataset, own: bool, report: Report) -> Iterator[Examples]:
    """Yield the examples of the queries of a city.

    Args:
        localizer: of the map of this city, or of another one.
        city: the city.
        own: whether the map is that of this city.
        report: called after every query.
    """
    names = city.query_sets(with_truth=True)
    for name in names if own else names[:_FOREIGN_SETS]:
        frames = list(city.queries(name))
        for done, frame in enumerate(frames, 1):
            found = _of_query(localizer, frame, own)
            report(f"queries {name}" if own else f"queries of another city {name}", done, len(frames))
            if found is not None:
                yield found


def _of_query(localizer: Localizer, frame: QueryFrame, own: bool) -> Examples | None:
    (query,), _ = as_query([frame], np.random.default_rng(0), grid=localizer.bundle.grid, ranked=1)
    try:
        encoded = localizer.encode_and_search(query)
    except NoDepthError:
        return None
    refined, cloud = localizer.register((encoded,)).refined, localizer.bundle.cloud
    if refined is None or cloud is None:
        return None
    measured, settings = measured_frames(localizer.bundle, (encoded,), localizer.refining)
    rays = RayScorer(
        Raycasters(cloud, settings.rays), measured, settings.rays, settings.support.rays, settings.photometry, localizer.verifier
    )  # fmt: skip
    answer = refined.best.registered
    others = [each for each in refined.compared if each.pose is not answer][:_CANDIDATES]
    chosen = [each for each in refined.compared if each.pose is answer]
    beside = _beside(rays, refined) if own else []
    compared = [*chosen, *others, *beside]
    true_xy = None if frame.T_map_camera is None or not own else frame.T_map_camera[:2, 3]
    return Examples(
        planes=np.stack([np.rint(STEPS * rays.comparisons(each.pose)[0]).astype(np.int8) for each in compared]),
        error_m=np.array(
            [
                np.inf
                if true_xy is None
                else np.hypot(*(encoded.pose_of_camera(each.pose.T_map_level)[:2, 3] - true_xy))
                for each in compared
            ],
            np.float32,
        ),
        origin=np.repeat(np.array([ANSWER, CANDIDATE, BESIDE], np.uint8), [len(chosen), len(others), len(beside)]),
    )


def _beside(rays: RayScorer, refined: Refined) -> list[RayPose]:
    """Return poses that started beside the answer and were adjusted. The position of the answer decides the random numbers."""
    answer = refined.best.registered
    rng = np.random.default_rng(np.abs(answer.camera_m[:2] * 1e4).astype(np.int64))
    heading, found = heading_of_camera(refined.best.T_map_camera), []
    for _ in range(_BESIDE):
        step_m = float(rng.choice([-1, 1]) * np.exp(rng.uniform(*np.log(_BESIDE_M))))
        towards = heading if rng.random() < _ALONG else heading + np.pi / 2
        start = answer.camera_m + step_m * np.array([np.cos(towards), np.sin(towards), 0.0])
        found.append(rays.at(replace(answer, camera_m=start)))
    return found


def _joined(parts: list[Examples]) -> Examples:
    if not parts:
        return Examples(
            np.empty((0, len(PLANES), ROWS, COLUMNS), np.int8), np.empty(0, np.float32), np.empty(0, np.uint8)
        )
    return Examples(
        *(np.concatenate([getattr(part, name) for part in parts]) for name in Examples.__dataclass_fields__)
    )
