"""Localize the queries of the calibration cities and fit the calibration. Cities, maps and answers are stored and reused."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model_training.calibration.collect import in_the_map, of_another_city, walls_and_rooms, where_streets_are_missing
from model_training.calibration.fit import Asked, expected_calibration_error, fit, pooled
from model_training.calibration.plans import (
    CITIES,
    PAIR_CITIES,
    PAIR_RIGS,
    PairRig,
    calibration_plan,
    pair_plan,
    repeating_plan,
)
from model_training.calibration.rigs import RIGS, Rig
from model_training.calibration.strangers import KINDS
from model_training.datasets.dataset import Dataset
from model_training.datasets.files import read_arrays
from model_training.datasets.without_streets import WithoutStreets
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.simulate import simulate
from service.localization.localizer import Localizer
from service.maps.calibration import Calibration
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder

#: The query sets of the clear day.
CLEAR_SETS = ("clear_precise", "clear_stereo")
#: Spacing of a map, and of a map from a sparse survey, metres. In a sparse map queries are less similar to the places. The confidence
#: must not take them for out-of-map queries (decision 0038).
PLACES_M, SPARSE_M = 1.0, 5.0
#: Kinds of out-of-map queries, without their depth preset.
STRANGERS = ("other_city", "removed_streets", *KINDS)
#: Progress callback: stage, finished steps, all steps.
Report = Callable[[str, int, int], None]


def calibrate(
    work: Path, encoder: Path, *, anew: bool = False, report: Report = lambda *_: None
) -> tuple[Calibration, list[str]]:
    """Fit the confidence for an encoder.

    Args:
        work: folder of cities, maps and answers. The maps and answers of this encoder are reused.
        encoder: the encoder, ONNX.
        anew: localize the queries again, for example after a change of the code.
        report: called after every frame, place and query.

    Raises:
        EncoderError: the encoder cannot be used.
        DatasetError: the data lack right answers, wrong answers, queries in the map or out-of-map queries.

    Returns:
        The calibration, and lines of text on how well each city is predicted from the others.
    """
    sha256 = Encoder.open(encoder).sha256  # refuse a bad encoder before the work
    cities = []
    for index in range(CITIES):
        plan = calibration_plan(index)
        simulate(plan, work / plan.name, report=report)
        cities.append(Dataset(work / plan.name))
    parts = [_asked(work, encoder, cities, k, anew=anew, report=report) for k in range(CITIES)]
    pairs = [_asked_pairs(work, encoder, rig, anew=anew, report=report) for rig in PAIR_RIGS]
    street = repeating_plan()
    simulate(street, work / street.name, report=report)
    alike = _asked_repeating(work, encoder, Dataset(work / street.name), anew=anew, report=report)
    measured_on: dict[str, str | float] = {
        "cities": ", ".join(f"seed {city.description.seed}" for city in cities)
        + f", repeating blocks of seed {street.seed}"
        + "".join(f", {rig.name} of seed {pair_plan(rig, k).seed}" for rig in PAIR_RIGS for k in range(PAIR_CITIES)),
        "encoder_sha256": sha256,
    }
    return fit(pooled([*parts, *pairs, alike]), measured_on=measured_on), cross_checks(parts, pooled([*pairs, alike]))


def _localizer(
    work: Path, encoder: Path, dataset: Dataset, name: str, report: Report, *, spacing_m: float = PLACES_M
) -> Localizer:
    folder = work / "maps" / f"{name}-{Encoder.open(encoder).sha256[:12]}"
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        build_map(
            dataset, encoder, folder, BuildSettings(name=name, calibration=None, spacing_m=spacing_m), report=report
        )
    return Localizer.open(MapBundle.open(folder))


def _sparse(work: Path, encoder: Path, dataset: Dataset, report: Report) -> Localizer:
    return _localizer(work, encoder, dataset, f"{dataset.name}-sparse", report, spacing_m=SPARSE_M)


def _asked(work: Path, encoder: Path, cities: list[Dataset], index: int, *, anew: bool, report: Report) -> Asked:
    """Return the calibration data of one city.

    Its queries are localized in its own map, in the map of the next city, and in sparse maps of both. They are also localized in its own
    map without a third of the streets. Walls and rooms are added.
    """
    return _kept(work, encoder, cities[index], lambda: _ask(work, encoder, cities, index, report), anew=anew)


def _asked_pairs(work: Path, encoder: Path, rig: PairRig, *, anew: bool, report: Report) -> Asked:
    """Return the calibration data of a stereo rig: queries of its cities in their own and each other's maps, and walls and rooms."""
    cities = []
    for index in range(PAIR_CITIES):
        plan = pair_plan(rig, index)
        simulate(plan, work / plan.name, report=report)
        cities.append(Dataset(work / plan.name))

    def ask() -> list[Asked]:
        found = []
        of_rig = Rig(rig.name, 1.0, 1.0, stereo=False)
        for index, own in enumerate(cities):
            other = cities[(index + 1) % PAIR_CITIES]
            here = _localizer(work, encoder, own, own.name, report)
            found += in_the_map(here, own, report, rig=of_rig)
            found += of_another_city(_localizer(work, encoder, other, other.name, report), own, report, rig=of_rig)
        walls_by = Rig(rig.name, 1.0, 1.0, stereo=True)
        return found + walls_and_rooms(
            here, cities[-1].description.sensors.cameras[0].pinhole(), PAIR_RIGS.index(rig), report, rig=walls_by
        )

    return _kept(work, encoder, cities[0], ask, anew=anew)


