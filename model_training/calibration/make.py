"""Localize the queries of the calibration cities and fit the calibration. Cities, maps and answers are stored and reused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from model_training.calibration.answer_code import code_of_answers
from model_training.calibration.collect import in_the_map, of_another_city, walls_and_rooms, where_streets_are_missing
from model_training.calibration.cross_check import cross_check, table
from model_training.calibration.families import FAMILIES, FAMILY_CITIES, NOT_FITTED, Family, family_plan
from model_training.calibration.fit import CalibrationData, fit, pooled
from model_training.calibration.plans import BOTH, CITIES, calibration_plan, repeating_plan
from model_training.calibration.rigs import RIGS, Rig
from model_training.datasets.dataset import Dataset
from model_training.datasets.files import read_arrays
from model_training.datasets.without_streets import WithoutStreets
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.depth_noise import DEPTHS
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.simulate import simulate
from service.localization.localizer import Localizer
from service.maps.calibration import Calibration
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder

#: Name of the version of the code in a file of answers, and what to do with a damaged file.
_CODE, _REMEDY = "code", "remove it, and the command sends its queries again"
#: The query sets of the clear day.
CLEAR_SETS = ("clear_precise", "clear_stereo")
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
        The calibration, and lines of text on how well each rig family is predicted from the others.
    """
    sha256 = Encoder.open(encoder).sha256  # refuse a bad encoder before the work
    data = collected(work, encoder, anew=anew, report=report)
    seeds = [calibration_plan(index).seed for index in range(CITIES)]
    measured_on: dict[str, str | float] = {
        "cities": ", ".join(f"seed {seed}" for seed in seeds)
        + f", repeating blocks of seed {repeating_plan().seed}"
        + "".join(
            f", {family.name} of seed {family_plan(family, k).seed}"
            for family in FAMILIES
            if family.fitted
            for k in range(FAMILY_CITIES)
        ),
        "encoder_sha256": sha256,
    }
    fitted = data.where(~np.isin(data.family, NOT_FITTED))
    told = table(cross_check(data, not_fitted=NOT_FITTED))
    codes = codes_of_answers(work, encoder)
    others = sum(code != code_of_answers() for code in codes.values())
    if others:
        told.append(
            f"{others} of {len(codes)} files of answers in {work} are of another version of the code; --anew asks again"
        )
    return fit(fitted, measured_on=measured_on), told


def collected(work: Path, encoder: Path, *, anew: bool = False, report: Report = lambda *_: None) -> CalibrationData:
    """Simulate the calibration cities, build their maps and localize their queries, or read what an earlier run stored.

    Args:
        work: folder of cities, maps and answers. The maps and answers of this encoder are reused.
        encoder: the encoder, ONNX.
        anew: localize the queries again, for example after a change of the code.
        report: called after every frame, place and query.

    Raises:
        EncoderError: the encoder cannot be used.
    """
    families = [_data_of_family(work, encoder, family, anew=anew, report=report) for family in FAMILIES]
    parts = [_data_of_city(work, encoder, k, anew=anew, report=report) for k in range(CITIES)]
    alike = _data_of_repeating(work, encoder, anew=anew, report=report)
    return pooled([*parts, *families, alike])


def _city(work: Path, plan: SimulationPlan, report: Report) -> Dataset:
    """Simulate a city, or open it if an earlier run has finished it."""
    simulate(plan, work / plan.name, report=report)
    return Dataset(work / plan.name)


def _localizer(work: Path, encoder: Path, dataset: Dataset, name: str, report: Report) -> Localizer:
    folder = work / "maps" / f"{name}-{Encoder.open(encoder).sha256[:12]}"
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        build_map(dataset, encoder, folder, BuildSettings(name=name, calibration=None), report=report)
    return Localizer.open(MapBundle.open(folder))


def _data_of_city(work: Path, encoder: Path, index: int, *, anew: bool, report: Report) -> CalibrationData:
    """Return the calibration data of one city.

    Its queries are localized in its own map, in the map of the other city, and in its own map without a third of the streets. Walls and
    rooms are added.
    """
    return _kept(work, encoder, calibration_plan(index), lambda: _ask(work, encoder, index, report), anew=anew)


