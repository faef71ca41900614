"""Retrieval in parts of the town of different length: does a larger map hide the right place?

Each query is compared exactly with the views of the places nearest to it, as in a map of that length around the robot. The largest part is
the whole town. The recall among more places bounds what a better order of these places can gain.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32
from numpy.typing import NDArray

from benchmarks.plans import BOTH
from benchmarks.report import Report
from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset
from model_training.evaluation.measures import RIGHT_PLACE_M
from service.errors import DatasetError
from service.localization.localizer import Localizer
from service.maps.index import vectors_of
from service.maps.tiles import TiledMap

#: Lengths of the parts, m of street. The last one is cut off at the length of the town.
LENGTHS_M = (1_000.0, 10_000.0, 100_000.0)
#: Numbers of places, the most similar first, among which the right one is looked for.
AMONG = (1, 10, 100)


def growth_rows(report: Report, folder: Path, dataset: Dataset) -> None:
    """Add rows ``growth.*``: recall of retrieval alone, by length of the map.

    Args:
        report: collects the rows.
        folder: tiled map of the town.
        dataset: the town, with queries ``drive1_*``.
    """
    opened = TiledMap.open(folder)
    localizer, vectors = Localizer.open(opened), vectors_of(opened.view_index.rows[:])
    spacing_m, places_m = opened.manifest.spacing_m, opened.T_map_place[:, :2, 3]
    whole_m = spacing_m * len(places_m)
    for depth in BOTH:
        ranks: dict[float, list[int]] = {length_m: [] for length_m in LENGTHS_M}
        frames = list(dataset.queries(f"drive1_{depth}"))
        with bars() as progress:
            for done, frame in enumerate(frames, 1):
                if frame.T_map_camera is None:
                    raise DatasetError(f"{dataset.folder}: a query has no true pose", field="queries")
                turns = localizer.encode_and_search(frame.query(opened.grid)).descriptors
                similarity = place_similarity(vectors, turns, opened.manifest.headings)
                away_m = np.linalg.norm(places_m - frame.T_map_camera[:2, 3], axis=1)
                for length_m, found in ranks.items():
                    near = np.argsort(away_m, kind="stable")[: round(length_m / spacing_m)]
                    found.append(rank_of_right(similarity[near], away_m[near] <= RIGHT_PLACE_M))
                progress(f"queries drive1_{depth}", done, len(frames))
        for length_m, found in ranks.items():
            for among in AMONG:
                row = f"growth.{depth}.km_{min(length_m, whole_m) / 1e3:.0f}.recall_at_{among}_5m"
                report.share(row, np.array(found) < among)
    report.notes["growth"] = (
        "Rows `growth.*` compare each query exactly with all views of the places nearest to it. They show retrieval alone. "
        f"The town has {whole_m / 1e3:.1f} km of streets."
    )


def place_similarity(
    vectors: Float32[NDArray[np.float32], "V D"], turns: Float32[NDArray[np.float32], "T D"], headings: int
) -> Float32[NDArray[np.float32], " P"]:
    """Return the largest similarity of a query to each place, over the views of the place and the turns of the query.

    Args:
        vectors: descriptors of all views, those of a place one after the other.
        turns: descriptors of the query, one per turn.
        headings: number of views of a place.
    """
    best = (vectors @ turns.T).max(axis=1)
    similarity: NDArray[np.float32] = best.reshape(-1, headings).max(axis=1)
    return similarity


def rank_of_right(similarity: Float32[NDArray[np.float32], " P"], right: Bool[NDArray[np.bool_], " P"]) -> int:
    """Return how many places are more similar than the most similar right one; the number of places if none is right.

    Args:
        similarity: similarity of each place.
        right: whether each place is near to the query.
    """
    return int((similarity > similarity[right].max()).sum()) if right.any() else len(similarity)
