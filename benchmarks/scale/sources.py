"""Real descriptors for simulated scale: the views of a few small simulated cities, and queries through these cities."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64
from numpy.typing import NDArray

from benchmarks.plans import BOTH
from benchmarks.runs import Runs
from model_training.datasets.dataset import Dataset
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.training.recipe import EVALUATION_SEEDS
from service.geometry.rigid import heading_of_camera
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle

#: Number of cities, their extent (m), and the query positions of each. Each position has a query with each depth camera.
CITIES, CITY_M, POSITIONS = 2, (200.0, 200.0), 50
#: Map views of a place.
HEADINGS = 24


@dataclass(frozen=True, slots=True, eq=False)
class RealDescriptors:
    """Descriptors of maps and of queries in them.

    Attributes:
        views: unit vectors of the views of all maps, place by place, with ``HEADINGS`` views per place.
        queries: descriptors of the queries at their turns.
        true_view: the view of the nearest place that looks most nearly in the direction of the query.
    """

    views: Float32[NDArray[np.float32], "V D"]
    queries: Float32[NDArray[np.float32], "Q T D"]
    true_view: Int64[NDArray[np.int64], " Q"]

    def save(self, path: Path) -> None:
        """Save the descriptors.

        Args:
            path: file ``*.npz``.
        """
        np.savez(path, views=self.views, queries=self.queries, true_view=self.true_view)

    @classmethod
    def load(cls, path: Path) -> "RealDescriptors":
        """Load descriptors that ``save`` saved.

        Args:
            path: file ``*.npz``.
        """
        with np.load(path) as kept:
            return cls(kept["views"], kept["queries"], kept["true_view"])


def city_plan(index: int) -> SimulationPlan:
    """Plan a small city with another traversal through it.

    Args:
        index: number of the city, from 0.
    """
    queries = (QueryPlan(name="drive1", traversal=1, count=POSITIONS, depths=BOTH),)
    return SimulationPlan(name=f"scale-{index + 1}", seed=EVALUATION_SEEDS[40 + index], size_m=CITY_M, queries=queries)


def small_city(runs: Runs) -> tuple[Path, Path]:
    """Return the map of the first city and its dataset; simulate and build what is not kept.

    Args:
        runs: simulates and builds, or reuses what is kept on disk.
    """
    dataset = runs.dataset(city_plan(0))
    return _bundle(runs, dataset).path, dataset.folder


def _bundle(runs: Runs, dataset: Dataset) -> MapBundle:
    settings = BuildSettings(
        name=dataset.name, headings=HEADINGS, align_survey=False, traffic_vote=False, calibration=None
    )
    return runs.bundle(dataset, settings)


def real_descriptors(runs: Runs) -> RealDescriptors:
    """Return the descriptors of all cities; simulate and build what is not kept.

    The maps have no aligned survey, no traffic vote and no calibration, which change the cloud and the confidence.

    Args:
        runs: simulates and builds, or reuses what is kept on disk.
    """
    views: list[NDArray[np.float32]] = []
    queries: list[NDArray[np.float32]] = []
    true_view: list[int] = []
    for index in range(CITIES):
        dataset = runs.dataset(city_plan(index))
        bundle = _bundle(runs, dataset)
        first = sum(len(each) for each in views)
        views.append(bundle.view_index.vectors(np.arange(bundle.manifest.counts.views)))
        for asked, true in _queries(dataset, bundle):
            queries.append(asked)
            true_view.append(first + true)
    return RealDescriptors(np.concatenate(views), np.stack(queries), np.array(true_view))


def _queries(dataset: Dataset, bundle: MapBundle) -> list[tuple[NDArray[np.float32], int]]:
    """Return the descriptors of each query and its true view."""
    localizer, found = Localizer.open(bundle), []
    for name in dataset.query_sets(with_truth=True):
        for frame in dataset.queries(name):
            truth = frame.T_map_camera
            if truth is None:
                raise ValueError(f"{dataset.folder}: query {frame.number} of {name} has no true pose")
            place = int(np.hypot(*(bundle.places_xy - truth[:2, 3:4])).argmin())
            its = np.flatnonzero(bundle.view_place == place)
            along = np.cos(bundle.view_heading_rad[its] - heading_of_camera(truth))
            found.append((localizer.encode_and_search(frame.query(bundle.grid)).descriptors, int(its[along.argmax()])))
    return found
