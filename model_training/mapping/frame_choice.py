"""Choose the map frame of a new map: that of its survey, that of another map, or the one that all maps of a region share."""

from dataclasses import asdict
from pathlib import Path
from typing import Literal, TypeVar

from model_training.datasets.dataset import Dataset
from model_training.datasets.frames import georeference_of, global_frame
from service.errors import BundleError, DatasetError
from service.maps.manifest import read_manifest

D = TypeVar("D", bound=Dataset)

SURVEY: Literal["survey"] = "survey"
GLOBAL: Literal["global"] = "global"


def in_chosen_frame(dataset: D, frame: str | None, *, tiled: bool) -> D:
    """Return a dataset in the frame of the map that will be built from it.

    Args:
        dataset: the dataset.
        frame: ``survey``: as the dataset states it. ``global``: the frame that all maps of a region share. Anything else is the folder of
            a map, whose frame is taken. None: ``global`` for a tiled map if the position of the dataset on the Earth is known, else
            ``survey``.
        tiled: whether the map has tiles.

    Raises:
        DatasetError: the frame needs the dataset's position on the Earth, and it is unknown or no place on the Earth.
        BundleError: the folder is no map, or the map has no position on the Earth.
    """
    own = dataset.description.georeference
    if frame is None:
        frame = GLOBAL if tiled and own is not None else SURVEY
    if frame == SURVEY:
        return dataset
    if own is None:
        raise DatasetError(
            f"{dataset.place}/dataset.json: georeference is null, so its place in the frame {frame!r} is unknown; import the survey "
            f"with its georeference, or give --frame {SURVEY}",
            field="georeference",
        )
    if frame == GLOBAL:
        of_dataset = georeference_of(own, f"{dataset.place}/dataset.json")
        positions = dataset.survey_poses()[:, :3, 3]
        # An empty survey has no middle. The build refuses it.
        return dataset.in_frame(asdict(global_frame(of_dataset, positions))) if len(positions) else dataset
    manifest = read_manifest(Path(frame))
    if manifest.georeference is None:
        raise BundleError(
            f"{frame}: the map has no georeference, so a survey cannot be moved into its frame; give another map, {GLOBAL!r} or {SURVEY!r}",
            field="frame",
        )
    return dataset.in_frame(manifest.georeference)
