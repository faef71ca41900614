"""The demo's map and questions: of a part of the paper's city, or of recorded frames. Made once, then used again."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model_training.cli.progress import Report
from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.importing.kitti_object import import_kitti_object
from model_training.mapping.build import BuildSettings, build_map
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from service.errors import BundleError, DatasetError, EncoderError
from service.maps.manifest import read_manifest
from service.maps.streets import Streets
from service.maps.writer import sha256_of


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """A pair of pictures with the truth, which stays here; ``name`` is for people.

    ``T_map_camera`` is None where nobody knows it; ``street`` is the id and the name of the street at that place;
    ``place`` is the number of the one place that the picture shows, where places are single frames.
    """

    name: str
    rgb: Path
    depth: Path
    camera: Path
    T_map_camera: NDArray[np.float64] | None
    street: tuple[str, str] | None = None
    place: int | None = None


@dataclass(frozen=True, slots=True)
class DemoMap:
    """A map and the questions for it; ``place_names`` where places are single frames, else empty."""

    folder: Path
    bundle: Path
    questions: tuple[Question, ...]
    place_names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CityDemo:
    """Which part of the paper's city, and how it is asked."""

    streets: tuple[str, ...]
    queries: int
    depth: str
    seed: int


def city_demo(plan: CityDemo, folder: Path, encoder: Path, report: Report) -> DemoMap:
    """Simulate streets and another drive through them, and build their map.

    Raises:
        DatasetError: there is no such street or depth, or ``folder`` holds the demo of another plan.
        EncoderError: there is no encoder.
    """
    _require_encoder(encoder)
    drive = QueryPlan(name="drive1", traversal=1, count=plan.queries, depths=(plan.depth,))
    simulation = SimulationPlan(name="paper-city", city="paper", seed=plan.seed, streets=plan.streets, queries=(drive,))
    new = not (folder / "dataset" / "dataset.json").exists()
    simulate(simulation, folder / "dataset", report=report)
    dataset = Dataset(folder / "dataset")
    made_from = simulation.model_dump(mode="json")
    _build(dataset, encoder, folder / "map", "paper-city", report, made_from=made_from, new=new)
    streets = Streets.from_geojson(dataset.streets())
    return DemoMap(folder, folder / "map", tuple(_city_questions(dataset, streets, folder)))


def recorded_demo(source: Path, folder: Path, encoder: Path, report: Report) -> DemoMap:
    """Import stereo frames, each its own place, with depth by semi-global matching, and build their map.

    Raises:
        DatasetError: the frames are missing or damaged, or ``folder`` holds the demo of another source.
        EncoderError: there is no encoder.
    """
    _require_encoder(encoder)
    new = _is_new(folder / "dataset", source)
    if new:
        import_kitti_object(source, folder / "dataset", depth="sgbm", progress=lambda *done: report("frames", *done))
    dataset = Dataset(folder / "dataset")
    made_from = {"source": str(source.resolve())}
    _build(dataset, encoder, folder / "map", "recorded-frames", report, made_from=made_from, new=new)
    names = tuple(dataset.description.source["places"])
    return DemoMap(folder, folder / "map", tuple(_recorded_questions(dataset, folder)), names)


def _require_encoder(encoder: Path) -> None:
    if not encoder.is_file():
        raise EncoderError(
            f"{encoder}: no such encoder; name one with --encoder, or run: make encoder", field="encoder"
        )


def _is_new(dataset: Path, source: Path) -> bool:
    """Whether frames are still to be imported; the source is noted beside the dataset."""
    note = dataset.with_name("source.txt")
    text = f"{source.resolve()}\n"
    if (dataset / "dataset.json").exists():
        if not note.exists() or note.read_text() != text:
            raise DatasetError(f"{dataset} was imported from elsewhere; choose another --out or remove it", field="out")
        return False
    dataset.parent.mkdir(parents=True, exist_ok=True)
    note.write_text(text)
    return True


def _build(
    dataset: Dataset, encoder: Path, bundle: Path, name: str, report: Report, *, made_from: dict[str, Any], new: bool
) -> None:
    """Build the map, unless it is there and made of the same, by the same encoder, in the same way.

    What a map was made from is noted beside it when it is whole: a run that ends between the dataset and its map must
    not leave the map of another plan to the next one.
    """
    settings, note = BuildSettings(name=name), bundle.with_name("map.made_from.json")
    calibration = None if settings.calibration is None else sha256_of(settings.calibration)
    built = asdict(settings) | {"calibration": calibration}
    wanted = {"made_from": made_from, "encoder_sha256": sha256_of(encoder), "settings": built}
    if new or not _is_noted(note, wanted, bundle):
        version = build_map(dataset, encoder, bundle, settings, overwrite=True, report=report).version
        note.write_text(json.dumps(wanted | {"map_version": version}, indent=1) + "\n")


def _is_noted(note: Path, wanted: dict[str, Any], bundle: Path) -> bool:
    try:
        noted: object = json.loads(note.read_text())
        return noted == wanted | {"map_version": read_manifest(bundle).version}
    except (OSError, ValueError, BundleError):
        return False


def _city_questions(dataset: Dataset, streets: Streets, folder: Path) -> Iterator[Question]:
    for name in dataset.query_sets():
        for frame in dataset.queries(name):
            if frame.T_map_camera is None:
                continue
            index = streets.index_at(frame.T_map_camera[:2, 3])
            street = None if index < 0 else (streets[index].id, streets[index].name)
            yield _question(f"{frame.number + 1}", frame, folder, street=street)


def _recorded_questions(dataset: Dataset, folder: Path) -> Iterator[Question]:
    places: list[str] = dataset.description.source["places"]
    for set_name, names in dataset.description.source["queries"].items():
        for frame in dataset.queries(set_name):
            name = names[frame.number]
            yield _question(name, frame, folder, place=places.index(name) if name in places else None)


def _question(
    name: str, frame: QueryFrame, folder: Path, *, street: tuple[str, str] | None = None, place: int | None = None
) -> Question:
    camera = _camera_file(folder, frame)
    return Question(name, frame.rgb_path, frame.depth_path, camera, frame.T_map_camera, street, place)


def _camera_file(folder: Path, frame: QueryFrame) -> Path:
    """The request's parts that a camera decides, as ``streetfix localize --camera`` takes them."""
    path = folder / f"{frame.camera.name}.json"
    path.write_text(json.dumps(frame.request(), indent=1) + "\n")
    return path
