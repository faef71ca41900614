"""What a distorting lens costs: the same poses by a pinhole camera, by two lenses, and by the pinholes that they are rectified to.

``python -m benchmarks.lenses`` prints the tables of decision 0152. The city is a validation city. Images are rendered along the rays of
the lens, so the simulation does not use the tables of the service.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.runs import Runs
from model_training.datasets.dataset import Dataset
from model_training.simulation.camera import take, unit_rays
from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.depth_noise import DEPTHS, measured_depth
from model_training.simulation.meshes import joined
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.scene import Scene
from model_training.simulation.shading import Light
from model_training.stock import ENCODER
from model_training.training.recipe import VALIDATION_SEEDS
from service.errors import NoDepthError
from service.geometry.camera import PinholeCamera
from service.imaging.rectify import rectification_of, rectified_pair
from service.imaging.view_grid import ViewGrid
from service.localization.localizer import Localizer
from service.maps.calibration import RIGHT_M
from service.retrieval.query import DepthFormat, Query, decoded_query
from service.runtime.threads import limit_pools

PLAIN = PinholeCamera(640, 480, 320.0, 320.0, 319.5, 239.5)
#: 104 degrees across with barrel distortion, and an equidistant fisheye lens of 120 degrees across.
LENSES = {
    "brown_conrady": PinholeCamera(640, 480, 320.0, 320.0, 319.5, 239.5, (-0.3, 0.1, 0.0, 0.0)),
    "kannala_brandt": PinholeCamera(
        640, 480, 320 / np.deg2rad(60), 320 / np.deg2rad(60), 319.5, 239.5, (0.0,) * 4, "kannala_brandt"
    ),
}
#: A stereo camera of KITTI's size with its raw distortion, for the cost only.
KITTI_SIZE = PinholeCamera(1242, 375, 960.0, 960.0, 609.0, 172.0, (-0.37, 0.2, 0.001, 0.0, -0.07))
QUERIES = "drive1"


@dataclass(frozen=True, slots=True)
class Answered:
    """Answers to the queries of one camera.

    Attributes:
        error_m: distance of the best guess from the ground truth (N,); infinite if nothing was measured.
        localized: whether the answer is LOCALIZED (N,).
    """

    error_m: NDArray[np.float64]
    localized: NDArray[np.bool_]


def plan_of(count: int) -> SimulationPlan:
    """Plan the validation city and its queries.

    Args:
        count: number of queries.
    """
    queries = (QueryPlan(name=QUERIES, traversal=1, count=count, depths=("precise",)),)
    return SimulationPlan(name="lenses", seed=VALIDATION_SEEDS[50], size_m=(240.0, 160.0), queries=queries)


class Photographer:
    """Takes the queries of a simulated dataset again with any camera.

    Args:
        dataset: simulated by ``plan``.
        plan: plan of the dataset.
    """

    def __init__(self, dataset: Dataset, plan: SimulationPlan) -> None:
        self._plan, self._query = plan, plan.queries[0]
        self._city = City(seed=plan.seed, name=plan.city, size_m=plan.size_m)
        occupants = self._city.occupants(self._query.traversal, parked_changed=self._query.parked_changed)
        self._scene = Scene(joined([self._city.static, occupants]))
        drive = np.random.default_rng([plan.seed, 32, self._query.traversal])
        self._light = Light.of(CONDITIONS[self._query.condition], drive, elevation_deg=None, azimuth_deg=None)
        frames = list(dataset.queries(f"{QUERIES}_{self._query.depths[0]}"))
        self.poses = [frame.T_map_camera for frame in frames if frame.T_map_camera is not None]

    def encoded(self, camera: PinholeCamera, number: int, depth: str) -> tuple[bytes, bytes]:
        """Take one image pair: a JPEG and a 16-bit PNG in millimetres.

        Args:
            camera: intrinsics and distortion.
            number: of the pose.
            depth: preset of the depth camera.
        """
        key = [self._plan.seed, 33, self._query.traversal, number]
        rays, z_of_ray = unit_rays(camera)
        condition = CONDITIONS[self._query.condition]
        picture = take(
            self._scene,
            self._city.ground,
            camera,
            self.poses[number],
            self._light,
            condition,
            self._query.rgb_model(),
            np.random.default_rng(key),
            rays_camera=rays,
            z_of_ray=z_of_ray,
        )
        z_m = measured_depth(picture.depth_m, picture.blank, DEPTHS[depth], condition, np.random.default_rng([*key, 0]))
        steps = np.rint(1000 * z_m).clip(0, 65535).astype(np.uint16)
        rgb = cv2.imencode(".jpg", picture.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        return rgb, cv2.imencode(".png", steps)[1].tobytes()


def answered(localizer: Localizer, queries: list[Query], poses: list[NDArray[np.float64]]) -> Answered:
    """Localize the queries of one camera.

    Args:
        localizer: of the map.
        queries: one for each pose.
        poses: ground truth, T_map_camera.
    """
    error_m, localized = list[float](), list[bool]()
    for query, T in zip(queries, poses, strict=True):
        try:
            answer = localizer.localize(query)
        except NoDepthError:
            error_m.append(np.inf)
            localized.append(False)
            continue
        error_m.append(float(np.linalg.norm(answer.T_map_camera_guess[:2, 3] - T[:2, 3])))
        localized.append(answer.status == "LOCALIZED")
    return Answered(np.array(error_m), np.array(localized))


def line_of(name: str, found: Answered) -> str:
    """Format the figures of one camera as a row of a table.

    Args:
        name: of the camera.
        found: its answers.
    """
    right = found.error_m <= RIGHT_M
    wrong = found.localized & ~right
    median = float(np.median(found.error_m[right])) if right.any() else float("nan")
    return f"| {name} | {right.sum()} of {len(right)} | {(found.localized & right).sum()} | {wrong.sum()} | {median:.3f} m |"


def cost_line(name: str, camera: PinholeCamera, rounds: int = 200) -> str:
    """Measure the rectification of an image pair, and format it as a row of a table.

    Args:
        name: of the camera.
        camera: intrinsics and distortion.
        rounds: rectifications after the first one.
    """
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (camera.height, camera.width, 3), np.uint8)
    depth_m = rng.uniform(1, 40, (camera.height, camera.width)).astype(np.float32)
    wall_ms, processor_ms = [], []
    for _ in range(rounds + 1):
        began, worked = time.perf_counter(), time.thread_time()
        rectified_pair(rgb, depth_m, camera)
        wall_ms.append(1000 * (time.perf_counter() - began))
        processor_ms.append(1000 * (time.thread_time() - worked))
    later = f"{np.median(wall_ms[1:]):.2f} | {np.median(processor_ms[1:]):.2f}"
    return f"| {name}, {camera.width} x {camera.height} | {wall_ms[0]:.1f} | {processor_ms[0]:.1f} | {later} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--work", type=Path, default=Path("build/lenses"), help="folder of the dataset and the map")
    parser.add_argument("--count", type=int, default=60, help="number of queries")
    given = parser.parse_args()
    limit_pools()
    print("| lens | first pair, ms | processor time | later pairs, median, ms | processor time |")
    for name, camera in (*LENSES.items(), ("brown_conrady", KITTI_SIZE)):
        print(cost_line(name, camera))
    runs, plan = Runs(given.work, ENCODER), plan_of(given.count)
    dataset = runs.dataset(plan)
    bundle = runs.bundle(dataset)
    localizer, photographer = Localizer.open(bundle), Photographer(dataset, plan)
    cameras = {"plain": PLAIN} | LENSES
    cameras |= {f"pinhole of {name}": rectification_of(camera).camera for name, camera in LENSES.items()}
    for depth in ("precise", "stereo"):
        print(f"\n{depth} depth | within {RIGHT_M:g} m | LOCALIZED and right | LOCALIZED and wrong | median error")
        for name, camera in cameras.items():
            queries = [
                _decoded(photographer.encoded(camera, k, depth), camera, bundle.grid) for k in range(given.count)
            ]
            print(line_of(name, answered(localizer, queries, photographer.poses)), flush=True)


def _decoded(encoded: tuple[bytes, bytes], camera: PinholeCamera, grid: ViewGrid) -> Query:
    return decoded_query(*encoded, camera, DepthFormat(), grid=grid)


if __name__ == "__main__":
    main()
