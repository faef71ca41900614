import json
from dataclasses import replace

import numpy as np
import pytest

from model_training.calibration import elsewhere, rendered_rig
from model_training.calibration.rendered_rig import RigFile, frames_of_rig, read_rig, render_query, surfels_in_view
from model_training.cli.calibrate import part_for
from service.errors import BundleError, DatasetError
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import MOST_AROUND, open_map
from service.maps.writer import replace_calibration

CAMERA = {"width": 64, "height": 48, "fx": 32.0, "fy": 32.0, "cx": 31.5, "cy": 23.5, "height_m": 1.5}
STEREO = {"noise_px": 0.25, "baseline_m": 0.1, "min_range_m": 0.4, "max_range_m": 30.0}
EXACT = {"noise_m": 1e-6, "min_range_m": 0.4, "max_range_m": 40.0}
#: Pose of ``pictures`` in the tiny map.
T_TRUE = transform_from(rotation_z(np.pi / 2) @ R_BODY_OPTICAL, np.array([20.0, 100.0, 1.7]))


def rig_of(depth=STEREO, **camera):
    return RigFile.model_validate({"camera": CAMERA | camera, "depth": depth})


def written(folder, **changed):
    path = folder / "rig.json"
    path.write_text(json.dumps({"camera": CAMERA, "depth": STEREO} | changed))
    return path


def test_the_key_of_a_rig_is_that_of_its_queries_even_if_the_rendered_image_is_smaller():
    rig = rig_of(width=1920, height=1080, fx=960.0, fy=960.0, cx=959.5, cy=539.5)
    assert rig.pinhole().width == 1280
    key = rig.key()
    assert (key.width, key.fx, key.baseline_m, key.max_range_m) == (1920, 960.0, 0.1, STEREO["max_range_m"])


def test_a_rig_file_is_read(tmp_path):
    rig = read_rig(written(tmp_path, name="mule"))
    assert (rig.name, rig.camera.fx, rig.depth.baseline_m, rig.rectified) == ("mule", 32.0, 0.1, True)


@pytest.mark.parametrize(
    ("changed", "field", "message"),
    [
        ({"camera": {}}, "camera.width", "Field required"),
        ({"camera": CAMERA | {"fx": -1}}, "camera.fx", "greater than 0"),
        ({"camera": CAMERA | {"height_m": 99}}, "camera.height_m", "less than or equal to 30"),
        ({"camera": CAMERA | {"k1": 0.1}}, "camera.k1", "Extra inputs are not permitted"),
        ({"depth": STEREO | {"baseline_m": None}}, "depth", "noise_px and offset_px need baseline_m"),
        ({"depth": STEREO | {"min_range_m": 40}}, "depth", "min_range_m 40 is not below max_range_m 30"),
        ({"depth": {"min_range_m": 1, "max_range_m": 9}}, "depth", "a sensor without errors does not exist"),
        ({"rectified": False}, "rectified", "rectify the images first"),
        (
            {"camera": CAMERA | {"distortion": {"k1": 0.1}}},
            "camera.distortion",
            "rectified camera that `streetfix doctor` prints",
        ),
        ({"gravity": [0, 1, 0]}, "gravity", "the rendered camera is nearly level"),
        ({"depth": STEREO | {"noise_px": float("nan")}}, "depth.noise_px", "finite number"),
    ],
)
def test_a_rig_file_that_makes_no_sense_is_refused_by_field(tmp_path, changed, field, message):
    path = written(tmp_path, **changed)
    with pytest.raises(DatasetError) as error:
        read_rig(path)
    assert error.value.message.startswith(f"{path}: {field}: ")
    assert message in error.value.message
    assert error.value.field == field


