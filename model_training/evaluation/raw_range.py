"""A baseline without learning: nearest neighbour on the range images themselves, at its best setting.

There are four ways to compare a query's range view with the map's: L2 of log ranges over cells that both measured; the
same with a penalty for cells that only one measured; cosine of the masked log ranges; and cosine after subtraction of
each view's mean. Each runs with the query straight ahead, and with all turns of the localizer, which finds much more. A
fair comparison must beat the best of them.
"""

from collections.abc import Callable
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import thinned, view_ranges
from service.errors import NoDepthError
from service.imaging.query_view import query_views
from service.imaging.view_grid import ViewGrid
from service.maps.map import Map
from service.retrieval.retrieve import turns_on

Ranges = NDArray[np.float32]
COMPARED = ("masked_l2", "masked_l2_gaps", "cosine", "cosine_centred")
STRAIGHT = "_straight"
SETTINGS = (*COMPARED, *(name + STRAIGHT for name in COMPARED))
GAP_PENALTY = 0.15
CHUNK = 2048


def _features(ranges: Ranges) -> tuple[Ranges, Ranges]:
    """Return log ranges relative to 10 m, 0 for no measurement, and the mask; both (n, cells)."""
    flat = ranges.reshape(len(ranges), -1).astype(np.float32)
    mask = (flat > 0).astype(np.float32)
    return np.log(np.maximum(flat, 0.5) / 10.0).astype(np.float32) * mask, mask


def similarities(queries: Ranges, views: Ranges) -> dict[str, Ranges]:
    """Compute similarities (Q, V) by every way of comparison; larger is nearer.

    Args:
        queries: range views (Q, rows, columns), metres.
        views: range views (V, rows, columns), metres.
    """
    q, mq = _features(queries)
    v, mv = _features(views)
    cells = q.shape[1]
    both = mq @ mv.T
    square = (q * q) @ mv.T + mq @ (v * v).T - 2 * q @ v.T
    l2 = square / np.maximum(both, 1)
    l2[both < 0.1 * cells] = 1e3
    gaps = (mq.sum(axis=1)[:, None] + mv.sum(axis=1)[None] - 2 * both) / cells

    def unit(x: Ranges) -> Ranges:
        scaled: Ranges = x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-6)
        return scaled

    def centred(x: Ranges, mask: Ranges) -> Ranges:
        moved: Ranges = (x - (x.sum(axis=1) / np.maximum(mask.sum(axis=1), 1))[:, None]) * mask
        return moved

    return {
        "masked_l2": -l2,
        "masked_l2_gaps": -(l2 + GAP_PENALTY * gaps),
        "cosine": unit(q) @ unit(v).T,
        "cosine_centred": unit(centred(q, mq)) @ unit(centred(v, mv)).T,
    }


def raw_best_views(
    bundle: Map,
    dataset: Dataset,
    names: list[str],
    *,
    every: int = 1,
    report: Callable[[str, int, int], None] = lambda *_: None,
) -> dict[str, NDArray[np.int64]]:
    """Return the best place of each query (N,) by setting; -1 for a query without measurements.

    Queries use the same turns as the localizer. Settings that end in ``STRAIGHT`` use no turn.

    Args:
        bundle: the map.
        dataset: dataset of the survey and the queries.
        names: names of the query sets.
        every: take each n-th query of each set.
        report: receives a label, the number of places done and their total.
    """
    straight = turns_on(bundle.grid).index(0)
    queries, usable = _query_ranges(bundle, dataset, names, every)
    asked = queries[usable].reshape(-1, *queries.shape[2:])
    best = {name: np.full(len(usable), -1, np.int64) for name in SETTINGS}
    score = {name: np.full(len(usable), -np.inf, np.float32) for name in SETTINGS}
    settings = BuildSettings(
        name=bundle.name,
        spacing_m=bundle.manifest.spacing_m,
        headings=bundle.manifest.headings,
        expected_lidar_height_m=bundle.manifest.parameters["expected_lidar_height_m"],
        remove_weather=bool(bundle.manifest.parameters["weather_removed"]),
    )
    fans = view_ranges(dataset, settings, bundle.grid, bundle.rows_seen)
    # A map may have further places between scans. They are rendered from two scans, so this baseline has no view of them.
    total = len(thinned(dataset.survey_poses(), settings.spacing_m))
    first = 0
    while waiting := list(islice(fans, max(1, CHUNK // settings.headings))):
        views = np.concatenate(waiting)
        for name, flat in similarities(asked, views).items():
            each_turn = flat.reshape(-1, queries.shape[1], len(views))
            for setting, similarity in ((name, each_turn.max(axis=1)), (name + STRAIGHT, each_turn[:, straight])):
                at = similarity.argmax(axis=1)
                top = similarity[np.arange(len(at)), at]
                better = top > score[setting][usable]
                rows = np.flatnonzero(usable)[better]
                score[setting][rows] = top[better]
                best[setting][rows] = first + at[better] // settings.headings
        first += len(waiting)
        report("raw range images", first, total)
    return best


def _query_ranges(bundle: Map, dataset: Dataset, names: list[str], every: int) -> tuple[Ranges, NDArray[np.bool_]]:
    """Return ranges (N, turns, rows, columns), and which queries (N,) measure anything."""
    grid: ViewGrid = bundle.grid
    rows, usable = [], []
    for name in names:
        for frame in islice(dataset.queries(name), 0, None, every):
            try:
                views = query_views(
                    frame.rgb(),
                    frame.depth_m(),
                    frame.camera.pinhole(),
                    grid=grid,
                    rows_seen=bundle.rows_seen,
                    turns=turns_on(grid),
                )
                rows.append(views.planes[:, 0])
                usable.append(True)
            except NoDepthError:
                rows.append(np.zeros((len(turns_on(grid)), grid.rows, grid.columns), np.float32))
                usable.append(False)
    return np.stack(rows), np.array(usable)
