"""Events of a folder's content."""

from collections.abc import Iterator
from pathlib import Path

from model_training.datasets.dataset import Dataset
from model_training.evaluation import saved_run
from model_training.evaluation.saved_run import SavedRun
from model_training.viewing.events import Event
from model_training.viewing.of_answers import events_of_answers
from model_training.viewing.of_dataset import events_of_dataset
from model_training.viewing.of_map import events_of_map
from service.errors import BundleError, DatasetError
from service.maps import manifest
from service.maps.tiles import open_map


def events_of(folder: Path, *, most_scans: int, most_points: int) -> Iterator[Event]:
    """Yield the events of a dataset, a map bundle, or a saved evaluation with its map and images if they still exist.

    Args:
        folder: folder to view.
        most_scans: largest number of scans.
        most_points: largest number of points of a scan or cloud.

    Raises:
        DatasetError: the folder is none of them.
    """
    if (folder / saved_run.FILE).is_file():
        run = SavedRun.open(folder)
        yield from _map_of(run, most_points)
        yield from events_of_answers(run, _dataset_of(run))
    elif (folder / manifest.FILE).is_file():
        yield from events_of_map(open_map(folder), most_points=most_points)
    elif (folder / "dataset.json").is_file():
        yield from events_of_dataset(Dataset(folder), most_scans=most_scans, most_points=most_points)
    else:
        raise DatasetError(
            f"{folder} is not a dataset, a map bundle or a folder of `evaluate --report`: it has none "
            f"of dataset.json, {manifest.FILE}, {saved_run.FILE}",
            field="source",
        )


def _map_of(run: SavedRun, most_points: int) -> Iterator[Event]:
    try:
        bundle = open_map(Path(run.settings.map.path), verify=False)
    except BundleError:
        return  # moved or deleted since: the answers can be viewed without the map
    yield from events_of_map(bundle, most_points=most_points)


def _dataset_of(run: SavedRun) -> Dataset | None:
    try:
        return Dataset(Path(run.settings.dataset.path))
    except DatasetError:
        return None  # moved or deleted since: the answers can be viewed without the images
