import cv2
import numpy as np
import pytest

from model_training.datasets.dataset import Dataset
from model_training.importing.kitti_object import import_kitti_object
from service.errors import DatasetError
from service.geometry.rigid import inverse, transform_points


def scan_of(training, name):
    return np.fromfile(training / "velodyne" / f"{name}.bin", np.float32).reshape(-1, 4)


def pixels_by_kitti(calib_path, points_lidar):
    """Project by KITTI's own formula, P2 R0 Tr x, as an independent reference."""
    rows = dict(line.split(":") for line in calib_path.read_text().splitlines() if line)
    P2, R0, Tr = (np.array(rows[key].split(), float).reshape(3, -1) for key in ("P2", "R0_rect", "Tr_velo_to_cam"))
    homogeneous = np.column_stack([points_lidar, np.ones(len(points_lidar))])
    projected = P2 @ np.vstack([R0 @ Tr @ homogeneous.T, np.ones(len(points_lidar))])
    return (projected[:2] / projected[2]).T


def pixels_of_query(query, points_map):
    camera = transform_points(inverse(query.T_map_camera), points_map)
    return (query.camera.pinhole().matrix @ camera.T / camera[:, 2]).T[:, :2]


def test_every_scan_becomes_a_place_far_from_the_others(kitti, tmp_path):
    summary = import_kitti_object(kitti.parent, tmp_path / "out", depth="sgbm")
    poses = Dataset(tmp_path / "out").survey_poses()
    assert summary.places == len(poses) == 3
    np.testing.assert_array_equal(poses[:, :3, 3], [[0, 0, 0], [1000, 0, 0], [2000, 0, 0]])
    np.testing.assert_array_equal(Dataset(tmp_path / "out").scan(2), scan_of(kitti, "000106"))


def test_frames_fall_into_their_sets(kitti, tmp_path):
    summary = import_kitti_object(kitti, tmp_path / "out", depth="sgbm")
    dataset = Dataset(tmp_path / "out")
    assert (summary.frames, summary.elsewhere, summary.skipped) == (2, 1, ())
    assert dataset.query_sets() == ["elsewhere", "frames"]
    assert dataset.query_sets(with_truth=True) == ["frames"]
    assert dataset.description.source["queries"] == {"frames": ["000003", "000004"], "elsewhere": ["000005"]}


@pytest.mark.parametrize("number", [0, 1])
def test_truth_and_intrinsics_project_the_scan_as_kitti_does(kitti, tmp_path, number):
    import_kitti_object(kitti, tmp_path / "out", depth="stored")
    dataset = Dataset(tmp_path / "out")
    query = list(dataset.queries("frames"))[number]
    points = dataset.scan(number)[:, :3].astype(np.float64)
    points_map = transform_points(dataset.survey_poses()[number], points)
    expected = pixels_by_kitti(kitti / "calib" / f"00000{3 + number}.txt", points)
    np.testing.assert_allclose(pixels_of_query(query, points_map), expected, atol=1e-3)


def test_queries_name_the_camera_that_took_them(kitti, add_frame, tmp_path):
    add_frame("000007")
    summary = import_kitti_object(kitti, tmp_path / "out", depth="stored")
    assert summary.cameras == 2
    assert [query.camera.fx for query in Dataset(tmp_path / "out").queries("frames")] == [200.0, 190.0, 200.0]


def test_matched_depth_is_that_of_the_wall(kitti, tmp_path):
    import_kitti_object(kitti, tmp_path / "out", depth="sgbm")
    depth_m = next(Dataset(tmp_path / "out").queries("frames")).depth_m()[:, 140:]
    assert np.mean(depth_m > 0) > 0.9
    assert abs(np.median(depth_m[depth_m > 0]) - 5.0) < 0.02


