"""Write a simulated dataset: scans and image pairs, by a pool of workers. An interrupted run can be resumed.

The bytes do not depend on the number of workers, because every frame draws its errors from its own seed. Files get their final name
when they are complete. ``dataset.json`` comes last, so a folder without it is continued.
"""

import json
import multiprocessing
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from model_training.datasets.dataset import (
    CameraSensor,
    DatasetDescription,
    DepthSpec,
    LidarSensor,
    Sensors,
    SurveyAccuracy,
    query_folder,
    scan_path,
    write_description,
    write_tum,
)
from model_training.simulation.blocker import Blocker
from model_training.simulation.camera import Picture, take, unit_rays
from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.depth_noise import measured_depth
from model_training.simulation.drives import Quota, Survey, followed, query_candidates, quota_of, survey_of
from model_training.simulation.exposure import METERING
from model_training.simulation.lidar import scan
from model_training.simulation.meshes import joined
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.repeating import RepeatingCity
from model_training.simulation.scene import Scene
from model_training.simulation.shading import Light
from model_training.simulation.stereo_pair import STEREOS, StereoRig
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

#: Metres per unit of a depth image.
DEPTH_SCALE_M = 0.001
#: If 40 % of the image is nearer than this, metres, the pose is rejected: the robot would stand beside a vehicle.
TOO_NEAR_M = 1.5
#: Half the robot's width: no object may be nearer in any direction, metres.
ROOM_M = 1.0
#: Receives the stage, the number of finished frames and their total.
Report = Callable[[str, int, int], None]


def simulate(plan: SimulationPlan, out: Path, *, workers: int | None = None, report: Report = lambda *_: None) -> None:
    """Simulate a plan into a folder.

    Args:
        plan: settings of the dataset.
        out: a new folder, or the folder of an interrupted run of the same plan.
        workers: number of processes; None takes one per core.
        report: called after every frame with the stage, the number of finished frames and their total.

    Raises:
        DatasetError: the plan names an unknown preset, ``out`` holds something else, or too few query poses are free.
    """
    plan = plan.checked()
    if not _claim(out, plan):
        return
    city = _city(plan)
    survey = survey_of(city, plan)
    workers = workers or os.cpu_count() or 1
    _survey(city, plan, survey, out, workers, report)
    for query in plan.queries:
        _queries(city, plan, query, survey, out, workers, report)
    _streets(city, out)
    write_description(out, _description(plan))
    (out / "simulation.json").rename(out / "simulation.done.json")


def _city(plan: SimulationPlan) -> City:
    if plan.city == "repeating":
        return RepeatingCity(seed=plan.seed)
    return City(seed=plan.seed, name=plan.city, size_m=plan.size_m)


def _claim(out: Path, plan: SimulationPlan) -> bool:
    """Write the plan into ``out`` and return whether there is work to do."""
    text = plan.model_dump_json(indent=2) + "\n"
    for name in ("simulation.done.json", "simulation.json"):
        path = out / name
        if path.exists():
            if path.read_text() != text:
                raise DatasetError(
                    f"{out} contains the simulation of another plan; choose another --out, or remove it", field="out"
                )
            return name == "simulation.json"
    if out.exists() and any(out.iterdir()):
        raise DatasetError(f"{out} is not empty and contains no simulation; choose another --out", field="out")
    out.mkdir(parents=True, exist_ok=True)
    (out / "simulation.json").write_text(text)
    return True


@dataclass
class _Job:
    """State that workers inherit: the scene and everything that is the same for all frames of a traversal.

    Attributes:
        plan: settings of the dataset.
        city: city of the plan.
        scene: static objects and occupants of the traversal.
        out: folder of the dataset.
        survey: poses of the survey, for scans.
        query: query traversal, for image pairs.
        light: sun and sky of the query traversal.
        camera: intrinsics.
        rays: unit rays of the LiDAR or the camera (n, 3), in its own frame.
        z_of_ray: z components of the camera's rays (n,).
        candidates: T_map_camera (n, 4, 4), metres.
    """

    plan: SimulationPlan
    city: City
    scene: Scene
    out: Path
    survey: Survey | None = None
    query: QueryPlan | None = None
    light: Light | None = None
    camera: PinholeCamera | None = None
    rays: NDArray[np.float32] | None = None
    z_of_ray: NDArray[np.float32] | None = None
    candidates: NDArray[np.float64] | None = None