@pytest.mark.parametrize("text", ["", "[]", "{"])
def test_a_file_that_is_no_rig_is_refused(tmp_path, text):
    path = tmp_path / "rig.json"
    path.write_text(text)
    with pytest.raises(DatasetError, match=r"rig.json: rig.json: .*docs/formats.md has an example"):
        read_rig(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(DatasetError, match=r"no\.json: the file is missing"):
        read_rig(tmp_path / "no.json")


def test_a_wide_image_is_reduced_to_1280_pixels():
    camera = rig_of(width=2560, height=1440, fx=1000.0, fy=1000.0, cx=1279.5, cy=719.5).pinhole()
    assert (camera.width, camera.height, camera.fx, camera.cx) == (1280, 720, 500.0, 639.5)
    assert rig_of().pinhole().width == 64


@pytest.mark.parametrize(
    ("depth", "std_m"),
    [
        ({"noise_m": 0.05}, 0.05),
        ({"noise_share": 0.02}, 0.2),
        ({"noise_m": 0.05, "noise_share": 0.02}, np.hypot(0.05, 0.2)),
        # 0.05 px at a focal length times baseline of 32 x 0.5 px m: 0.05 / 16 x 10 x 10 m
        ({"noise_px": 0.05, "baseline_m": 0.5}, 0.3125),
    ],
)
def test_the_errors_of_a_wall_at_10_m_by_hand(depth, std_m):
    rig = rig_of(depth | {"min_range_m": 0.5, "max_range_m": 50.0})
    wall, group = np.full((48, 64), 10.0, np.float32), np.arange(48 * 64).reshape(48, 64) // 4
    images = np.stack([rig.measured(wall, group, np.random.default_rng(seed)) for seed in range(60)])
    error = images[images > 0] - 10.0
    assert error.std() == pytest.approx(std_m, rel=0.2)
    assert (images > 0).mean() > 0.9


def test_a_disparity_offset_is_that_of_a_whole_image():
    """0.1 px at 16 px m shift a wall at 10 m by 0.6 m, all pixels of an image alike."""
    rig = rig_of({"offset_px": 0.1, "noise_m": 1e-6, "baseline_m": 0.5, "min_range_m": 0.5, "max_range_m": 50.0})
    wall, group = np.full((48, 64), 10.0, np.float32), np.zeros((48, 64), np.int64)
    images = [rig.measured(wall, group, np.random.default_rng(seed)) for seed in range(40)]
    assert max(float(image[image > 0].std()) for image in images) < 1e-3
    assert 0.4 < np.std([image[image > 0].mean() for image in images]) < 0.9


@pytest.mark.parametrize(("z_m", "is_measured"), [(1.0, False), (5.0, True), (9.0, False), (0.0, False)])
def test_depth_outside_the_range_is_not_measured(z_m, is_measured):
    rig = rig_of({"noise_m": 0.001, "min_range_m": 2.0, "max_range_m": 8.0})
    wall = np.full((48, 64), z_m, np.float32)
    found = rig.measured(wall, np.zeros(wall.shape, np.int64), np.random.default_rng(0))
    assert (found > 0).mean() > 0.9 if is_measured else not found.any()


@pytest.fixture
def no_new_objects(monkeypatch):
    monkeypatch.setattr(rendered_rig, "NEW_OBJECTS", 0.0)


def test_an_image_from_the_true_pose_shows_what_the_map_was_made_of(content, pictures, no_new_objects):
    _, true_m, _ = pictures
    query = render_query(content.cloud, T_TRUE, rig_of(EXACT), np.random.default_rng(0))
    seen = query.depth_m > 0
    assert seen.mean() > 0.7
    off = np.abs(query.depth_m - true_m)[seen]
    assert np.median(off) < 0.1
    assert np.quantile(off, 0.8) < 0.5
    assert query.rgb[seen].any()
    assert query.baseline_m is None
    assert render_query(content.cloud, T_TRUE, rig_of(), np.random.default_rng(0)).baseline_m == 0.1


def test_pixels_of_a_large_image_take_the_surfels_of_a_smaller_one(content):
    large = rig_of(width=640, height=480, fx=320.0, fy=320.0, cx=319.5, cy=239.5)
    index = surfels_in_view(content.cloud, T_TRUE, large)
    assert index.shape == (480, 640)
    assert (index[0::2, 0::2] == index[1::2, 1::2]).all()


def test_new_objects_hide_the_map(content, monkeypatch):
    images = []
    for count in (0.0, 20.0):
        monkeypatch.setattr(rendered_rig, "NEW_OBJECTS", count)
        images.append(render_query(content.cloud, T_TRUE, rig_of(EXACT), np.random.default_rng(4)).depth_m)
    without, with_objects = images
    both = (without > 0) & (with_objects > 0)
    assert (with_objects < 0.8 * without)[both].mean() > 0.05
    assert (with_objects > 1.3 * without)[both].mean() < 0.05


def test_an_image_is_the_same_the_next_time(content):
    one, other = (render_query(content.cloud, T_TRUE, rig_of(), np.random.default_rng(7)).depth_m for _ in range(2))
    np.testing.assert_array_equal(one, other)


def test_frames_of_a_map_are_labelled_and_asked_again_elsewhere(stock_map, monkeypatch):
    monkeypatch.setattr(elsewhere, "FEWEST_LEFT", 3)
    localizer, told = Localizer.open(MapBundle.open(stock_map)), []
    sensor = {"noise_share": 0.01, "min_range_m": 0.4, "max_range_m": 30.0}
    rig = rig_of(sensor, width=96, height=72, fx=48.0, fy=48.0, cx=47.5, cy=35.5)
    frames = frames_of_rig(localizer, rig, workers=1, report=lambda *event: told.append(event))
    count = len(localizer.bundle.T_map_place)
    assert told[-1] == ("rendered images", count, count)
    inside = int((~frames.outside).sum())
    assert inside > 0.8 * count
    assert frames.outside.sum() > 0.8 * count
    assert frames.right.sum() > 0.6 * inside
    assert not (frames.right & frames.outside).any()
    assert np.isfinite(frames.evidence).all()


def test_a_map_without_a_cloud_is_refused(bundle_path):
    bundle = replace(MapBundle.open(bundle_path), cloud=None)
    with pytest.raises(BundleError, match="has no cloud to render images from"):
        frames_of_rig(Localizer.open(bundle), rig_of())


def test_a_tiled_map_is_calibrated_on_its_own_tiles(stock_map, small_dataset, tmp_path, monkeypatch):
    """The whole map is one tile. It gives the same frames, and its new calibration keeps the tile."""
    tiled = tmp_path / "tiled"
    write_tiled(tiled, {(0, 0): stock_map}, 500.0, name="stock")
    monkeypatch.setattr(elsewhere, "FEWEST_LEFT", 3)
    monkeypatch.setattr(rendered_rig, "IMAGES", 4)
    sensor = {"noise_share": 0.01, "min_range_m": 0.4, "max_range_m": 30.0}
    rig = rig_of(sensor, width=96, height=72, fx=48.0, fy=48.0, cx=47.5, cy=35.5)
    part = part_for(open_map(tiled), rig)
    found, expected = (
        frames_of_rig(Localizer.open(each), rig, workers=1) for each in (part, MapBundle.open(stock_map))
    )
    np.testing.assert_allclose(found.evidence, expected.evidence, rtol=1e-3, atol=1e-3)
    document = json.loads((tiled / "calibration.json").read_text())
    made = replace_calibration(tiled, {**document, "measured_on": {"changed": 1.0}})
    again = open_map(tiled)
    assert again.manifest.version == made.version
    frame = next(iter(small_dataset.queries("drive1_precise")))
    assert Localizer.open(again).localize(frame.query(again.grid)).candidates
    assert part_for(again, small_dataset).T_map_place.shape == again.T_map_place.shape


def test_the_images_of_a_tiled_map_come_from_tiles_all_over_it(stock_map, tmp_path, monkeypatch):
    write_tiled(tmp_path / "tiled", {(0, 0): stock_map}, 500.0, name="stock")
    opened = open_map(tmp_path / "tiled")
    asked = []
    monkeypatch.setattr(type(opened), "around", lambda _, positions_of: asked.append(positions_of()))
    part_for(opened, rig_of())
    (positions_m,) = asked
    places_m = opened.T_map_place[:, :3, 3]
    assert len(positions_m) == MOST_AROUND
    np.testing.assert_array_equal(positions_m[[0, -1]], places_m[[0, -1]])
    assert len(np.unique(positions_m, axis=0)) == min(MOST_AROUND, len(places_m))
