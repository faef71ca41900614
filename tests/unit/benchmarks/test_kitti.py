"""Place recognition with values computed by hand, queries of another day, and the drives found below a folder."""

import numpy as np
import pytest

from benchmarks.kitti import __main__ as bench
from benchmarks.kitti.protocol import found_within, in_the_frame_of
from benchmarks.kitti.published import NOTE, PUBLISHED_R1
from benchmarks.kitti.sources import PUBLISHED, Drive, drives_below, left_out, missing
from benchmarks.report import Report
from model_training.datasets.dataset import (
    CameraSensor,
    Dataset,
    DatasetDescription,
    Sensors,
    write_description,
    write_tum,
)
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.maps.reader import MapBundle

PLACES_XY = np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]])
PLACES_S = np.array([0.0, 2.0, 100.0])


def found(similarity, query_xy, query_s, left_out_s):
    right, asked = found_within(
        np.array([similarity], np.float32),
        np.array([query_xy]),
        PLACES_XY,
        query_s=np.array([query_s]),
        place_s=PLACES_S,
        left_out_s=left_out_s,
    )
    return bool(right[0]), bool(asked[0])


@pytest.mark.parametrize(
    ("similarity", "left_out_s", "expected"),
    [
        ([0.9, 0.5, 0.1], 0.05, (True, True)),
        ([0.5, 0.9, 0.1], 0.05, (False, True)),  # 17 m away
        ([0.9, 0.5, 0.1], 5.0, (False, False)),  # its own place was scanned just now, and no other is near
    ],
)
def test_the_most_similar_place_that_counts_must_be_near(similarity, left_out_s, expected):
    assert found(similarity, [3.0, 0.0], 1.0, left_out_s) == expected


def test_a_place_of_the_same_moment_does_not_count_but_one_of_another_time_does():
    """After 100 s the query is at the place where it was at 0 s."""
    assert found([0.9, 0.2, 0.95], [1.0, 0.0], 100.0, 60.0) == (True, True)


KARLSRUHE = {"latitude_deg": 49.0, "longitude_deg": 8.4, "height_m": 110.0}


def dataset_at(folder, *, north_deg=0.0, up_m=0.0, query_xyz=(), is_georeferenced=True):
    """Make a dataset with its origin north of Karlsruhe's and above it. Its images are never decoded."""
    queries = folder / "queries" / bench.QUERIES
    for kind, end in (("rgb", "jpg"), ("depth", "png")):
        (queries / kind).mkdir(parents=True)
        for number in range(len(query_xyz)):
            (queries / kind / f"{number:06d}.{end}").write_bytes(b"not decoded")
    poses = [transform_from(rotation_z(0.3) @ R_BODY_OPTICAL, np.array(xyz, np.float64)) for xyz in query_xyz]
    if poses:
        write_tum(queries / "poses.txt", np.arange(float(len(poses))), np.stack(poses))
    at = {"latitude_deg": KARLSRUHE["latitude_deg"] + north_deg, "height_m": KARLSRUHE["height_m"] + up_m}
    camera = CameraSensor(name="front", width=64, height=48, fx=32, fy=32, cx=31.5, cy=23.5)
    write_description(
        folder,
        DatasetDescription(
            name=folder.name,
            source={"kind": "test"},
            sensors=Sensors(cameras=[camera]),
            georeference=KARLSRUHE | at if is_georeferenced else None,
        ),
    )
    return Dataset(folder)


#: Length of a degree of latitude at 49 degrees north on the WGS-84 ellipsoid, metres.
DEGREE_M = 111_209.0


def test_positions_move_by_the_offset_of_the_two_origins(tmp_path):
    mapped = dataset_at(tmp_path / "mapped")
    asked = dataset_at(tmp_path / "asked", north_deg=300.0 / DEGREE_M, up_m=4.0)
    xyz = np.array([[0.0, 0.0, 0.0], [20.0, -30.0, 1.5]])
    moved = in_the_frame_of(mapped, asked, xyz)
    np.testing.assert_allclose(moved, xyz + [0.0, 300.0, 4.0], atol=0.02)  # the Earth's curvature: 7 mm at 300 m
    np.testing.assert_allclose(in_the_frame_of(asked, mapped, moved), xyz, atol=1e-6)
    np.testing.assert_allclose(in_the_frame_of(mapped, mapped, xyz), xyz, atol=1e-6)


@pytest.mark.parametrize("without", ["mapped", "asked"])
def test_positions_without_a_georeference_are_refused(tmp_path, without):
    mapped, asked = (dataset_at(tmp_path / n, is_georeferenced=n != without) for n in ("mapped", "asked"))
    with pytest.raises(ValueError, match="has no georeference"):
        in_the_frame_of(mapped, asked, np.zeros((1, 3)))


