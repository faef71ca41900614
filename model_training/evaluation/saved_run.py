"""A run in a folder: its answers, and the map, the data and the settings that they are of."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar, Literal
from zipfile import BadZipFile

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from model_training.datasets.dataset import Dataset
from model_training.evaluation.evaluate import Evaluation
from model_training.evaluation.predict import Predictions
from service.errors import DatasetError
from service.imaging.npy_header import NPY_HEADER_ERRORS
from service.maps.reader import MapBundle

FILE, ANSWERS = "run.json", "answers"


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")


class RunMap(_Frozen):
    """The map that was asked, and where it lay."""

    name: str
    version: str
    path: str


class RunData(_Frozen):
    """The dataset that the queries are of, and where it lay."""

    name: str
    path: str


class RunSet(_Frozen):
    """A query set; ``condition`` is the weather and light of a simulated one."""

    name: str = Field(pattern=r"^[^./\\][^/\\]*$")  # a file's name
    split: str
    queries: int
    condition: str | None = None


class RunSettings(_Frozen):
    """``run.json``: all that two runs must share to be compared, and what may differ between them."""

    format: Literal[1] = 1
    map: RunMap
    dataset: RunData
    registered: bool
    sets: tuple[RunSet, ...]
    streets: tuple[str, ...]
    streetfix: str
    commit: str | None
    made_at: AwareDatetime


@dataclass(frozen=True)
class SavedRun:
    """A run's settings and its answers by query set."""

    folder: Path
    settings: RunSettings
    predictions: dict[str, Predictions]

    @staticmethod
    def open(folder: Path) -> "SavedRun":
        """Read what ``save_run`` wrote.

        Raises:
            DatasetError: the folder is no saved run, or its parts do not fit each other.
        """
        path = folder / FILE
        if not path.is_file():
            raise DatasetError(
                f"{folder} is no saved run: {FILE} is missing; `streetfix evaluate --report` makes one", field=FILE
            )
        try:
            settings = RunSettings.model_validate_json(path.read_bytes())
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"])
            raise DatasetError(f"{path}: {where}: {first['msg']}; make the report anew", field=FILE) from error
        return SavedRun(folder, settings, {each.name: _answers(folder, each) for each in settings.sets})


def _answers(folder: Path, each: RunSet) -> Predictions:
    path = folder / ANSWERS / f"{each.name}.npz"
    try:
        found = Predictions.load(path)
    except (OSError, KeyError, BadZipFile, *NPY_HEADER_ERRORS) as error:
        raise DatasetError(f"{path}: no answers of ours ({error}); make the report anew", field=each.name) from error
    if len(found.T_true) != each.queries:
        raise DatasetError(
            f"{path}: {len(found.T_true)} answers, {FILE} says {each.queries}; make the report anew", field=each.name
        )
    return found


def save_run(folder: Path, bundle: MapBundle, dataset: Dataset, evaluation: Evaluation) -> SavedRun:
    """Write answers, then settings, then figures; ``run.json`` is there only when its answers are."""
    (folder / ANSWERS).mkdir(parents=True, exist_ok=True)
    conditions = _conditions(dataset.description.source)
    sets = tuple(
        RunSet(name=name, split=evaluation.figures["sets"][name]["split"], queries=len(p.T_true), condition=conditions.get(name))
        for name, p in evaluation.predictions.items()
    )  # fmt: skip
    settings = RunSettings(
        map=RunMap(name=bundle.name, version=bundle.manifest.version, path=str(bundle.path.resolve())),
        dataset=RunData(name=dataset.name, path=str(dataset.folder.resolve())),
        registered=evaluation.figures["registered"], sets=sets,
        streets=() if bundle.streets is None else tuple(street.name for street in bundle.streets.features),
        streetfix=version("streetfix"), commit=commit_of(Path(__file__)), made_at=datetime.now(UTC),
    )  # fmt: skip
    for name, answers in evaluation.predictions.items():
        answers.save(folder / ANSWERS / f"{name}.npz")
    _write(folder / FILE, settings.model_dump_json(indent=1))
    _write(folder / "figures.json", json.dumps(evaluation.figures, indent=1))
    return SavedRun(folder, settings, evaluation.predictions)


def _write(path: Path, text: str) -> None:
    part = path.with_name(path.name + ".part")
    part.write_text(text + "\n")
    part.rename(path)


def _conditions(source: dict[str, Any]) -> dict[str, str]:
    """Weather and light of each query set, as the plan of a simulated dataset has them."""
    queries = (source.get("plan") or {}).get("queries", [])
    return {
        f"{query['name']}_{depth}": str(query.get("condition", "clear"))
        for query in queries if isinstance(query, dict) and "name" in query
        for depth in query.get("depths", ["precise"])
    }  # fmt: skip


def commit_of(file: Path) -> str | None:
    """The commit that a source file's checkout stands at; None where it lies in no checkout, as in an installed package."""
    top = next((folder for folder in file.resolve().parents if (folder / ".git" / "HEAD").is_file()), None)
    if top is None:
        return None
    head = (top / ".git" / "HEAD").read_text().strip()
    if not head.startswith("ref: "):
        return head
    branch = head.removeprefix("ref: ")
    loose, packed = top / ".git" / branch, top / ".git" / "packed-refs"
    if loose.is_file():
        return loose.read_text().strip()
    lines = packed.read_text().splitlines() if packed.is_file() else []
    return next((line.split()[0] for line in lines if line.endswith(f" {branch}")), None)