def test_stored_depth_is_kept_to_the_bit(kitti, tmp_path):
    import_kitti_object(kitti, tmp_path / "out", depth="stored")
    stored = cv2.imread(str(kitti / "gt_depth" / "000003.png"), cv2.IMREAD_UNCHANGED)
    written = cv2.imread(str(tmp_path / "out/queries/frames/depth/000000.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(written, stored)
    np.testing.assert_array_equal(next(Dataset(tmp_path / "out").queries("frames")).depth_m(), 5.0)


def test_pictures_are_kept_to_the_byte(kitti, tmp_path):
    import_kitti_object(kitti, tmp_path / "out", depth="stored")
    assert (tmp_path / "out/queries/frames/rgb/000001.png").read_bytes() == (kitti / "image_2/000004.png").read_bytes()


def test_frames_elsewhere_without_stored_depth_are_skipped_with_the_remedy(kitti, tmp_path):
    summary = import_kitti_object(kitti, tmp_path / "out", depth="stored")
    assert summary.elsewhere == 0
    assert len(summary.skipped) == 1
    assert summary.skipped[0].startswith("000005")
    assert "--depth sgbm" in summary.skipped[0]


def test_progress_is_reported_for_every_frame(kitti, tmp_path):
    told = []
    import_kitti_object(kitti, tmp_path / "out", depth="sgbm", progress=lambda done, total: told.append((done, total)))
    assert told == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_a_folder_that_is_taken_is_refused(kitti, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("keep")
    with pytest.raises(DatasetError, match="not empty"):
        import_kitti_object(kitti, tmp_path / "out", depth="sgbm")
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["mine.txt"]


def test_an_empty_folder_and_a_broken_run_before_do_not_hinder(kitti, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / ".out.part").mkdir()
    (tmp_path / ".out.part" / "left over").write_text("")
    import_kitti_object(kitti, tmp_path / "out", depth="stored")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["dataset.json", "queries", "survey"]


def test_a_folder_without_frames_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="training/image_2"):
        import_kitti_object(tmp_path, tmp_path / "out", depth="sgbm")


def test_frames_without_any_scan_are_refused(kitti, tmp_path):
    for scan in (kitti / "velodyne").iterdir():
        scan.unlink()
    with pytest.raises(DatasetError, match="no scan"):
        import_kitti_object(kitti, tmp_path / "out", depth="sgbm")


def cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def crop(path):
    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    cv2.imwrite(str(path), picture[:, 1:])


def write_nan(path):
    np.full(8, np.nan, np.float32).tofile(path)


def without_P2(path):
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("P2")))


def with_a_word(path):
    path.write_text(path.read_text().replace("R0_rect: ", "R0_rect: one "))


def mirrored(path):
    path.write_text(path.read_text().replace("P2:", "P9:").replace("P3:", "P2:").replace("P9:", "P3:"))


DEFECTS = [
    ("sgbm", "image_2/000003.png", cut),
    ("sgbm", "image_3/000003.png", cut),
    ("sgbm", "image_3/000003.png", crop),
    ("stored", "gt_depth/000003.png", cut),
    ("stored", "gt_depth/000003.png", crop),
    ("stored", "velodyne/000003.bin", cut),
    ("stored", "velodyne/000106.bin", write_nan),
    ("stored", "calib/000003.txt", without_P2),
    ("stored", "calib/000003.txt", with_a_word),
    ("stored", "calib/000003.txt", mirrored),
    *[
        ("stored", f"{kind}/000003.{end}", lambda path: path.unlink())
        for kind, end in (("image_2", "png"), ("gt_depth", "png"), ("calib", "txt"))
    ],
]


@pytest.mark.parametrize(("depth", "file", "damage"), DEFECTS)
def test_a_damaged_or_missing_file_is_named_and_nothing_is_left(kitti, tmp_path, depth, file, damage):
    damage(kitti / file)
    with pytest.raises(DatasetError, match=file):
        import_kitti_object(kitti, tmp_path / "out", depth=depth)
    assert [p.name for p in tmp_path.iterdir()] == ["source"]


def test_the_recording_is_imported_with_exact_truth(kitti_recording, tmp_path):
    summary = import_kitti_object(kitti_recording, tmp_path / "out", depth="stored")
    assert (summary.places, summary.frames, summary.elsewhere) == (14, 7, 0)
    dataset = Dataset(tmp_path / "out")
    query = list(dataset.queries("frames"))[6]
    points_map = transform_points(dataset.survey_poses()[6], dataset.scan(6)[:, :3].astype(np.float64))
    u, v = np.rint(pixels_of_query(query, points_map)).astype(int).T
    assert query.T_map_camera is not None
    z = transform_points(inverse(query.T_map_camera), points_map)[:, 2]
    np.testing.assert_allclose(query.depth_m()[v, u], z, atol=1e-3)  # the scan was made from this depth


def test_matched_depth_of_the_recording_is_near_its_stored_depth(kitti_recording, tmp_path):
    source = tmp_path / "one" / "training"
    for path in (kitti_recording / "training").glob("*/000001.*"):
        (source / path.parent.name).mkdir(parents=True, exist_ok=True)
        (source / path.parent.name / path.name).symlink_to(path)
    depth = {}
    for kind in ("stored", "sgbm"):
        import_kitti_object(source, tmp_path / kind, depth=kind)
        depth[kind] = next(Dataset(tmp_path / kind).queries("frames")).depth_m()
    both = (depth["stored"] > 0) & (depth["sgbm"] > 0)
    error = np.abs(depth["sgbm"] - depth["stored"])[both] / depth["stored"][both]
    assert np.median(error) < 0.03
    assert both.sum() / (depth["stored"] > 0).sum() > 0.5


@pytest.mark.parametrize("depth", ["sgbm", "stored"])
def test_only_matched_depth_has_a_baseline(kitti, tmp_path, depth):
    import_kitti_object(kitti, tmp_path / "out", depth=depth)
    for camera in Dataset(tmp_path / "out").description.sensors.cameras:
        assert camera.depth.baseline_m == (pytest.approx(0.5) if depth == "sgbm" else None)