def test_queries_of_another_day_are_compared_in_the_frame_of_the_map(tmp_path, bundle_path, monkeypatch):
    """The tiny map has places at x = 0, 10, ... 50 m on the lines y = 0 and y = 100 m. The query origin is 40 m further north."""
    mapped = dataset_at(tmp_path / "mapped")
    asked = dataset_at(
        tmp_path / "asked",
        north_deg=40.0 / DEGREE_M,
        query_xyz=[(1.0, -40.0, 2.0), (1.0, -40.0, 2.0), (1.0, 0.0, 2.0), (50.0, 60.0, 2.0)],
    )
    similarity = np.zeros((4, 12), np.float32)
    # found; another place is more similar; 40 m from every place, so it does not count; found on the other line
    similarity[[0, 1, 2, 3], [0, 5, 0, 11]] = 1.0
    report = Report("kitti", "test", folder=tmp_path)
    bundle = MapBundle.open(bundle_path)

    def similarities(*given):
        assert given == (bundle, asked, bench.QUERIES)  # the queries of the other day, on the map of the first
        return similarity

    monkeypatch.setattr(bench, "place_similarities", similarities)
    bench._other_day(report, "first", "second", "a street", {"first": (mapped, bundle), "second": (asked, bundle)})
    (row,) = report.rows
    assert row["id"] == "kitti.other_day.first.second.recall_at_1_10m"
    assert (row["value"], row["n"]) == (pytest.approx(2 / 3), 3)


def test_the_published_table_has_a_figure_for_each_sequence():
    assert {len(figures) for figures in PUBLISHED_R1.values()} == {len(PUBLISHED)}
    assert NOTE.endswith("_".join(PUBLISHED))


def drive(root, *parts):
    for part in parts:
        (root / part).mkdir(parents=True)


def test_drives_are_found_wherever_they_lie(tmp_path):
    drive(tmp_path, "odometry/dataset/sequences/05/velodyne", "odometry/dataset/sequences/05/image_3")
    drive(tmp_path, "odometry/dataset/sequences/06/velodyne")  # no right pictures: no stereo depth
    raw = "raw/2011_09_30/2011_09_30_drive_0027_sync"
    drive(tmp_path, f"{raw}/velodyne_points/data", f"{raw}/image_03", f"{raw}/oxts")
    found = drives_below(tmp_path)
    assert [(each.name, each.kind, each.packed) for each in found] == [
        ("05", "kitti-odometry", False),
        ("2011_09_30_drive_0027", "kitti-raw", False),
    ]
    drive(tmp_path, "360/data_3d_raw/2013_05_28_drive_0000_sync/velodyne_points/data")
    drive(tmp_path, "360/data_2d_raw/2013_05_28_drive_0000_sync/image_01/data_rect")
    assert drives_below(tmp_path) == found  # no poses, nothing to measure
    drive(tmp_path, "360/data_poses/2013_05_28_drive_0000_sync")
    (tmp_path / "360/data_poses/2013_05_28_drive_0000_sync/poses.txt").touch()
    assert [each.name for each in drives_below(tmp_path) if each.kind == "kitti-360"] == ["2013_05_28_drive_0000"]
    assert not any("KITTI-360" in line for line in missing(drives_below(tmp_path)))
    assert any("KITTI-360" in line for line in missing(found))
    words = missing(found)
    assert [name for name in PUBLISHED if any(f"sequence {name} " in line for line in words)] == [
        name for name in PUBLISHED if name != "05"
    ]
    assert not any("2011_09_30_drive_0027" in line for line in words)


def test_drives_with_a_grey_pair_only_are_found(tmp_path):
    drive(tmp_path, "gray/sequences/07/velodyne", "gray/sequences/07/image_1")
    raw = "raw/2011_09_30/2011_09_30_drive_0028_sync"
    drive(tmp_path, f"{raw}/velodyne_points/data", f"{raw}/image_01", f"{raw}/oxts")
    assert [each.name for each in drives_below(tmp_path)] == ["07", "2011_09_30_drive_0028"]


def test_a_packed_drive_is_recognised(tmp_path):
    raw = tmp_path / "kitti_0005/2011_09_26/2011_09_26_drive_0005_sync"
    drive(raw, "velodyne_points/data", "image_03", "oxts")
    (raw / "velodyne_points/data/0000000000.xz").touch()
    (found,) = drives_below(tmp_path)
    assert (found.packed, found.folder) == (True, tmp_path / "kitti_0005")


def test_a_name_of_no_drive_is_refused_before_the_work_even_beside_a_valid_one(tmp_path, monkeypatch, capsys):
    drive(tmp_path, "sequences/00/velodyne", "sequences/00/image_3")
    monkeypatch.setattr("sys.argv", ["bench", "--root", str(tmp_path), "--only", "00", "typo"])
    monkeypatch.setattr(bench, "_mapped", lambda *_: pytest.fail("the work began"))
    with pytest.raises(SystemExit) as end:
        bench.main()
    assert end.value.code == 2
    assert "--only: no drive typo below --root; choose among: 00" in " ".join(capsys.readouterr().err.split())


def test_a_recording_that_was_not_measured_is_named_with_the_reason(tmp_path):
    drives = [Drive(name, "kitti-raw", tmp_path) for name in ("00", "05", "2011_09_26_drive_0013")]
    told = left_out(drives, drives[:1])
    assert told[0] == "05: not chosen by --only"
    assert told[1].startswith("2011_09_26_drive_0013: it serves reports only and may be measured at most once a day")
    assert left_out(drives, drives) == []