_job: _Job | None = None  # set before the workers are forked, so they share the scene instead of copying it


def _run(job: _Job, work: Callable[[int], Any], items: Iterable[int], workers: int) -> Iterable[Any]:
    """Yield the results of ``work`` in the order of ``items``."""
    global _job
    _job = job
    cv2.setNumThreads(1)
    pool: Pool
    # One worker runs per core. BLAS threads would only spin and take the core from other workers.
    with threadpool_limits(1, user_api="blas"):
        if workers == 1:
            yield from map(work, items)
            return
        with multiprocessing.get_context("fork").Pool(workers) as pool:
            yield from pool.imap(work, items, chunksize=4)


def _survey(city: City, plan: SimulationPlan, survey: Survey, out: Path, workers: int, report: Report) -> None:
    scan_path(out, 0).parent.mkdir(parents=True, exist_ok=True)
    count = len(survey.stations)
    todo = [k for k in range(count) if not scan_path(out, k).exists()]
    if todo:
        scene = Scene(joined([city.static, city.occupants(0)]))
        job = _Job(plan, city, scene, out, survey=survey, rays=plan.lidar_parameters.on(plan.lidar).rays())
        for done, _ in enumerate(_run(job, _one_scan, todo, workers), count - len(todo) + 1):
            report("survey", done, count)
    write_tum(out / "survey" / "poses.txt", np.arange(count, dtype=np.float64) * 0.1, survey.T_map_lidar_written)


def _one_scan(number: int) -> int:
    job = _job
    if job is None or job.survey is None or job.rays is None:
        raise RuntimeError("a worker was started without its job")
    plan, survey, T = job.plan, job.plan.survey_parameters.model(), job.survey.T_map_lidar[number]
    ahead = None
    if survey.followed > 0:
        station = job.survey.stations[number]
        ahead = _vehicle_ahead(job, T[:2, 3], station.heading, station.travelled, 0, survey.followed)
    points = scan(
        job.scene,
        job.city.ground,
        plan.lidar_parameters.on(plan.lidar),
        job.rays,
        T,
        CONDITIONS[plan.survey_condition],
        np.random.default_rng([plan.seed, 31, number]),
        survey=survey,
        ahead=ahead,
    )
    _write(scan_path(job.out, number), points.tobytes())
    return number


def _vehicle_ahead(
    job: _Job, xy: NDArray[np.float64], heading: float, along_m: float, traversal: int, share: float
) -> Blocker | None:
    place = np.array([*xy, job.city.height(*xy)])
    drive = np.random.default_rng([job.plan.seed, 14, traversal])
    return Blocker.driving_ahead(place, heading, along_m, share, drive)


def _queries(
    city: City, plan: SimulationPlan, query: QueryPlan, survey: Survey, out: Path, workers: int, report: Report
) -> None:
    sets = {depth: query_folder(out, f"{query.name}_{depth}") for depth in query.depths}
    if all((folder / "poses.txt").exists() for folder in sets.values()):
        return
    candidates = query_candidates(city, plan, query, survey)
    quota = quota_of(city, query, candidates)
    camera = plan.camera.pinhole()
    rays, z_of_ray = unit_rays(camera)
    light = Light.of(
        CONDITIONS[query.condition],
        np.random.default_rng([plan.seed, 32, query.traversal]),
        elevation_deg=query.sun_elevation_deg,
        azimuth_deg=query.sun_azimuth_deg,
    )
    scene = Scene(joined([city.static, city.occupants(query.traversal, parked_changed=query.parked_changed)]))
    job = _Job(
        plan,
        city,
        scene,
        out,
        query=query,
        light=light,
        camera=camera,
        rays=rays,
        z_of_ray=z_of_ray,
        candidates=candidates,
    )
    chosen = _free_candidates(job, quota)
    for folder in sets.values():
        for part in ("rgb", "depth"):
            (folder / part).mkdir(parents=True, exist_ok=True)
    job.candidates = followed(city, query, candidates[chosen])
    chosen = np.arange(len(job.candidates))
    todo = [k for k in range(len(chosen)) if not all(_pair(folder, k)[1].exists() for folder in sets.values())]
    for done, _ in enumerate(_run(job, _one_pair, todo, workers), len(chosen) - len(todo) + 1):
        report(f"queries {query.name}", done, len(chosen))
    stamps = np.arange(len(chosen), dtype=np.float64)
    for folder in sets.values():
        write_tum(folder / "poses.txt", stamps, job.candidates)


