"""Make the map and the questions of the demo, from a part of the paper's city or from recorded frames. Later runs reuse them."""

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
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from service.errors import BundleError, DatasetError, EncoderError
from service.maps.manifest import read_manifest
from service.maps.streets import Streets
from service.maps.writer import sha256_of


@dataclass(frozen=True, slots=True, eq=False)
class DemoQuery:
    """An image pair with its ground truth, which is not sent.

    Attributes:
        name: name of the query in tables.
        rgb: file of the colour image.
        depth: file of the depth image.
        camera: JSON file with the other parts of the request, as for ``streetfix localize --camera``.
        T_map_camera: true pose of the camera, translation in metres (4, 4); None if it is unknown.
        street: id and name of the street at the true position; None if there is none.
        place: index of the true place, if places are single frames; else None.
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
    """A map and the questions for it.

    Attributes:
        folder: folder of all files of the demo.
        bundle: the map bundle.
        questions: image pairs with ground truth.
        place_names: names of the map's places if places are single frames; else empty.
    """

    folder: Path
    bundle: Path
    questions: tuple[DemoQuery, ...]
    place_names: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class CityDemo:
    """Plan of a demo in the paper's city.

    Attributes:
        streets: names of the streets to map.
        queries: number of queries.
        depth: depth camera: ideal, precise or stereo.
        seed: seed of the city and its traversals.
    """

    streets: tuple[str, ...]
    queries: int
    depth: str
    seed: int


def city_demo(plan: CityDemo, folder: Path, encoder: Path, report: Report) -> DemoMap:
    """Simulate streets and another traversal of them, and build their map.

    Args:
        plan: streets, queries and seed.
        folder: folder of all files of the demo.
        encoder: ONNX file.
        report: callback for progress.

    Raises:
        DatasetError: a street or the depth is unknown, or ``folder`` holds the demo of another plan.
        EncoderError: the encoder is missing.
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
    """Import stereo frames and build their map. Each frame is a place of its own; depth comes from semi-global matching.

    Args:
        source: folder of stereo frames in KITTI's object layout.
        folder: folder of all files of the demo.
        encoder: ONNX file.
        report: callback for progress.

    Raises:
        DatasetError: the frames are missing or damaged, or ``folder`` holds the demo of another source.
        EncoderError: the encoder is missing.
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
            f"{encoder}: file not found; give an encoder with --encoder, or run: make encoder", field="encoder"
        )


def _is_new(dataset: Path, source: Path) -> bool:
    """Return whether frames must be imported. A file next to the dataset stores their source."""
    note = dataset.with_name("source.txt")
    text = f"{source.resolve()}\n"
    if (dataset / "dataset.json").exists():
        if not note.exists() or note.read_text() != text:
            raise DatasetError(
                f"{dataset} was imported from another source; choose another --out, or remove it", field="out"
            )
        return False
    dataset.parent.mkdir(parents=True, exist_ok=True)
    note.write_text(text)
    return True


def _build(
    dataset: Dataset, encoder: Path, bundle: Path, name: str, report: Report, *, made_from: dict[str, Any], new: bool
) -> None:
    """Build the map, unless it exists with the same data, encoder and settings.

    A file next to the complete map stores these. So a run that ends between the dataset and its map does not leave the map
    of another plan to the next run.
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


def _city_questions(dataset: Dataset, streets: Streets, folder: Path) -> Iterator[DemoQuery]:
    for name in dataset.query_sets():
        for frame in dataset.queries(name):
            if frame.T_map_camera is None:
                continue
            index = streets.index_at(frame.T_map_camera[:2, 3])
            street = None if index < 0 else (streets[index].id, streets[index].name)
            yield _question(f"{frame.number + 1}", frame, folder, street=street)


def _recorded_questions(dataset: Dataset, folder: Path) -> Iterator[DemoQuery]:
    places: list[str] = dataset.description.source["places"]
    for set_name, names in dataset.description.source["queries"].items():
        for frame in dataset.queries(set_name):
            name = names[frame.number]
            yield _question(name, frame, folder, place=places.index(name) if name in places else None)


def _question(
    name: str, frame: QueryFrame, folder: Path, *, street: tuple[str, str] | None = None, place: int | None = None
) -> DemoQuery:
    camera = _camera_file(folder, frame)
    return DemoQuery(name, frame.rgb_path, frame.depth_path, camera, frame.T_map_camera, street, place)


def _camera_file(folder: Path, frame: QueryFrame) -> Path:
    """Write the file for ``streetfix localize --camera``: the parts of the request that depend on the camera."""
    path = folder / f"{frame.camera.name}.json"
    path.write_text(json.dumps(frame.request(), indent=1) + "\n")
    return path