def _asked_repeating(work: Path, encoder: Path, street: Dataset, *, anew: bool, report: Report) -> Asked:
    """Return the calibration data of a street with repeating blocks, where wrong places look right: single queries and sequences."""

    def ask() -> list[Asked]:
        return in_the_map(_localizer(work, encoder, street, street.name, report), street, report)

    return _kept(work, encoder, street, ask, anew=anew)


def _kept(work: Path, encoder: Path, city: Dataset, ask: Callable[[], list[Asked]], *, anew: bool) -> Asked:
    """Return the stored calibration data of an earlier run, or compute and store them."""
    kept = work / f"asked-{city.name}-{Encoder.open(encoder).sha256[:12]}.npz"
    if not kept.exists() or anew:
        asked, part = pooled(ask()), kept.with_suffix(".part.npz")
        np.savez_compressed(part, **{name: getattr(asked, name) for name in Asked.__dataclass_fields__})
        part.rename(kept)

    def read() -> Asked:
        with kept.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return Asked(*(arrays[name] for name in Asked.__dataclass_fields__))

    return read_arrays(kept, read, remedy="remove it, and the command sends its queries again")


def _ask(work: Path, encoder: Path, cities: list[Dataset], index: int, report: Report) -> list[Asked]:
    own, other = cities[index], cities[(index + 1) % len(cities)]
    partial = WithoutStreets(own.folder)
    here = _localizer(work, encoder, own, own.name, report)
    elsewhere = _localizer(work, encoder, other, other.name, report)
    camera = own.description.sensors.cameras[0].pinhole()
    found = in_the_map(here, own, report)
    found += walls_and_rooms(here, camera, index, report)
    found += of_another_city(elsewhere, own, report)
    for rig in RIGS:
        found += in_the_map(here, own, report, CLEAR_SETS, rig=rig)
        found += walls_and_rooms(here, camera, index, report, rig=rig)
        found += of_another_city(elsewhere, own, report, CLEAR_SETS, rig=rig)
    found += in_the_map(_sparse(work, encoder, own, report), own, report, CLEAR_SETS)
    found += of_another_city(_sparse(work, encoder, other, report), own, report, CLEAR_SETS)
    without = _localizer(work, encoder, partial, f"{own.name}-without-streets", report)
    return found + where_streets_are_missing(without, own, list(CLEAR_SETS), partial.is_outside, report)


def cross_checks(parts: list[Asked], alike: Asked) -> list[str]:
    """Return lines of text on how well each city is predicted from the others.

    These figures show how well the calibration transfers to unseen cities.

    Args:
        parts: calibration data of each city.
        alike: further data that take part in every fit: the stereo rigs and the repeating blocks.
    """
    lines = []
    for index, held_out in enumerate(parts):
        calibration = fit(pooled([alike, *(part for k, part in enumerate(parts) if k != index)]), measured_on={})
        confidence = confidences(calibration, held_out)
        error = expected_calibration_error(confidence, held_out.right)
        lines.append(f"city {index + 1} from the others: expected calibration error {error:.4f}")
        for preset in ("precise", "stereo"):
            inside = held_out.known & held_out.right & np.char.endswith(held_out.kind, preset)
            accepted = np.quantile(confidence[inside], 0.05)
            shares = (
                f"{kind} {np.mean(confidence[held_out.kind == f'{kind}.{preset}'] >= accepted):.4f}"
                for kind in STRANGERS
            )
            lines.append(f"  {preset}: false accepts at 95 % of the true ones: {', '.join(shares)}")
    return lines


def confidences(calibration: Calibration, asked: Asked) -> NDArray[np.float64]:
    """Compute the confidence of every row (n,); 0 without registration.

    Args:
        calibration: the calibration.
        asked: the data.
    """
    found = np.zeros(len(asked))
    has = np.isfinite(asked.evidence).all(axis=1)
    found[has] = calibration.confidence(asked.evidence[has])
    return found