def _free_candidates(job: _Job, quota: Quota) -> NDArray[np.int64]:
    """Return the indices of the first candidates of each class that have free space around them.

    One process does this. A check casts 840 rays per pose, so starting other processes would cost more.
    """
    left = list(quota.wanted)
    chosen: dict[int, list[int]] = {k: [] for k in range(len(left))}
    order = [k for k in range(len(quota.class_of)) if quota.class_of[k] >= 0]
    step = 256
    for start in range(0, len(order), step):
        part = [k for k in order[start : start + step] if left[quota.class_of[k]] > 0]
        for k, free in zip(part, _run(job, _is_free, part, workers=1), strict=True):
            index = int(quota.class_of[k])
            if free and left[index] > 0:
                left[index] -= 1
                chosen[index].append(k)
        if not any(left):
            break
    if any(left):
        raise DatasetError(
            f"only {sum(map(len, chosen.values()))} of {sum(quota.wanted)} queries could be placed; simulate more "
            "streets or fewer queries",
            field="queries",
        )
    return np.array([k for index in sorted(chosen) for k in chosen[index]])


#: Horizontal unit directions (72, 3), 5 degrees apart.
_RING = np.stack([np.cos(a := np.arange(72) * np.pi / 36), np.sin(a), np.zeros(72)], axis=1)
#: Camera of a few rays, for the test of free space ahead.
_COARSE = PinholeCamera(32, 24, 16.0, 16.0, 15.5, 11.5)


def _is_free(k: int) -> bool:
    job = _job
    if job is None or job.candidates is None:
        raise RuntimeError("a worker was started without its job")
    rays, _ = unit_rays(_COARSE)
    if job.query is None:
        raise RuntimeError("a worker was started without its query")
    return all(_has_room(job, T, rays) for T in followed(job.city, job.query, job.candidates[k : k + 1]))


def _has_room(job: _Job, T: NDArray[np.float64], rays: NDArray[np.float32]) -> bool:
    distance = job.scene.distances(T[:3, 3], rays @ T[:3, :3].T.astype(np.float32))
    met = distance[distance > 0]
    around = job.scene.distances(T[:3, 3] - [0.0, 0.0, 0.6], _RING)
    beside = around[around > 0]
    return len(met) > 0 and float(np.percentile(met, 40)) > TOO_NEAR_M and bool((beside > ROOM_M).all())


def _pair(folder: Path, number: int) -> tuple[Path, Path]:
    return folder / "rgb" / f"{number:06d}.jpg", folder / "depth" / f"{number:06d}.png"


