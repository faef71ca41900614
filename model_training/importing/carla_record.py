"""Record a traversal in a running CARLA: RGB, depth and LiDAR of one vehicle, frame by frame in synchronous mode.

``carla_folder`` reads the files. Only this module talks to a server. It needs the package ``carla``.
"""

import csv
import queue
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from model_training.datasets.png import write_png
from model_training.importing.carla_folder import (
    POSE_COLUMNS,
    CarlaCamera,
    CarlaLidar,
    CarlaRecording,
    Mounting,
    write_recording,
)
from service.errors import DatasetError


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """Settings of a recording.

    Attributes:
        town: map to load before; empty keeps the current world.
        weather: a name of ``carla.WeatherParameters``, such as ``ClearNoon``; empty keeps the current weather.
        frames: number of frames.
        step_s: time between frames, seconds; also the step of the simulation.
        seed: seed of the traffic manager and of the vehicle's start.
        timeout_s: greatest time for an answer of the server, seconds.
        lidar: the LiDAR.
        camera: RGB and depth camera.
    """

    town: str = ""
    weather: str = ""
    frames: int = 600
    step_s: float = 0.1
    seed: int = 0
    timeout_s: float = 20.0
    lidar: CarlaLidar = field(default_factory=lambda: CarlaLidar(mounting=Mounting(z=1.8)))
    camera: CarlaCamera = field(
        default_factory=lambda: CarlaCamera(width=640, height=480, fov_deg=90.0, mounting=Mounting(x=0.5, z=1.5))
    )


class MomentWriter:
    """Write moments as they come. What is written can be read at any time.

    Args:
        out: a new folder.
        recording: mountings and camera.

    Raises:
        DatasetError: ``out`` is not empty.
    """

    def __init__(self, out: Path, recording: CarlaRecording) -> None:
        if out.exists() and any(out.iterdir()):
            raise DatasetError(f"{out} exists and is not empty; choose another folder", field="out")
        for kind in ("lidar", "rgb", "depth"):
            (out / kind).mkdir(parents=True, exist_ok=True)
        write_recording(out, recording)
        self._out = out
        with (out / "poses.csv").open("w", newline="") as file:
            csv.writer(file).writerow(POSE_COLUMNS)

    def write(self, frame: int, stamp_s: float, transform: Any, *, lidar: Any, rgb: Any, depth: Any) -> None:
        """Write one moment. The pose comes last, so a frame with a pose is complete.

        Args:
            frame: CARLA's number of the frame.
            stamp_s: simulated time, seconds.
            transform: ``carla.Transform`` of the vehicle.
            lidar: ``carla.LidarMeasurement``.
            rgb: ``carla.Image`` of the RGB camera.
            depth: ``carla.Image`` of the depth camera.
        """
        name = f"{frame:08d}"
        points = np.frombuffer(lidar.raw_data, np.float32).reshape(-1, 4)
        _write_ply(self._out / "lidar" / f"{name}.ply", points)
        for kind, image in (("rgb", rgb), ("depth", depth)):
            bgra = np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)
            write_png(self._out / kind / f"{name}.png", np.ascontiguousarray(bgra[:, :, :3]))
        at, turned = transform.location, transform.rotation
        with (self._out / "poses.csv").open("a", newline="") as file:
            csv.writer(file).writerow([name, f"{stamp_s:.6f}", at.x, at.y, at.z, turned.roll, turned.pitch, turned.yaw])


def record(host: str, port: int, out: Path, settings: RecordSettings, *, report: Callable[[int, int], None]) -> int:
    """Let the autopilot drive a vehicle, and record it.

    At the end, also after Ctrl-C, the world gets its settings back and the actors are removed. What was recorded stays.

    Args:
        host: name or address of the server.
        port: of the server.
        out: a new folder.
        settings: of the recording.
        report: called with the frames done and all frames.

    Returns:
        Number of recorded frames.

    Raises:
        DatasetError: the server does not answer, stops answering, or does not know a name; or ``out`` is not empty.
    """
    import carla

    done = 0

    def count(frames: int, of: int) -> None:
        nonlocal done
        done = frames
        report(frames, of)

    client = carla.Client(host, port)
    client.set_timeout(settings.timeout_s)
    try:
        return _recorded(carla, client, out, settings, count)
    except RuntimeError as error:  # all errors of the client, time-outs included
        told_by = f"CARLA at {host}:{port} failed ({error})"
        remedy = (
            f"{done} frames are in {out}; start it again" if done else "start it, or choose another --host or --town"
        )
        raise DatasetError(f"{told_by}; {remedy}", field="host") from error


