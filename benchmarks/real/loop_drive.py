"""A simulated drive around city blocks, as a recording without poses, to measure loop closure."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from model_training.datasets.dataset import LidarSensor
from model_training.importing.recording import Event, Notes, RecordedScan
from model_training.importing.trajectory import Trajectory
from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.lidar import scan
from model_training.simulation.meshes import joined
from model_training.simulation.scene import Scene
from model_training.simulation.sensor_parameters import LidarParameters
from model_training.simulation.traversal import Station, lidar_pose

SPEED_M_S = 10.0
#: Window of the moving average over the path, metres, applied twice. A vehicle turns with a radius of 5 m or more.
CORNER_M = 12.0


class LoopDrive:
    """A vehicle that follows the streets of a city and turns at crossings.

    Args:
        seed: seed of the city and of the drive.
        length_m: length of the drive, metres.
        step_m: distance between scans, metres.
    """

    kind = "simulated drive"
    georeference: dict[str, Any] | None = None
    lidar = LidarSensor(name="paper_32", channels=32)
    notes = Notes()
    has_images = False

    def __init__(self, seed: int, *, length_m: float, step_m: float = 1.0) -> None:
        self._city = City(seed=seed)
        rng = np.random.default_rng([seed, 51])
        line = _rounded(_rounded(_walk(self._city, length_m, rng), step_m), step_m)
        ahead = np.gradient(line, axis=0)
        headings = np.arctan2(ahead[:, 1], ahead[:, 0])
        stations = [
            Station(x, y, heading, k * step_m)
            for k, ((x, y), heading) in enumerate(zip(line.tolist(), headings.tolist(), strict=True))
        ]
        self.T_map_lidar: NDArray[np.float64] = np.array([lidar_pose(self._city, s, rng) for s in stations])
        self.stamps_s = np.arange(len(stations)) * step_m / SPEED_M_S
        self._seed = seed

    def count(self) -> int:
        """Return the number of scans."""
        return len(self.stamps_s)

    def trajectory(self) -> Trajectory | None:
        """Return None: the recording has no poses."""
        return None

    def events(self, *, pictures: bool = True) -> Iterator[Event]:
        """Yield the scans. Each is simulated when it is needed.

        Args:
            pictures: without effect; the recording has no images.
        """
        del pictures
        scene = Scene(joined([self._city.static, self._city.occupants(0)]))
        model = LidarParameters().on("paper_32")
        rays = model.rays()
        for k, (stamp_s, T) in enumerate(zip(self.stamps_s, self.T_map_lidar, strict=True)):
            rng = np.random.default_rng([self._seed, 52, k])
            points = scan(scene, self._city.ground, model, rays, T, CONDITIONS["clear"], rng)
            yield RecordedScan(f"scan {k}", float(stamp_s), points)


def _walk(city: City, length_m: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return points (n, 2) of a path along streets, metres. At each crossing it takes the least used piece and never turns back."""
    lines = [shapely.LineString(line) for street in city.streets for line in street.lines]
    pieces = [np.array(piece.coords) for piece in shapely.get_parts(shapely.node(shapely.MultiLineString(lines)))]
    ends: dict[tuple[float, float], list[NDArray[np.float64]]] = {}
    for piece in pieces:
        for way in (piece, piece[::-1]):
            ends.setdefault(_key(way[0]), []).append(way)
    used: dict[frozenset[tuple[float, float]], int] = {}
    at = max(ends, key=lambda key: (len(ends[key]), key))
    came_from: tuple[float, float] | None = None
    path, travelled = [np.array([at])], 0.0
    while travelled < length_m:
        ways = [way for way in ends[at] if _key(way[-1]) != came_from and len(ends[_key(way[-1])]) > 1] or ends[at]
        order = rng.permutation(len(ways))
        way = min((ways[k] for k in order), key=lambda way: used.get(_piece(way), 0))
        used[_piece(way)] = used.get(_piece(way), 0) + 1
        travelled += float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
        path.append(way[1:])
        came_from, at = at, _key(way[-1])
    return np.concatenate(path)


def _key(point: NDArray[np.float64]) -> tuple[float, float]:
    return round(float(point[0]), 3), round(float(point[1]), 3)


def _piece(way: NDArray[np.float64]) -> frozenset[tuple[float, float]]:
    return frozenset({_key(way[0]), _key(way[-1]), _key(way[len(way) // 2])})


def _rounded(line: NDArray[np.float64], step_m: float) -> NDArray[np.float64]:
    """Resample a path (n, 2) to steps of ``step_m`` and smooth its corners by a moving average over ``CORNER_M``."""
    along = np.r_[0.0, np.cumsum([float(np.linalg.norm(b - a)) for a, b in pairwise(line)])]
    at = np.arange(0.0, along[-1], step_m)
    even = np.stack([np.interp(at, along, line[:, axis]) for axis in range(2)], axis=1)
    window = max(1, round(CORNER_M / step_m))
    padded = np.pad(even, ((window // 2, window - 1 - window // 2), (0, 0)), mode="edge")
    kernel = np.full(window, 1.0 / window)
    return np.stack([np.convolve(padded[:, axis], kernel, mode="valid") for axis in range(2)], axis=1)
