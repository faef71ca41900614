"""A second pass of a simulated survey: the same streets on another day, in the other direction, added to the map by ``map update``.

The simulator makes one survey for each dataset. The second pass drives 1 m beside the first one. Half of the parking slots have other
cars, and people and driving vehicles differ. Sway, errors of the poses and noise of the scans are drawn anew.
"""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.runs import Runs
from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset, Transforms, scan_path, write_description, write_tum
from model_training.mapping.update import update_map
from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import scan
from model_training.simulation.meshes import joined
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.scene import Scene
from model_training.simulation.traversal import Station, lidar_pose, stations_along, survey_error
from service.maps.reader import MapBundle

#: Number of the second pass's traversal. No query plan has it.
TRAVERSAL = 90
#: The vehicle does not stand where an object is nearer than this at the height of the LiDAR, metres.
ROOM_M = 0.5
#: Time between scans, seconds.
_SCAN_S = 0.1
#: Keys of the random numbers of poses and of scans.
_POSES, _SCANS = 1, 2
#: Horizontal unit directions (72, 3), 5 degrees apart.
_RING = np.stack([np.cos(a := np.arange(72) * np.pi / 36), np.sin(a), np.zeros(72)], axis=1)


def second_pass(first: Dataset, plan: SimulationPlan, folder: Path) -> Dataset:
    """Simulate the second pass of a survey, or open it if the folder exists.

    Args:
        first: dataset of the first pass. Description and streets come from it.
        plan: plan of the first pass, with the spacing of the second one. Its city has no repeating blocks.
        folder: folder of the second pass. It appears when it is complete, and has no queries.
    """
    if folder.exists():
        return Dataset(folder)
    part = folder.with_name(f"{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    scan_path(part, 0).parent.mkdir(parents=True)
    city = City(seed=plan.seed, name=plan.city, size_m=plan.size_m)
    scene = Scene(joined([city.static, city.occupants(TRAVERSAL)]))
    true, written = second_poses(city, plan, lambda T: _has_room(scene, T))
    model, survey = plan.lidar_parameters.on(plan.lidar), plan.survey_parameters.model()
    rays, condition = model.rays(), CONDITIONS[plan.survey_condition]
    with bars() as report:
        for number, T in enumerate(true):
            rng = np.random.default_rng([plan.seed, TRAVERSAL, _SCANS, number])
            points = scan(scene, city.ground, model, rays, T, condition, rng, survey=survey)
            scan_path(part, number).write_bytes(points.tobytes())
            report("second pass", number + 1, len(true))
    write_tum(part / "survey" / "poses.txt", _SCAN_S * np.arange(len(true), dtype=np.float64), written)
    shutil.copy(first.folder / "streets.geojson", part)
    write_description(part, first.description.model_copy(update={"name": f"{first.name}-second-pass"}))
    part.rename(folder)
    return Dataset(folder)


def second_poses(
    city: City, plan: SimulationPlan, has_room: Callable[[NDArray[np.float64]], bool] = lambda _: True
) -> tuple[Transforms, Transforms]:
    """Return T_map_lidar of the second pass (n, 4, 4), metres: the true poses, and those that the survey reports.

    Args:
        city: city of the plan.
        plan: plan of the first pass, with the spacing of the second one.
        has_room: whether the vehicle can stand at a pose T_map_lidar (4, 4). Other poses are left out.
    """
    rng = np.random.default_rng([plan.seed, TRAVERSAL, _POSES])
    placed = [(each, lidar_pose(city, each, rng, height_m=plan.lidar_height_m)) for each in _stations(city, plan)]
    placed = [(station, T) for station, T in placed if has_room(T)]
    true, model = np.array([T for _, T in placed]), plan.survey_parameters.model()
    errors = survey_error(
        np.array([station.travelled for station, _ in placed]),
        rng,
        position_m=model.position_m,
        angle_deg=model.angle_deg,
    )
    return true, np.array([T @ error for T, error in zip(true, errors, strict=True)])


def updated(runs: Runs, bundle: MapBundle, dataset: Dataset, name: str) -> MapBundle:
    """Add a survey to a map as ``streetfix map update`` does, or reuse the new map.

    Args:
        runs: holds the folder of the maps.
        bundle: the map.
        dataset: dataset of the survey.
        name: name of the new map's folder.
    """
    folder = runs.map_folder(name, dataset)
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with bars() as report:
            update_map(bundle.path, dataset, folder, report=report)
    return MapBundle.open(folder)


def _stations(city: City, plan: SimulationPlan) -> list[Station]:
    """Return the stations of the same streets from their other ends, to the right of the centre line in this direction."""
    surveyed = [street for street in city.streets if not plan.streets or street.street in plan.streets]
    back = [replace(street, lines=tuple(line[::-1] for line in street.lines[::-1])) for street in surveyed[::-1]]
    return stations_along(back, plan.spacing_m)


def _has_room(scene: Scene, T_map_lidar: NDArray[np.float64]) -> bool:
    distance = scene.distances(T_map_lidar[:3, 3], _RING)
    return not bool(((distance > 0) & (distance < ROOM_M)).any())