def _recorded(carla: Any, client: Any, out: Path, settings: RecordSettings, report: Callable[[int, int], None]) -> int:
    world = client.load_world(settings.town) if settings.town else client.get_world()
    if settings.weather:
        if not hasattr(carla.WeatherParameters, settings.weather):
            raise DatasetError(
                f"weather: CARLA has no preset {settings.weather!r}; use one such as ClearNoon", field="weather"
            )
        world.set_weather(getattr(carla.WeatherParameters, settings.weather))
    town = world.get_map().name.rsplit("/", 1)[-1]
    with _synchronous(world, client, settings), ExitStack() as actors:
        vehicle = _vehicle(world, settings, actors)
        sensors = {kind: _sensor(carla, world, vehicle, kind, settings, actors) for kind in ("lidar", "rgb", "depth")}
        writer = MomentWriter(out, CarlaRecording(town=town, lidar=settings.lidar, camera=settings.camera))
        for done in range(1, settings.frames + 1):
            frame = world.tick()
            data = {kind: _of_frame(waiting, frame, settings.timeout_s) for kind, waiting in sensors.items()}
            snapshot = world.get_snapshot()
            writer.write(frame, snapshot.timestamp.elapsed_seconds, vehicle.get_transform(), **data)
            report(done, settings.frames)
    return settings.frames


@contextmanager
def _synchronous(world: Any, client: Any, settings: RecordSettings) -> Iterator[None]:
    before, wanted = world.get_settings(), world.get_settings()
    wanted.synchronous_mode, wanted.fixed_delta_seconds = True, settings.step_s
    traffic = client.get_trafficmanager()
    with ExitStack() as put_back:
        put_back.callback(world.apply_settings, before)
        put_back.callback(traffic.set_synchronous_mode, False)
        traffic.set_synchronous_mode(True)
        traffic.set_random_device_seed(settings.seed)
        world.apply_settings(wanted)
        yield


def _vehicle(world: Any, settings: RecordSettings, actors: ExitStack) -> Any:
    blueprint = world.get_blueprint_library().filter("vehicle.*model3*")[0]
    places = world.get_map().get_spawn_points()
    rng = np.random.default_rng(settings.seed)
    for k in rng.permutation(len(places)):
        vehicle = world.try_spawn_actor(blueprint, places[int(k)])
        if vehicle is not None:
            actors.callback(vehicle.destroy)
            vehicle.set_autopilot(True)
            return vehicle
    raise DatasetError("the map has no free place for a vehicle; restart the world", field="town")


def _sensor(
    carla: Any, world: Any, vehicle: Any, kind: str, settings: RecordSettings, actors: ExitStack
) -> "queue.Queue[Any]":
    library = world.get_blueprint_library()
    name = {"lidar": "sensor.lidar.ray_cast", "rgb": "sensor.camera.rgb", "depth": "sensor.camera.depth"}[kind]
    blueprint = library.find(name)
    mounting = settings.lidar.mounting if kind == "lidar" else settings.camera.mounting
    for key, value in attributes(kind, settings).items():
        blueprint.set_attribute(key, value)
    place = carla.Transform(
        carla.Location(x=mounting.x, y=mounting.y, z=mounting.z),
        carla.Rotation(roll=mounting.roll, pitch=mounting.pitch, yaw=mounting.yaw),
    )
    sensor = world.spawn_actor(blueprint, place, attach_to=vehicle)
    actors.callback(sensor.destroy)
    waiting: queue.Queue[Any] = queue.Queue()
    sensor.listen(waiting.put)
    actors.callback(sensor.stop)
    return waiting


def attributes(kind: str, settings: RecordSettings) -> dict[str, str]:
    """Return the attributes of a sensor's blueprint, named as in CARLA's reference. A LiDAR turns once per frame.

    Args:
        kind: ``lidar``, ``rgb`` or ``depth``.
        settings: of the recording.
    """
    if kind == "lidar":
        lidar = settings.lidar
        return {
            "channels": str(lidar.channels),
            "upper_fov": str(lidar.upper_fov_deg),
            "lower_fov": str(lidar.lower_fov_deg),
            "range": str(lidar.range_m),
            "rotation_frequency": str(1.0 / settings.step_s),
            "points_per_second": str(int(lidar.channels * 1024 / settings.step_s)),
        }
    camera = settings.camera
    return {"image_size_x": str(camera.width), "image_size_y": str(camera.height), "fov": str(camera.fov_deg)}


def _of_frame(waiting: "queue.Queue[Any]", frame: int, timeout_s: float) -> Any:
    """Wait for the data of a frame. Older data belong to frames before the recording."""
    while True:
        try:
            data = waiting.get(timeout=timeout_s)
        except queue.Empty as error:
            raise DatasetError(
                f"a sensor sent no data for {timeout_s:g} s; check that the server runs", field="host"
            ) from error
        if data.frame == frame:
            return data
        if data.frame > frame:
            raise DatasetError(
                f"a sensor skipped frame {frame}; check that no other client ticks this server",
                field="host",
            )


def _write_ply(path: Path, points: np.ndarray) -> None:
    """Write a binary PLY with the properties of CARLA's own ``save_to_disk``."""
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float32 {name}\n" for name in ("x", "y", "z", "I")) + "end_header\n"
    path.write_bytes(header.encode() + np.ascontiguousarray(points, "<f4").tobytes())
