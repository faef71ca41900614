import json

import numpy as np
import pytest

from model_training.datasets.dataset import (
    CameraSensor,
    Dataset,
    DatasetDescription,
    Sensors,
    SurveyAccuracy,
    read_tum,
    require_map_first,
    scan_path,
    write_description,
    write_tum,
)
from model_training.datasets.whole_folder import whole_or_not_at_all
from service.contract.convert import parsed, query_from
from service.contract.schema import LocalizeRequest
from service.errors import DatasetError
from service.geometry.rigid import rotation_z, transform_from
from service.imaging.level import GivenHeight
from service.imaging.view_grid import ViewGrid

POSE = "0.000000 1 2 3 0 0 0 1"


def make_dataset(folder):
    """Make two scans and one query set of two pairs with ground truth. The images are never decoded."""
    camera = CameraSensor(name="front", width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
    description = DatasetDescription(name="small", source={"kind": "test"}, sensors=Sensors(cameras=[camera]))
    scan_path(folder, 0).parent.mkdir(parents=True)
    for number in range(2):
        np.arange(20, dtype=np.float32).tofile(scan_path(folder, number))
    poses = np.stack([transform_from(rotation_z(0.3 * k), np.array([k, 2.0, 3.0])) for k in range(2)])
    write_tum(folder / "survey" / "poses.txt", np.arange(2.0), poses)
    queries = folder / "queries" / "drive"
    for kind, end in (("rgb", "jpg"), ("depth", "png")):
        (queries / kind).mkdir(parents=True)
        for number in range(2):
            (queries / kind / f"{number:06d}.{end}").write_bytes(b"not looked at")
    write_tum(queries / "poses.txt", np.arange(2.0), poses)
    write_description(folder, description)
    return folder


@pytest.fixture
def folder(tmp_path):
    return make_dataset(tmp_path / "small")


def read_all(folder):
    """Read everything of a dataset that needs no decoding of images."""
    dataset = Dataset(folder)
    for number in range(len(dataset.survey_poses())):
        dataset.scan(number)
    dataset.streets()
    for name in dataset.query_sets():
        list(dataset.queries(name))


def replace_line(path, number, text):
    lines = path.read_text().splitlines()
    lines[number] = text
    path.write_text("\n".join(lines) + "\n")


def change_json(path, change):
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


DEFECTS = {
    "description missing": ("dataset.json", lambda p: p.unlink(), "dataset.json is missing"),
    "description is no JSON": ("dataset.json", lambda p: p.write_text("{"), "dataset.json"),
    "description lacks the name": (
        "dataset.json",
        lambda p: change_json(p, lambda d: d.pop("name")),
        "dataset.json: name",
    ),
    "description knows more": (
        "dataset.json",
        lambda p: change_json(p, lambda d: d.update(extra=1)),
        "dataset.json: extra",
    ),
    "format of another time": (
        "dataset.json",
        lambda p: change_json(p, lambda d: d.update(format=9)),
        "format 9 is not 1",
    ),
    "camera underground": (
        "dataset.json",
        lambda p: change_json(p, lambda d: d["sensors"]["cameras"][0].update(height_m=0.0)),
        "height_m",
    ),
    "deviation alone": (
        "dataset.json",
        lambda p: change_json(p, lambda d: d["sensors"]["cameras"][0].update(height_std_m=0.1)),
        "has height_std_m, but no height_m",
    ),
    "no camera": (
        "dataset.json",
        lambda p: change_json(p, lambda d: d["sensors"].update(cameras=[])),
        "has no camera; add",
    ),
    "scan truncated": ("survey/scans/000001.bin", lambda p: p.write_bytes(p.read_bytes()[:-3]), "000001.bin: 77 bytes"),
    "scan empty": ("survey/scans/000000.bin", lambda p: p.write_bytes(b""), "000000.bin: 0 bytes"),
    "scan missing": ("survey/scans/000001.bin", lambda p: p.unlink(), "000001.bin is missing"),
    "poses missing": (
        "survey/poses.txt",
        lambda p: p.unlink(),
        "survey/poses.txt is missing; write one pose per line: `timestamp x y z",
    ),
    "pose with NaN": ("survey/poses.txt", lambda p: replace_line(p, 1, "1 nan 2 3 0 0 0 1"), "poses.txt, line 2"),
    "pose with a word": (
        "survey/poses.txt",
        lambda p: replace_line(p, 0, "0 1 2 x 0 0 0 1"),
        "line 1: not numbers: .*; write `timestamp",
    ),
    "pose too short": (
        "survey/poses.txt",
        lambda p: replace_line(p, 1, "1 1 2 3 0 0 1"),
        "line 2: not a pose: .*; write `timestamp",
    ),
    "pose without rotation": ("survey/poses.txt", lambda p: replace_line(p, 1, "1 1 2 3 0 0 0 0"), "poses.txt, line 2"),
    "truth too short": (
        "queries/drive/poses.txt",
        lambda p: p.write_text(POSE + "\n"),
        "has 1 poses, none for 000001.jpg; add one line per image",
    ),
    "truth with infinity": (
        "queries/drive/poses.txt",
        lambda p: replace_line(p, 0, "0 inf 2 3 0 0 0 1"),
        "poses.txt, line 1",
    ),
    "depth missing": (
        "queries/drive/depth/000001.png",
        lambda p: p.unlink(),
        "depth has no image 000001; add it, or remove 000001.jpg",
    ),
    "streets are no JSON": ("streets.geojson", lambda p: p.write_text("{"), "streets.geojson: not valid JSON"),
    "cameras too few": (
        "queries/drive/cameras.txt",
        lambda p: p.write_text("front\n"),
        "cameras.txt has 1 names for 2 images; write one camera name per image",
    ),
    "camera unknown": (
        "queries/drive/cameras.txt",
        lambda p: p.write_text("front\nback\n"),
        "cameras.txt names 'back', but dataset.json has front; use one of these names",
    ),
}


@pytest.mark.parametrize(("file", "damage", "message"), DEFECTS.values(), ids=DEFECTS)
def test_a_defect_is_named_with_its_file(folder, file, damage, message):
    damage(folder / file)
    with pytest.raises(DatasetError, match=message):
        read_all(folder)


def test_a_whole_dataset_reads_without_complaint(folder):
    read_all(folder)


HEIGHTS = [
    ({}, None),
    ({"height_m": 0.3}, GivenHeight(0.3, 0.05)),
    ({"height_m": 0.3, "height_std_m": 0.02}, GivenHeight(0.3, 0.02)),
]


@pytest.mark.parametrize(("given", "expected"), HEIGHTS)
def test_a_camera_height_is_written_if_known_and_reaches_query_and_request(folder, parts_of, given, expected):
    change_json(folder / "dataset.json", lambda d: d["sensors"]["cameras"][0].update(given))
    description = Dataset(folder).description
    write_description(folder, description)
    written = json.loads((folder / "dataset.json").read_text())["sensors"]["cameras"][0]
    assert {name: value for name, value in written.items() if name.startswith("height_")} == given
    parts = parts_of()
    for kind, name in (("rgb", "rgb/000000.jpg"), ("depth", "depth/000000.npy")):
        (folder / "queries" / "drive" / name).write_bytes(parts[kind])
    (folder / "queries" / "drive" / "depth" / "000000.png").unlink()
    frame = next(Dataset(folder).queries("drive"))
    asked = query_from(parsed(json.dumps(frame.request()).encode(), LocalizeRequest), rgb=b"", depth=b"")
    assert frame.query(ViewGrid()).camera_height == asked.camera_height == expected


def test_points_that_are_not_finite_are_left_out(folder):
    points = np.arange(20, dtype=np.float32).reshape(5, 4)
    points[1, 2], points[3, 0] = np.nan, np.inf
    points.tofile(scan_path(folder, 0))
    np.testing.assert_array_equal(Dataset(folder).scan(0), points[[0, 2, 4]])


def test_a_point_stays_without_an_intensity_that_means_something(folder):
    points = np.ones((4, 4), np.float32)
    points[:, 3] = 0.5, np.nan, -1.0, np.inf
    points.tofile(scan_path(folder, 0))
    np.testing.assert_array_equal(Dataset(folder).scan(0)[:, 3], [0.5, 0, 0, 0])


def test_a_query_set_that_is_not_there_is_refused_with_those_that_are(folder):
    with pytest.raises(DatasetError, match="no query set 'other'; it has: drive"):
        list(Dataset(folder).queries("other"))


def test_sets_without_truth_have_frames_without_pose(folder):
    (folder / "queries" / "drive" / "poses.txt").unlink()
    dataset = Dataset(folder)
    assert dataset.query_sets(with_truth=True) == []
    assert [(frame.T_map_camera, frame.stamp_s) for frame in dataset.queries("drive")] == [(None, None)] * 2


def test_a_set_may_have_odometry(folder):
    assert Dataset(folder).odometry("drive") is None
    poses = np.stack([transform_from(rotation_z(0.1), np.array([k, 0.0, 0.0])) for k in range(2)])
    write_tum(folder / "queries" / "drive" / "odometry.txt", np.arange(2.0), poses)
    found = Dataset(folder).odometry("drive")
    assert found is not None
    np.testing.assert_allclose(found, poses, atol=1e-6)


def test_damaged_odometry_is_named_with_its_line(folder):
    (folder / "queries" / "drive" / "odometry.txt").write_text(f"{POSE}\n0 1 2\n")
    with pytest.raises(DatasetError, match=r"odometry\.txt, line 2"):
        Dataset(folder).odometry("drive")


def test_frames_carry_the_timestamps_of_their_poses(folder):
    path = folder / "queries" / "drive" / "poses.txt"
    poses = read_tum(path)[1]
    write_tum(path, np.array([1403636579.763555, 1403636580.25]), poses)
    assert [frame.stamp_s for frame in Dataset(folder).queries("drive")] == [1403636579.763555, 1403636580.25]


def test_poses_survive_a_file(tmp_path):
    rng = np.random.default_rng(0)
    poses = np.stack([transform_from(rotation_z(a), rng.uniform(-9e3, 9e3, 3)) for a in np.linspace(-3, 3, 20)])
    write_tum(tmp_path / "poses.txt", np.arange(20, dtype=np.float64) * 0.1, poses)
    stamps, found = read_tum(tmp_path / "poses.txt")
    np.testing.assert_allclose(stamps, np.arange(20) * 0.1)
    np.testing.assert_allclose(found, poses, atol=1e-8)


def test_comments_and_blank_lines_of_tum_files_are_skipped(tmp_path):
    (tmp_path / "poses.txt").write_text(f"# timestamp x y z qx qy qz qw\n\n{POSE}\n")
    np.testing.assert_allclose(read_tum(tmp_path / "poses.txt")[1][0, :3, 3], [1, 2, 3])


def test_a_folder_that_fails_half_way_is_not_there(tmp_path):
    def write():
        with whole_or_not_at_all(tmp_path / "out") as part:
            (part / "half").write_text("")
            raise OSError("the disk is full")

    with pytest.raises(OSError, match="full"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_a_map_bundle_given_as_a_dataset_is_named(bundle_path):
    with pytest.raises(DatasetError) as caught:
        Dataset(bundle_path)
    assert caught.value.message == (
        f"{bundle_path} is a map bundle, not a dataset: give the folder that `streetfix simulate` or `streetfix import` wrote"
    )


def test_a_dataset_before_its_map_is_named(folder, bundle_path, tmp_path):
    require_map_first(bundle_path, folder, "evaluate")
    for bundle, dataset in ((folder, folder), (bundle_path, bundle_path), (tmp_path, folder)):
        require_map_first(bundle, dataset, "evaluate")  # the opening of each folder names these mistakes
    with pytest.raises(DatasetError) as caught:
        require_map_first(folder, bundle_path, "map update")
    assert caught.value.message == (
        f"{folder} is a dataset and {bundle_path} is a map bundle: give the map bundle first: "
        f"streetfix map update {bundle_path} {folder}"
    )


def test_an_unknown_accuracy_of_the_survey_is_left_out_and_a_known_one_is_read_again(tmp_path):
    make_dataset(tmp_path)
    assert "survey_accuracy" not in json.loads((tmp_path / "dataset.json").read_text())
    known = SurveyAccuracy(position_std_m=0.08, angle_std_deg=0.1)
    write_description(tmp_path, Dataset(tmp_path).description.model_copy(update={"survey_accuracy": known}))
    assert Dataset(tmp_path).description.survey_accuracy == known


@pytest.mark.parametrize("value", [-0.1, 5.1])
def test_an_accuracy_of_the_survey_out_of_bounds_is_refused(tmp_path, value):
    make_dataset(tmp_path)
    accuracy = {"position_std_m": value, "angle_std_deg": 0.1}
    change_json(tmp_path / "dataset.json", lambda d: d.update(survey_accuracy=accuracy))
    with pytest.raises(DatasetError, match=r"dataset.json: survey_accuracy.position_std_m"):
        Dataset(tmp_path)