def _data_of_family(work: Path, encoder: Path, family: Family, *, anew: bool, report: Report) -> CalibrationData:
    """Return the calibration data of a rig family: queries of its cities in their own and each other's maps, and walls and rooms."""
    plans = [family_plan(family, index) for index in range(FAMILY_CITIES)]

    def ask() -> list[CalibrationData]:
        cities = [_city(work, plan, report) for plan in plans]
        found = []
        of_rig = Rig(family.name, beams_deg=family.beams, cameras=family.cameras)
        for index, own in enumerate(cities):
            other = cities[(index + 1) % FAMILY_CITIES]
            here = _localizer(work, encoder, own, own.name, report)
            found += in_the_map(here, own, report, rig=of_rig)
            found += of_another_city(_localizer(work, encoder, other, other.name, report), own, report, rig=of_rig)
        found += walls_and_rooms(
            here, cities[-1].description.sensors.cameras[0].pinhole(), FAMILIES.index(family), report, (family.depth_model(),),
            count=40, rig=replace(of_rig, stereo=family.matched),
        )  # fmt: skip
        return [each.of_family(family.name) for each in found]

    return _kept(work, encoder, plans[0], ask, anew=anew)


def _data_of_repeating(work: Path, encoder: Path, *, anew: bool, report: Report) -> CalibrationData:
    """Return the calibration data of a street with repeating blocks, where wrong places look right: single queries and sequences."""
    plan = repeating_plan()

    def ask() -> list[CalibrationData]:
        street = _city(work, plan, report)
        found = in_the_map(_localizer(work, encoder, street, street.name, report), street, report)
        return [each.of_family("repeating") for each in found]

    return _kept(work, encoder, plan, ask, anew=anew)


def _kept(
    work: Path, encoder: Path, plan: SimulationPlan, ask: Callable[[], list[CalibrationData]], *, anew: bool
) -> CalibrationData:
    """Return the calibration data that an earlier run stored under the name of a plan, or compute and store them.

    Stored data need no city and no map. So the fit can be repeated where only the answers are.
    """
    kept = _kept_file(work, encoder, plan)
    if not kept.exists() or anew:
        work.mkdir(parents=True, exist_ok=True)
        data, part = pooled(ask()), kept.with_suffix(".part.npz")
        arrays: dict[str, Any] = {name: getattr(data, name) for name in CalibrationData.__dataclass_fields__}
        np.savez_compressed(part, **arrays | {_CODE: np.array(code_of_answers())})
        part.rename(kept)

    def read() -> CalibrationData:
        with kept.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return CalibrationData(*(arrays[name] for name in CalibrationData.__dataclass_fields__))

    return read_arrays(kept, read, remedy=_REMEDY)


def codes_of_answers(work: Path, encoder: Path) -> dict[str, str | None]:
    """Return which version of the code gave the stored answers, as ``code_of_answers`` names it, by file name.

    None stands for a file of a release that did not keep it. Missing files are left out.

    Args:
        work: folder of cities, maps and answers.
        encoder: the encoder, ONNX.
    """
    plans = [
        *(calibration_plan(k) for k in range(CITIES)),
        *(family_plan(family, 0) for family in FAMILIES),
        repeating_plan(),
    ]
    found = dict[str, str | None]()
    for kept in (path for plan in plans if (path := _kept_file(work, encoder, plan)).exists()):

        def read(kept: Path = kept) -> str | None:
            with kept.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                return str(arrays[_CODE]) if _CODE in arrays.files else None

        found[kept.name] = read_arrays(kept, read, remedy=_REMEDY)
    return found


def _kept_file(work: Path, encoder: Path, plan: SimulationPlan) -> Path:
    return work / f"asked-{plan.name}-{Encoder.open(encoder).sha256[:12]}.npz"


def _ask(work: Path, encoder: Path, index: int, report: Report) -> list[CalibrationData]:
    cities = [_city(work, calibration_plan(k), report) for k in range(CITIES)]
    own, other = cities[index], cities[(index + 1) % len(cities)]
    partial = WithoutStreets(own.folder)
    here = _localizer(work, encoder, own, own.name, report)
    elsewhere = _localizer(work, encoder, other, other.name, report)
    camera = own.description.sensors.cameras[0].pinhole()
    presets = [DEPTHS[name] for name in BOTH]
    found = in_the_map(here, own, report)
    found += walls_and_rooms(here, camera, index, report, presets)
    found += of_another_city(elsewhere, own, report)
    for rig in RIGS:
        of_rig = in_the_map(here, own, report, CLEAR_SETS, rig=rig)
        of_rig += walls_and_rooms(here, camera, index, report, presets, rig=rig)
        of_rig += of_another_city(elsewhere, own, report, CLEAR_SETS, rig=rig)
        found += [each.of_family(rig.name) for each in of_rig]
    without = _localizer(work, encoder, partial, f"{own.name}-without-streets", report)
    return found + where_streets_are_missing(without, own, list(CLEAR_SETS), partial.is_outside, report)
