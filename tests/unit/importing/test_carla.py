"""CARLA's convention against the classes of the client package, recordings on disk, and the recorder with a fake world."""

import csv
import json
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.importing.carla_folder import CarlaCamera, CarlaLidar, CarlaRecording, Mounting, open_carla
from model_training.importing.carla_frame import T_from_carla, depth_from_carla, optical, points_from_carla
from model_training.importing.carla_record import MomentWriter, RecordSettings, attributes, record
from model_training.importing.recording import RecordedPicture, RecordedScan, Unusable
from service.errors import DatasetError

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
degrees = st.floats(-180, 180)
metres = st.floats(-1000, 1000)


@pytest.fixture(scope="module")
def carla():
    return pytest.importorskip("carla", reason="CARLA's client has no wheel for this Python")


@given(metres, metres, metres, degrees, st.floats(-89, 89), degrees)
@settings(max_examples=50)
def test_a_transform_is_that_of_the_client_mirrored(carla, x, y, z, roll, pitch, yaw):
    theirs = carla.Transform(carla.Location(x=x, y=y, z=z), carla.Rotation(roll=roll, pitch=pitch, yaw=yaw))
    ours = T_from_carla(x, y, z, roll, pitch, yaw)
    np.testing.assert_allclose(ours, MIRROR @ np.array(theirs.get_matrix()) @ MIRROR, atol=2e-4)  # theirs are float32


def test_a_point_seen_by_a_sensor_is_where_the_client_says(carla):
    theirs = carla.Transform(carla.Location(x=3, y=-7, z=1), carla.Rotation(roll=4, pitch=-11, yaw=130))
    world = theirs.transform(carla.Location(x=5, y=2, z=-1))
    (point,) = points_from_carla(np.array([[5, 2, -1, 0.5]], np.float32))
    found = T_from_carla(3, -7, 1, 4, -11, 130) @ [*point[:3], 1.0]
    np.testing.assert_allclose(found[:3], [world.x, -world.y, world.z], atol=1e-4)
    assert point[3] == 0.5


