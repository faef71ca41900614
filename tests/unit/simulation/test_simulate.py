import hashlib
import itertools
import json
import shutil
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from model_training.datasets.dataset import Dataset
from model_training.simulation import simulate as module
from model_training.simulation.drives import quota_of
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import DepthParameters, LidarParameters
from model_training.simulation.simulate import simulate
from model_training.simulation.streets import TABLE_I, class_name, paper_streets, streets_geojson
from service.errors import DatasetError
from service.geometry.rigid import transform_points


def hashes_of(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def pose_of(frame):
    assert frame.T_map_camera is not None
    return frame.T_map_camera


def interrupt(folder, *patterns):
    """Leave the state of an interrupted run: no description, the lock of the folder, and only some frames."""
    (folder / "dataset.json").unlink()
    (folder / "simulation.done.json").rename(folder / "simulation.json")
    for pattern in patterns:
        for path in sorted(folder.glob(pattern))[1::2]:
            path.unlink()
    return folder


def test_the_same_seed_gives_the_same_bytes_for_two_workers(plan_of, tiny_dataset, tmp_path):
    simulate(plan_of(), tmp_path / "again", workers=2)
    assert hashes_of(tmp_path / "again") == hashes_of(tiny_dataset)


@pytest.mark.parametrize(
    "lost",
    [
        (),
        ("survey/scans/*.bin", "survey/poses.txt"),
        ("queries/*/poses.txt", "queries/*/depth/*.png"),
        ("queries/drive1_stereo/*/*", "queries/*/poses.txt", "streets.geojson"),
    ],
)
def test_an_interrupted_run_goes_on_to_the_same_bytes(plan_of, tiny_dataset, tmp_path, lost):
    folder = interrupt(shutil.copytree(tiny_dataset, tmp_path / "cut"), *lost)
    for name in ("drive1_precise", "drive1_stereo"):  # poses come last: where frames are missing, so are they
        if any("queries" in pattern for pattern in lost):
            (folder / "queries" / name / "poses.txt").unlink(missing_ok=True)
    simulate(plan_of(), folder, workers=1)
    assert hashes_of(folder) == hashes_of(tiny_dataset)


def test_a_finished_run_is_left_as_it_is(plan_of, tiny_dataset, tmp_path):
    folder = shutil.copytree(tiny_dataset, tmp_path / "done")
    stamps = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    simulate(plan_of(), folder, workers=1)
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == stamps


@pytest.mark.parametrize("finished", [True, False])
def test_a_folder_of_another_plan_is_refused(plan_of, tiny_dataset, tmp_path, finished):
    folder = shutil.copytree(tiny_dataset, tmp_path / "other")
    if not finished:
        interrupt(folder)
    before = hashes_of(folder)
    with pytest.raises(DatasetError, match="another plan"):
        simulate(plan_of(seed=4), folder)
    assert hashes_of(folder) == before


def test_a_folder_with_something_else_is_refused(plan_of, tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(DatasetError, match="not empty"):
        simulate(plan_of(), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_progress_is_reported_to_the_end(plan_of, tmp_path):
    told = []
    simulate(plan_of(), tmp_path / "new", workers=1, report=lambda *event: told.append(event))
    last = {stage: (done, of) for stage, done, of in told}
    assert set(last) == {"survey", "queries drive1"}
    assert all(done == of for done, of in last.values())


def test_the_dataset_reads_back_as_one(tiny_dataset):
    dataset = Dataset(tiny_dataset)
    poses = dataset.survey_poses()
    scans = [dataset.scan(k) for k in range(len(poses))]
    assert len(scans) == len(list((tiny_dataset / "survey" / "scans").iterdir()))
    assert all(len(points) > 5000 for points in scans)
    assert dataset.query_sets(with_truth=True) == ["drive1_precise", "drive1_stereo"]
    frames = list(dataset.queries("drive1_stereo"))
    assert [frame.number for frame in frames] == list(range(6))
    assert {frame.rgb().shape for frame in frames} == {(72, 96, 3)}
    assert {frame.depth_m().shape for frame in frames} == {(72, 96)}


def test_the_description_states_the_accuracy_of_the_survey(plan_of, tiny_dataset):
    survey = plan_of().survey_parameters.model()
    stated = Dataset(tiny_dataset).description.survey_accuracy
    assert stated is not None
    expected = (survey.position_m, survey.angle_deg) if plan_of().survey_error else (0.0, 0.0)
    assert (stated.position_std_m, stated.angle_std_deg) == expected


def test_the_description_says_what_was_simulated(plan_of, tiny_dataset):
    description = Dataset(tiny_dataset).description
    assert description.source == {"kind": "simulation", "plan": plan_of().model_dump(mode="json")}
    assert (description.seed, description.sensors.cameras[0].width, description.sensors.lidars[0].channels) == (
        3,
        96,
        32,
    )


def test_depth_presets_share_pictures_and_poses(tiny_dataset):
    precise, stereo = (hashes_of(tiny_dataset / "queries" / f"drive1_{name}") for name in ("precise", "stereo"))
    same = {name for name in precise if precise[name] == stereo[name]}
    assert same == {name for name in precise if not name.startswith("depth")}


@pytest.mark.parametrize("file", ["survey/poses.txt", "queries/drive1_precise/poses.txt"])
def test_poses_are_tum_lines(tiny_dataset, file):
    lines = [[float(x) for x in line.split(" ")] for line in (tiny_dataset / file).read_text().splitlines()]
    transforms = list(Dataset(tiny_dataset).survey_poses())
    if file.startswith("queries"):
        transforms = [pose_of(frame) for frame in Dataset(tiny_dataset).queries("drive1_precise")]
    assert {len(line) for line in lines} == {8}
    assert all(later[0] > earlier[0] for earlier, later in itertools.pairwise(lines))
    np.testing.assert_allclose([line[1:4] for line in lines], np.array(transforms)[:, :3, 3], atol=1e-8)
    R = Rotation.from_quat([line[4:] for line in lines]).as_matrix()  # x, y, z, w, as TUM has it
    np.testing.assert_allclose(R, np.array(transforms)[:, :3, :3], atol=1e-8)


def test_pictures_show_what_the_scans_measured(plan_of, tmp_path):
    query = QueryPlan(name="a", traversal=0, count=4, depths=("ideal",))
    simulate(plan_of(spacing_m=4.0, survey_error=False, queries=(query,)), tmp_path / "exact", workers=1)
    dataset = Dataset(tmp_path / "exact")
    clouds = [transform_points(T, dataset.scan(k)[:, :3].astype(float)) for k, T in enumerate(dataset.survey_poses())]
    tree = cKDTree(np.concatenate(clouds))
    for frame in dataset.queries("a_ideal"):
        depth_m = frame.depth_m()
        near = (depth_m > 0) & (depth_m < 12)
        points = (frame.camera.pinhole().rays_of_pixels() * depth_m[..., None])[near]
        distance, _ = tree.query(transform_points(pose_of(frame), points))
        assert np.median(distance) < 0.15


def test_a_written_survey_is_off_by_its_error(plan_of, tmp_path, tiny_dataset):
    simulate(plan_of(survey_error=False, queries=()), tmp_path / "exact", workers=1)
    exact, written = Dataset(tmp_path / "exact").survey_poses(), Dataset(tiny_dataset).survey_poses()
    off = np.linalg.norm((exact - written)[:, :3, 3], axis=1)
    assert 0.01 < off.mean() < 0.15


@pytest.mark.parametrize("max_depth_m", [6.0])
def test_depth_is_cut_where_the_plan_says(plan_of, tmp_path, max_depth_m):
    query = QueryPlan(name="a", traversal=1, count=2, max_depth_m=max_depth_m)
    simulate(plan_of(spacing_m=30.0, queries=(query,)), tmp_path / "cut", workers=1)
    depths = [frame.depth_m() for frame in Dataset(tmp_path / "cut").queries("a_precise")]
    assert 4.0 < max(float(depth.max()) for depth in depths) <= max_depth_m


def test_sensors_have_the_numbers_that_the_plan_puts_in_place_of_their_presets(plan_of, tmp_path):
    query = QueryPlan(
        name="a", traversal=1, count=2, depths=("ideal",), depth_parameters=DepthParameters(max_range_m=7)
    )
    plan = plan_of(spacing_m=30.0, queries=(query,), lidar_parameters=LidarParameters(channels=16, max_range_m=20))
    simulate(plan, tmp_path / "set", workers=1)
    dataset = Dataset(tmp_path / "set")
    lidar = dataset.description.sensors.lidars[0]
    assert (lidar.channels, lidar.top_deg, lidar.max_range_m) == (16, 15.0, 20.0)
    points = np.concatenate([dataset.scan(k)[:, :3] for k in range(len(dataset.survey_poses()))])
    ranges = np.linalg.norm(points, axis=1)
    elevations = np.rad2deg(np.arcsin(points[:, 2] / ranges))
    assert 15 < ranges.max() <= 20
    assert set(np.rint((elevations + 15) / 2).tolist()) <= set(range(16))  # beams 2 degrees apart
    np.testing.assert_allclose(elevations, np.rint((elevations + 15) / 2) * 2 - 15, atol=1e-3)
    assert 5 < max(float(frame.depth_m().max()) for frame in dataset.queries("a_ideal")) <= 7


def test_a_plan_that_sets_no_number_has_the_text_it_always_had():
    text = (
        '{"name":"x","city":"city","seed":0,"size_m":[300.0,400.0],"streets":[],"lidar":"paper_32","lidar_height_m":1.8,'
        '"spacing_m":1.0,"survey_condition":"clear","survey_error":true,'
        '"camera":{"width":640,"height":480,"horizontal_deg":90.0},"camera_height_m":1.5,'
        '"queries":[{"name":"a","traversal":1,"count":200,"per_class":false,"on_track":false,"depths":["precise"],'
        '"condition":"clear","parked_changed":0.5,"aside_m":2.0,"heading_deg":15.0,"turn_deg":0.0,"pitch_deg":0.0,'
        '"blocked":0.0,"max_depth_m":null}]}'
    )
    plan = SimulationPlan(name="x", queries=(QueryPlan(name="a", traversal=1),))
    assert plan.model_dump_json() == text
    assert SimulationPlan.model_validate_json(text) == plan


def test_a_plan_with_other_numbers_is_another_plan(plan_of, tiny_dataset, tmp_path):
    folder = shutil.copytree(tiny_dataset, tmp_path / "other")
    with pytest.raises(DatasetError, match="another plan"):
        simulate(plan_of(lidar_parameters=LidarParameters(dropout=0.5)), folder)
    plan = plan_of(lidar_parameters=LidarParameters(dropout=0.5))
    assert SimulationPlan.model_validate_json(plan.model_dump_json()) == plan


def test_more_queries_than_room_are_refused_with_both_counts(plan_of, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_is_free", lambda _: False)
    with pytest.raises(DatasetError, match="only 0 of 6 queries"):
        simulate(plan_of(spacing_m=30.0), tmp_path / "full", workers=1)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"lidar": "hdl_65"}, "lidar: 'hdl_65'"),
        ({"survey_condition": "hail"}, "survey_condition: 'hail'"),
        ({"streets": ("77",)}, "unknown street '77'"),
        ({"queries": (QueryPlan(name="a", traversal=1, depths=("laser",)),)}, "depth: 'laser'"),
        ({"queries": (QueryPlan(name="a", traversal=1, condition="hail"),)}, "condition: 'hail'"),
        ({"queries": (QueryPlan(name="a", traversal=1), QueryPlan(name="a", traversal=2))}, "have the same name"),
        ({"queries": (QueryPlan(name="a", traversal=1, per_class=True),)}, "--city paper"),
        (
            {"queries": (QueryPlan(name="a", traversal=1, on_track=True, aside_m=1.0),)},
            "aside_m: 1 has no effect with 'a'",
        ),
        (
            {"queries": (QueryPlan(name="a", traversal=1, on_track=True, heading_deg=0),)},
            "heading_deg: 0 has no effect",
        ),
        (
            {"queries": (QueryPlan(name="a", traversal=0, parked_changed=1.0),)},
            "parked_changed: 1 has no effect with 'a'",
        ),
        (
            {"queries": (QueryPlan(name="a", traversal=1, step_m=3.0),)},
            "step_m: 3 has no effect with 'a', which has no sequence",
        ),
    ],
)
def test_a_plan_that_names_what_is_not_there_is_refused(plan_of, tmp_path, changed, message):
    with pytest.raises(DatasetError, match=message):
        simulate(plan_of(**changed), tmp_path / "no")