def _one_pair(number: int) -> int:
    job = _job
    if job is None or job.query is None or job.light is None or job.camera is None or job.candidates is None:
        raise RuntimeError("a worker was started without its job")
    if job.rays is None or job.z_of_ray is None:
        raise RuntimeError("a worker was started without its rays")
    plan, query, T = job.plan, job.query, job.candidates[number]
    condition = CONDITIONS[query.condition]
    key = [plan.seed, 33, query.traversal, number]
    rng = np.random.default_rng(key)
    blocker = None
    if query.blocked > 0:
        blocker = Blocker.before(T, job.city.height(T[0, 3], T[1, 3]), query.blocked, rng)
    elif query.followed is not None:
        # Queries have no order along the way, so the travelled distance is random.
        heading = float(np.arctan2(T[1, 2], T[0, 2])) - float(np.deg2rad(query.turn_deg))
        along_m = float(rng.uniform(0, 10_000))
        blocker = _vehicle_ahead(job, T[:2, 3], heading, along_m, query.traversal, query.followed)
    metering = float(rng.uniform(*METERING)) if query.matched() else None  # both cameras of a rig share the exposure

    camera, light, rays, z_of_ray = job.camera, job.light, job.rays, job.z_of_ray

    def taken(T_map_eye: NDArray[np.float64], rng: np.random.Generator) -> Picture:
        return take(
            job.scene,
            job.city.ground,
            camera,
            T_map_eye,
            light,
            condition,
            query.rgb_model(),
            rng,
            rays_camera=rays,
            z_of_ray=z_of_ray,
            blocker=blocker,
            metering=metering,
        )

    picture = taken(T, rng)
    encoded = cv2.imencode(".jpg", picture.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
    right: Picture | None = None
    for index, name in enumerate(query.depths):
        folder = query_folder(job.out, f"{query.name}_{name}")
        rgb_path, depth_path = _pair(folder, number)
        if name in STEREOS:
            drive = np.random.default_rng([plan.seed, 34, query.traversal])
            rig = StereoRig.drawn(query.stereo_parameters.on(name), camera, drive)
            right = right or taken(T @ rig.T_left_right, np.random.default_rng([*key, 35]))
            depth = rig.depth(picture.rgb, right.rgb)
        else:
            model = query.depth_parameters.on(name)
            depth = measured_depth(
                picture.depth_m, picture.blank, model, condition, np.random.default_rng([*key, index])
            )
        if query.max_depth_m is not None:
            depth[depth > query.max_depth_m] = 0
        steps = np.rint(depth / DEPTH_SCALE_M).clip(0, 65535).astype(np.uint16)
        _write(rgb_path, encoded)
        _write(depth_path, cv2.imencode(".png", steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())
    return number


def _write(path: Path, data: bytes) -> None:
    """Write a file under a temporary name first, so that an existing file is always complete."""
    part = path.with_name(path.name + ".part")
    part.write_bytes(data)
    part.rename(path)


def _streets(city: City, out: Path) -> None:
    _write(out / "streets.geojson", (json.dumps(city.streets_geojson()) + "\n").encode())


def _description(plan: SimulationPlan) -> DatasetDescription:
    lidar, camera = plan.lidar_parameters.on(plan.lidar), plan.camera.pinhole()
    survey = plan.survey_parameters.model()
    focal_baseline = plan.focal_baseline_px_m()
    baseline_m = None if focal_baseline is None else focal_baseline / camera.fx
    return DatasetDescription(
        name=plan.name,
        source={"kind": "simulation", "plan": plan.model_dump(mode="json")},
        sensors=Sensors(
            lidars=[
                LidarSensor(
                    name=lidar.name,
                    channels=lidar.channels,
                    top_deg=lidar.top_deg,
                    bottom_deg=lidar.bottom_deg,
                    max_range_m=lidar.max_range_m,
                )
            ],
            cameras=[
                CameraSensor(
                    name="front",
                    width=camera.width,
                    height=camera.height,
                    fx=camera.fx,
                    fy=camera.fy,
                    cx=camera.cx,
                    cy=camera.cy,
                    depth=DepthSpec(scale_m=DEPTH_SCALE_M, kind="z", max_range_m=None, baseline_m=baseline_m),
                )
            ],
        ),
        conditions={
            "survey": plan.survey_condition,
            "queries": {query.name: query.condition for query in plan.queries},
        },
        seed=plan.seed,
        survey_accuracy=SurveyAccuracy(position_std_m=survey.position_m, angle_std_deg=survey.angle_deg)
        if plan.survey_error
        else SurveyAccuracy(position_std_m=0.0, angle_std_deg=0.0),
    )