def test_a_turn_to_the_right_is_clockwise_and_looking_up_is_up():
    np.testing.assert_allclose(T_from_carla(0, 0, 0, 0, 0, 90)[:3, 0], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(T_from_carla(0, 0, 0, 0, 30, 0)[:3, 0], [np.cos(np.pi / 6), 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(optical(np.eye(4))[:3, 2], [1, 0, 0])


@given(st.floats(0, 989))
@settings(max_examples=50)
def test_depth_out_of_24_bits_is_exact_to_their_step(depth_m):
    steps = round(depth_m / 1000 * (2**24 - 1))
    bgr = np.array([[[steps >> 16, (steps >> 8) & 255, steps & 255]]], np.uint8)
    assert abs(float(depth_from_carla(bgr)[0, 0]) - depth_m) < 1e-4


def test_the_sky_has_no_depth():
    assert not depth_from_carla(np.full((1, 1, 3), 255, np.uint8)).any()


def test_the_field_of_view_reaches_from_edge_to_edge():
    pinhole = CarlaCamera(width=640, height=480, fov_deg=90.0).pinhole()
    assert (pinhole.fx, pinhole.cx, pinhole.cy) == (pytest.approx(320.0), 319.5, 239.5)


SMALL = CarlaRecording(
    town="Town01",
    lidar=CarlaLidar(mounting=Mounting(z=1.8)),
    camera=CarlaCamera(width=8, height=6, fov_deg=90.0, mounting=Mounting(x=0.5, y=0.25, z=1.5)),
)


def lidar_of(frame, points=((1, 2, 3, 0.5), (4, 5, 6, 0.25))):
    return SimpleNamespace(frame=frame, raw_data=np.array(points, np.float32).tobytes())


def image_of(frame, bgr):
    bgra = np.dstack([np.broadcast_to(np.asarray(bgr, np.uint8), (6, 8, 3)), np.full((6, 8), 255, np.uint8)])
    return SimpleNamespace(frame=frame, raw_data=bgra.tobytes(), height=6, width=8)


def transform_of(x=0.0, y=0.0, z=0.0, yaw=0.0):
    return SimpleNamespace(
        location=SimpleNamespace(x=x, y=y, z=z), rotation=SimpleNamespace(roll=0.0, pitch=0.0, yaw=yaw)
    )


@pytest.fixture
def recorded(tmp_path):
    out = tmp_path / "recorded"
    writer = MomentWriter(out, SMALL)
    for k in range(3):
        told = {"lidar": lidar_of(k), "rgb": image_of(k, [1, 2, 3]), "depth": image_of(k, [0, 83, 0])}
        writer.write(100 + k, 0.1 * k, transform_of(x=10.0 * k, y=2.0, yaw=90.0), **told)
    return out


def test_a_recording_is_read_in_our_convention(recorded):
    folder = open_carla(recorded)
    scans = [event for event in folder.events() if isinstance(event, RecordedScan)]
    pictures = [event for event in folder.events() if isinstance(event, RecordedPicture)]
    assert (len(scans), len(pictures), folder.count()) == (3, 3, 6)
    np.testing.assert_array_equal(scans[0].points, [[1, -2, 3, 0.5], [4, -5, 6, 0.25]])
    np.testing.assert_array_equal(pictures[0].rgb[0, 0], [3, 2, 1])
    assert pictures[0].depth is not None
    np.testing.assert_allclose(pictures[0].depth, 1000 * 83 * 256 / (2**24 - 1), rtol=1e-6)
    np.testing.assert_allclose(pictures[0].T_vehicle_camera[:3, 3], [0.5, -0.25, 1.5])
    trajectory = folder.trajectory()
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.T_map_vehicle[2], T_from_carla(20, 2, 0, 0, 0, 90), atol=1e-12)
    assert folder.lidar.T_vehicle_sensor is not None
    assert folder.lidar.T_vehicle_sensor[2][3] == 1.8
    assert "3 frames of Town01" in folder.notes.lines


def test_ascii_ply_as_carla_saves_it_is_read_too(recorded):
    header = (
        "ply\nformat ascii 1.0\nelement vertex 1\n"
        + "".join(f"property float32 {n}\n" for n in "xyzI")
        + "end_header\n"
    )
    (recorded / "lidar" / "00000100.ply").write_text(header + "7 8 9 0.5\n")
    scan = next(event for event in open_carla(recorded).events() if isinstance(event, RecordedScan))
    np.testing.assert_array_equal(scan.points, [[7, -8, 9, 0.5]])


def test_frames_whose_files_are_missing_or_cut_off_are_counted(recorded):
    (recorded / "lidar" / "00000100.ply").unlink()
    scan, depth = recorded / "lidar" / "00000101.ply", recorded / "depth" / "00000101.png"
    scan.write_bytes(scan.read_bytes()[:-3])
    depth.write_bytes(depth.read_bytes()[:-30])
    (recorded / "rgb" / "00000102.png").unlink()
    bad = [event for event in open_carla(recorded).events() if isinstance(event, Unusable)]
    assert [(b.kind, b.name) for b in bad] == [
        ("scan", "00000100.ply"),
        ("scan", "00000101.ply"),
        ("image", "00000101.png"),
        ("image", "00000102.png"),
    ]


@pytest.mark.parametrize(
    ("file", "text", "why"),
    [
        ("recording.json", None, "recording.json cannot be read .*the mounting of the sensors"),
        (
            "recording.json",
            '{"lidar": {"channels": "many"}}',
            r"recording.json: lidar\.channels: .*; correct this field",
        ),
        ("poses.csv", None, "poses.csv is missing; it has one line per frame: frame, timestamp"),
        (
            "poses.csv",
            "frame,timestamp,x,y,z,roll,pitch,yaw\n1,0,0,0,0,0,0,0\n../2,1,0,0,0,0,0,0\n",
            "poses.csv, line 3: the frame '../2' is not an integer, .*; correct or remove this line",
        ),
        (
            "poses.csv",
            "frame,timestamp,x,y,z,roll,pitch,yaw\n1,zero,0,0,0,0,0,0\n",
            "line 2: not numbers in the columns .*; the first line",
        ),
        ("poses.csv", "frame,timestamp\n1,0\n", "poses.csv, line 2"),
        ("poses.csv", "frame,timestamp,x,y,z,roll,pitch,yaw\n", "no pose"),
        ("poses.csv", "frame,timestamp,x,y,z,roll,pitch,yaw\n1,1,0,0,0,0,0,0\n2,1,0,0,0,0,0,0\n", "pose 2: its time"),
    ],
)
def test_missing_parts_of_a_recording_are_named(recorded, file, text, why):
    (recorded / file).unlink() if text is None else (recorded / file).write_text(text)
    with pytest.raises(DatasetError, match=why):
        open_carla(recorded)


def test_a_folder_that_is_taken_is_not_recorded_into(recorded):
    with pytest.raises(DatasetError, match="not empty"):
        MomentWriter(recorded, SMALL)


class FakeActor:
    def __init__(self, world, kind):
        self.world, self.kind, self.log = world, kind, world.log
        self.listener = None

    def listen(self, listener):
        self.listener = listener
        self.send(self.world.frame)  # of a frame before the recording

    def send(self, frame):
        if self.listener is None or frame in self.world.silent:
            return
        if self.kind == "sensor.lidar.ray_cast":
            self.listener(lidar_of(frame, [(frame, 0, 0, 0)]))
        else:
            self.listener(image_of(frame, [frame, 0, 0]))

    def stop(self):
        self.log.append(f"stop {self.kind}")

    def destroy(self):
        self.log.append(f"destroy {self.kind}")

    def set_autopilot(self, on):
        self.log.append(f"autopilot {on}")

    def get_transform(self):
        return transform_of(x=float(self.world.frame))


class FakeBlueprint:
    def __init__(self, name):
        self.name, self.attributes = name, {}

    def set_attribute(self, key, value):
        self.attributes[key] = value


class FakeWorld:
    """A world that ticks, spawns, and records the calls."""

    def __init__(self, *, places=2, fails_at=None, failure=None, silent=(), skips=0):
        self.frame, self.log, self.actors, self.silent, self.skips = 40, [], [], silent, skips
        self.fails_at, self.failure, self.places = fails_at, failure, places
        self.settings = SimpleNamespace(synchronous_mode=False, fixed_delta_seconds=None)

    def get_settings(self):
        return SimpleNamespace(**vars(self.settings))

    def apply_settings(self, settings):
        self.settings = settings
        self.log.append(f"synchronous {settings.synchronous_mode}")

    def get_map(self):
        return SimpleNamespace(name="Carla/Maps/Town03", get_spawn_points=lambda: list(range(self.places)))

    def get_blueprint_library(self):
        return SimpleNamespace(filter=lambda _: [FakeBlueprint("vehicle")], find=FakeBlueprint)

    def try_spawn_actor(self, blueprint, place):
        return None if place == 0 else self.spawn_actor(blueprint, place)

    def spawn_actor(self, blueprint, _place, **_mounting):
        self.actors.append(FakeActor(self, blueprint.name))
        return self.actors[-1]

    def tick(self):
        self.frame += 1
        if self.frame - 40 == self.fails_at:
            raise self.failure
        for actor in self.actors:
            actor.send(self.frame + self.skips)
        return self.frame

    def get_snapshot(self):
        return SimpleNamespace(timestamp=SimpleNamespace(elapsed_seconds=0.1 * self.frame))

    def set_weather(self, _weather):
        self.log.append("weather")


@pytest.fixture
def serve(carla, monkeypatch):
    """Give the recorder a client of a fake world. ``loads`` is called on connection."""

    def made(world, *, connects=lambda: None):
        def get_world():
            connects()
            return world

        traffic = SimpleNamespace(
            set_synchronous_mode=lambda on: world.log.append(f"traffic {on}"),
            set_random_device_seed=lambda seed: world.log.append(f"seed {seed}"),
        )
        client = SimpleNamespace(
            set_timeout=lambda _: None,
            get_world=get_world,
            load_world=lambda _: get_world(),
            get_trafficmanager=lambda: traffic,
        )
        monkeypatch.setattr(carla, "Client", lambda *_: client)
        return world

    return made


QUICK: dict[str, Any] = {"timeout_s": 0.01, "lidar": SMALL.lidar, "camera": SMALL.camera}


def run(out, **changed):
    told = []
    done = record(
        "host", 2000, out, RecordSettings(**(QUICK | {"frames": 3} | changed)), report=lambda *each: told.append(each)
    )
    return done, told


def assert_put_back(world):
    assert world.settings.synchronous_mode is False
    assert world.log[-2:] == ["traffic False", "synchronous False"]
    sensors = ("sensor.lidar.ray_cast", "sensor.camera.rgb", "sensor.camera.depth")
    assert {entry for entry in world.log if entry.startswith(("stop", "destroy"))} == {
        "destroy vehicle",
        *(f"{what} {kind}" for what in ("stop", "destroy") for kind in sensors),
    }
    for kind in sensors:
        assert world.log.index(f"stop {kind}") < world.log.index(f"destroy {kind}")


def test_a_drive_is_recorded_frame_by_frame_and_older_data_are_skipped(serve, tmp_path):
    world = serve(FakeWorld())
    done, told = run(tmp_path / "out", seed=7)
    assert (done, told) == (3, [(1, 3), (2, 3), (3, 3)])
    rows = list(csv.DictReader((tmp_path / "out" / "poses.csv").read_text().splitlines()))
    assert [row["frame"] for row in rows] == ["00000041", "00000042", "00000043"]
    assert [float(row["x"]) for row in rows] == [41.0, 42.0, 43.0]
    scans = [event for event in open_carla(tmp_path / "out").events() if isinstance(event, RecordedScan)]
    assert [scan.points[0, 0] for scan in scans] == [41.0, 42.0, 43.0]
    picture = cv2.imread(str(tmp_path / "out" / "rgb" / "00000042.png"))
    assert picture is not None
    assert picture[0, 0, 0] == 42  # blue
    assert json.loads((tmp_path / "out" / "recording.json").read_text())["town"] == "Town03"
    assert world.log[:3] == ["traffic True", "seed 7", "synchronous True"]
    assert_put_back(world)


def test_ctrl_c_keeps_what_was_recorded_and_puts_all_back(serve, tmp_path):
    world = serve(FakeWorld(fails_at=3, failure=KeyboardInterrupt()))
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "out", frames=9)
    assert_put_back(world)
    assert len(open_carla(tmp_path / "out").frames) == 2


def test_a_server_that_stops_is_reported_with_the_kept_part(serve, tmp_path):
    world = serve(FakeWorld(fails_at=3, failure=RuntimeError("time-out of 20000ms")))
    with pytest.raises(DatasetError, match=r"host:2000 failed .*time-out.*; 2 frames are in"):
        run(tmp_path / "out", frames=9)
    assert_put_back(world)


def test_a_silent_sensor_is_reported(serve, tmp_path):
    world = serve(FakeWorld(silent=(42,)))
    with pytest.raises(DatasetError, match=r"a sensor sent no data for 0\.01 s"):
        run(tmp_path / "out")
    assert_put_back(world)


def test_a_skipped_frame_is_not_taken_for_the_one_before(serve, tmp_path):
    world = serve(FakeWorld(skips=1))
    with pytest.raises(DatasetError, match="a sensor skipped frame 41"):
        run(tmp_path / "out")
    assert_put_back(world)


def test_a_missing_server_is_reported_with_the_remedy_and_nothing_is_written(serve, tmp_path):
    def refuse():
        raise RuntimeError("time-out")

    serve(FakeWorld(), connects=refuse)
    with pytest.raises(DatasetError, match=r"CARLA at host:2000 .*time-out.*start it, or choose another --host"):
        run(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_full_map_and_an_unknown_weather_are_refused(serve, tmp_path):
    world = serve(FakeWorld(places=1))
    with pytest.raises(DatasetError, match="no free place for a vehicle"):
        run(tmp_path / "out")
    assert world.settings.synchronous_mode is False
    with pytest.raises(DatasetError, match="weather: CARLA has no preset 'Frogs'"):
        run(tmp_path / "out", weather="Frogs")
    assert not (tmp_path / "out").exists()


def test_a_lidar_turns_once_a_frame():
    told = attributes("lidar", RecordSettings(step_s=0.05))
    assert (told["rotation_frequency"], told["range"]) == ("20.0", "100.0")
    assert attributes("rgb", RecordSettings()) == attributes("depth", RecordSettings())