def test_table_i_holds_class_by_class(monkeypatch):
    """626 queries from candidates spread over the paper's streets. Every third candidate is blocked."""
    streets = paper_streets(np.random.default_rng(0))
    city: Any = type("Streets", (), {"streets_geojson": lambda _: streets_geojson(streets)})()
    rng = np.random.default_rng(1)
    candidates = np.tile(np.eye(4), (9000, 1, 1))
    candidates[:, 0, 3], candidates[:, 1, 3] = rng.uniform(-130, 130, 9000), rng.uniform(-180, 180, 9000)
    quota = quota_of(city, QueryPlan(name="a", traversal=1, per_class=True), candidates)
    monkeypatch.setattr(module, "_is_free", lambda k: k % 3 > 0)
    job: Any = None
    chosen = module._free_candidates(job, quota)
    counts = np.bincount(quota.class_of[chosen], minlength=16)
    assert counts.tolist() == [count for _, _, count in TABLE_I]
    assert len(set(chosen.tolist())) == 626
    assert (chosen % 3 > 0).all()


def test_room_is_looked_for_without_starting_processes(plan_of, tmp_path, monkeypatch):
    asked = []
    run = module._run

    def noted(job, work, items, workers):
        asked.append((work, workers))
        return run(job, work, items, 1)

    monkeypatch.setattr(module, "_run", noted)
    simulate(plan_of(spacing_m=30.0), tmp_path / "out", workers=3)
    assert {workers for work, workers in asked if work is module._is_free} == {1}
    assert {workers for work, workers in asked if work is not module._is_free} == {3}


