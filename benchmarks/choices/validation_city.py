"""The validation city, encoded by several encoders at once: the most similar places of each query."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.mapping.survey import fan, fan_views, kept_scans, levelled_scans, sampled_survey
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import VALIDATION_SEEDS
from service.geometry.rigid import heading_of_body
from service.imaging.query_view import query_views
from service.imaging.view_grid import PLANES, ViewGrid, survey_planes
from service.maps.streets import Streets
from service.retrieval.encoder import Encoder
from service.retrieval.retrieve import turns_on

REACH_M = 5.0


def validation_plan() -> SimulationPlan:
    """Plan a city that no training and no bar has seen."""
    drive = QueryPlan(name="drive1", traversal=1, count=500, depths=("precise", "stereo"))
    return SimulationPlan(name="watch", seed=VALIDATION_SEEDS[1], queries=(drive,))


@dataclass(frozen=True, eq=False)
class Seen:
    """Descriptors of the city by one encoder.

    Attributes:
        views: descriptors of the map views (P, headings, D).
        queries: descriptors of each query set, at each turn (Q, T, D).
    """

    views: NDArray[np.float32]
    queries: dict[str, NDArray[np.float32]]

    def similarity(self, name: str, allowed: NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Compute the similarity (Q, P) of each query's best turn to each place's best view.

        Args:
            name: name of the query set.
            allowed: mask (P, headings) of views to use; None uses all.
        """
        places, headings, size = self.views.shape
        flat = self.views.reshape(-1, size)
        best = np.empty((len(self.queries[name]), places), np.float32)
        for k, turns in enumerate(self.queries[name]):
            similarity = (turns @ flat.T).max(axis=0).reshape(places, headings)
            best[k] = (similarity if allowed is None else np.where(allowed, similarity, -2.0)).max(axis=1)
        return best


class ValidationCity:
    """Places and queries of the city, rendered as views once for all encoders.

    Args:
        dataset: the validation city.
        grid: view grid.
    """

    def __init__(self, dataset: Dataset, grid: ViewGrid) -> None:
        self.dataset, self.grid = dataset, grid
        self.settings = BuildSettings(name="watch", calibration=None)
        self.poses, self.kept = kept_scans(dataset, self.settings)
        self.rows_seen = sampled_survey(dataset, self.kept, grid, self.settings)[0]
        self.sets = dataset.query_sets(with_truth=True)

    @cached_property
    def xy(self) -> NDArray[np.float64]:
        """Positions of the places (P, 2), metres, map frame."""
        return np.asarray(self.poses[self.kept][:, :2, 3])

    @cached_property
    def true_xy(self) -> dict[str, NDArray[np.float64]]:
        """Ground-truth positions of each set's queries (Q, 2), metres, map frame."""
        truths = {name: [frame.T_map_camera for frame in self.dataset.queries(name)] for name in self.sets}
        return {name: np.array([T[:2, 3] for T in each if T is not None]) for name, each in truths.items()}

    @cached_property
    def headings_rad(self) -> NDArray[np.float64]:
        """Headings of the map views (P, headings), radians, map frame; the first is the place's principal heading."""
        turns = fan(self.settings.headings)
        scans = levelled_scans(self.dataset, self.kept, self.settings)
        rows = [heading_of_body(scan.T_map_level(self.poses[scan.number])) + scan.start_rad + turns for scan in scans]
        return np.stack(rows)

    def streets(self) -> tuple[NDArray[np.int64], dict[str, NDArray[np.int64]]]:
        """Return the street index of each place (P,), and of each query (Q,) by set; -1 for none."""
        polygons = Streets.from_geojson(self.dataset.streets() or {"type": "FeatureCollection", "features": []})

        def of(xy: NDArray[np.float64]) -> NDArray[np.int64]:
            return np.array([polygons.index_at(each) for each in xy], np.int64)

        return of(self.xy), {name: of(xy) for name, xy in self.true_xy.items()}

    def seen_by(
        self, encoders: dict[str, tuple[Encoder, tuple[str, ...]]], report: Callable[[str, int, int], None]
    ) -> dict[str, Seen]:
        """Encode the map and the queries by each encoder; leave out the query planes that its training lacked.

        Args:
            encoders: encoder and its missing planes, by name.
            report: receives a label, the number done and the total.
        """
        turns, views = fan(self.settings.headings), {name: list[NDArray[np.float32]]() for name in encoders}
        for k, scan in enumerate(levelled_scans(self.dataset, self.kept, self.settings), 1):
            planes = np.stack(
                [
                    survey_planes(view, sensor_height_m=scan.level.height_m, rows_seen=self.rows_seen, grid=self.grid)
                    for view in fan_views(scan.points, scan.start_rad + turns, self.grid)
                ]
            )
            for name, (encoder, _) in encoders.items():
                views[name].append(encoder.encode(planes, "survey"))
            report("places", k, len(self.kept))
        queries = {name: {each: list[NDArray[np.float32]]() for each in self.sets} for name in encoders}
        for each in self.sets:
            for k, frame in enumerate(self.dataset.queries(each), 1):
                asked = query_views(
                    frame.rgb(),
                    frame.depth_m(),
                    frame.camera.pinhole(),
                    grid=self.grid,
                    rows_seen=self.rows_seen,
                    turns=turns_on(self.grid),
                )
                for name, (encoder, blind) in encoders.items():
                    planes = asked.planes.copy()
                    planes[:, [PLANES.index(plane) for plane in blind]] = 0.0
                    queries[name][each].append(encoder.encode(planes, "query"))
                report(f"queries {each}", k, len(self.true_xy[each]))
        return {
            name: Seen(np.stack(views[name]), {each: np.stack(of) for each, of in queries[name].items()})
            for name in encoders
        }

    def right(self, name: str, similarity: NDArray[np.float32], *, first: int = 1) -> NDArray[np.bool_]:
        """Return for each query (Q,) whether one of the ``first`` most similar places is within 5 m.

        Args:
            name: name of the query set.
            similarity: similarities (Q, P).
            first: number of places to consider.
        """
        ranked = np.argsort(-similarity, axis=1, kind="stable")[:, :first]
        away = np.linalg.norm(self.xy[ranked] - self.true_xy[name][:, None], axis=2)
        return np.asarray((away <= REACH_M).any(axis=1))
