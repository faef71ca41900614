"""Save an evaluation run in a folder: its answers, with the map, the dataset and the settings."""

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
from model_training.evaluation.query_mode import SINGLE, QueryMode
from service.errors import DatasetError
from service.imaging.npy_header import NPY_HEADER_ERRORS
from service.maps.map import Map

#: Name of the settings file and of the folder of answers in a run's folder.
FILE, ANSWERS = "run.json", "answers"


class _Frozen(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")


class RunMap(_Frozen):
    """The map of a run.

    Attributes:
        name: name of the map.
        version: version of the map.
        path: folder of the bundle at the time of the run.
    """

    name: str
    version: str
    path: str


class RunData(_Frozen):
    """The dataset of the queries.

    Attributes:
        name: name of the dataset.
        path: folder of the dataset at the time of the run.
    """

    name: str
    path: str


class RunSet(_Frozen):
    """A query set.

    Attributes:
        name: name of the set.
        split: the split that it belongs to, as from ``evaluate.split_of``.
        queries: number of queries.
        odometry: where relative poses of the images come from; None if a query has one image and there is no track.
        condition: weather and light of a simulated set; None for others.
    """

    name: str = Field(pattern=r"^[^./\\][^/\\]*$")  # it becomes a file name
    split: str
    queries: int
    odometry: str | None = None
    condition: str | None = None


class RunSettings(_Frozen):
    """The content of ``run.json``: the settings of a run.

    Attributes:
        format: version of the file format.
        map: the map.
        dataset: the dataset of the queries.
        registered: whether the answers were registered, not only retrieved.
        mode: how the images became queries. Runs of earlier releases have single images.
        sets: the query sets.
        streets: names of the map's streets, in the order of their features.
        streetfix: version of the package.
        commit: commit of the source checkout; None outside a checkout.
        made_at: time of the run.
    """

    format: Literal[1] = 1
    map: RunMap
    dataset: RunData
    registered: bool
    mode: QueryMode = SINGLE
    sets: tuple[RunSet, ...]
    streets: tuple[str, ...]
    streetfix: str
    commit: str | None
    made_at: AwareDatetime

    def described(self) -> str:
        """Return how the images became queries, and where their relative poses come from, as text for readers."""
        sources = sorted({each.odometry for each in self.sets if each.odometry is not None})
        return self.mode.described() + (f", relative poses from {' and '.join(sources)}" if sources else "")


@dataclass(frozen=True)
class SavedRun:
    """A saved run.

    Attributes:
        folder: folder of the run.
        settings: its settings.
        predictions: its answers, by query set.
    """

    folder: Path
    settings: RunSettings
    predictions: dict[str, Predictions]

    @staticmethod
    def open(folder: Path) -> "SavedRun":
        """Read a run that ``save_run`` wrote.

        Args:
            folder: folder of the run.

        Raises:
            DatasetError: the folder is not a saved run, or its parts contradict each other.
        """
        path = folder / FILE
        if not path.is_file():
            raise DatasetError(
                f"{folder} is not a saved run: {FILE} is missing; `streetfix evaluate --report` writes one", field=FILE
            )
        try:
            settings = RunSettings.model_validate_json(path.read_bytes())
        except ValidationError as error:
            first = error.errors(include_url=False, include_input=False)[0]
            where = ".".join(str(part) for part in first["loc"])
            raise DatasetError(f"{path}: {where}: {first['msg']}; create the report again", field=FILE) from error
        return SavedRun(folder, settings, {each.name: _answers(folder, each) for each in settings.sets})


def _answers(folder: Path, each: RunSet) -> Predictions:
    path = folder / ANSWERS / f"{each.name}.npz"
    try:
        found = Predictions.load(path)
    except (OSError, KeyError, BadZipFile, *NPY_HEADER_ERRORS) as error:
        raise DatasetError(
            f"{path}: not an answer file of Streetfix ({error}); create the report again", field=each.name
        ) from error
    if len(found.T_true) != each.queries:
        raise DatasetError(
            f"{path}: {len(found.T_true)} answers, but {FILE} says {each.queries}; create the report again",
            field=each.name,
        )
    return found


def save_run(folder: Path, bundle: Map, dataset: Dataset, evaluation: Evaluation) -> SavedRun:
    """Save a run: the answers, then the settings, then the figures. So ``run.json`` exists only if its answers do.

    Args:
        folder: folder of the run. It is created if it is missing.
        bundle: the map.
        dataset: the dataset of the queries.
        evaluation: the result of the run.
    """
    (folder / ANSWERS).mkdir(parents=True, exist_ok=True)
    conditions = _conditions(dataset.description.source)
    sets = tuple(
        RunSet(
            name=name,
            split=evaluation.figures["sets"][name]["split"],
            queries=len(p.T_true),
            odometry=evaluation.figures["sets"][name]["odometry"],
            condition=conditions.get(name),
        )
        for name, p in evaluation.predictions.items()
    )
    settings = RunSettings(
        map=RunMap(name=bundle.name, version=bundle.manifest.version, path=str(bundle.path.resolve())),
        dataset=RunData(name=dataset.name, path=str(dataset.folder.resolve())),
        registered=evaluation.figures["registered"],
        mode=QueryMode.model_validate(evaluation.figures["mode"]),
        sets=sets,
        streets=() if bundle.streets is None else tuple(street.name for street in bundle.streets.features),
        streetfix=version("streetfix"),
        commit=commit_of(Path(__file__)),
        made_at=datetime.now(UTC),
    )
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
    """Return the weather and light of each query set, from the plan of a simulated dataset."""
    queries = (source.get("plan") or {}).get("queries", [])
    return {
        f"{query['name']}_{depth}": str(query.get("condition", "clear"))
        for query in queries
        if isinstance(query, dict) and "name" in query
        for depth in query.get("depths", ["precise"])
    }


def commit_of(file: Path) -> str | None:
    """Return the current commit of a file's Git checkout; None outside a checkout, as in an installed package.

    Args:
        file: a source file.
    """
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