def test_the_streets_of_the_dataset_are_those_of_its_city(tiny_dataset):
    features = json.loads((tiny_dataset / "streets.geojson").read_text())["features"]
    names = [class_name(f["properties"]["street"], f["properties"]["section"]) for f in features]
    assert [f["properties"]["name"] for f in features] == names


def test_a_plan_with_a_sequence_says_so_and_is_read_again():
    plan = SimulationPlan(name="x", queries=(QueryPlan(name="a", traversal=1, sequence=5),))
    assert '"sequence":5' in plan.model_dump_json()
    assert "step_m" not in plan.model_dump_json()
    assert SimulationPlan.model_validate_json(plan.model_dump_json()) == plan.checked()


@pytest.mark.parametrize(
    ("field", "value"), [("sequence", 1), ("sequence", 21), ("step_m", 0.0), ("step_m", 11.0), ("step_m", np.nan)]
)
def test_a_sequence_out_of_bounds_is_refused(field, value):
    with pytest.raises(ValidationError, match=field):
        QueryPlan(**({"name": "a", "traversal": 1, "sequence": 3} | {field: value}))


def test_sequences_are_written_frame_by_frame_and_as_many_as_asked_for(plan_of, tmp_path):
    """Two sequences of three frames are six frames with poses. The last frame of each is at the pose of a single image."""
    alone, sequence = (
        QueryPlan(name="a", traversal=1, count=2),
        QueryPlan(name="a", traversal=1, count=2, sequence=3, step_m=0.5),
    )
    told = []
    simulate(plan_of(spacing_m=30.0, queries=(alone,)), tmp_path / "alone", workers=1)
    simulate(
        plan_of(spacing_m=30.0, queries=(sequence,)),
        tmp_path / "seq",
        workers=1,
        report=lambda *event: told.append(event),
    )
    frames, last = (list(Dataset(tmp_path / name).queries("a_precise")) for name in ("seq", "alone"))
    assert [frame.number for frame in frames] == list(range(6))
    assert told[-1] == ("queries a", 6, 6)
    truth = np.array([frame.T_map_camera for frame in frames])
    steps = np.linalg.norm(np.diff(truth[:, :2, 3], axis=0), axis=1)
    np.testing.assert_allclose(steps[[0, 1, 3, 4]], 0.5, atol=1e-6)
    for frame, single in zip(frames[2::3], last, strict=True):
        np.testing.assert_allclose(pose_of(frame), pose_of(single), atol=1e-9)
    pictures = [frame.depth_m() for frame in frames]
    assert all(np.abs(one - other).max() > 0.1 for one, other in itertools.pairwise(pictures))
