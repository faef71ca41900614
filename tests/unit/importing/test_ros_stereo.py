"""Stereo pairs from bags: topics, rectification, depth, and what is refused."""

import numpy as np
import pytest

from model_training.importing.recording import RecordedPicture, Unusable
from model_training.importing.ros_bag import RosBag
from model_training.importing.ros_content import BagSettings
from model_training.importing.ros_reader import opened as opened_bag
from model_training.importing.ros_stereo import spread_pairs
from model_training.importing.row_alignment import PAIRS
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, transform_from

# The images are 64 x 240 pixels with fx = 100. A disparity of 8 px with a baseline of 0.16 m is a depth of 100 * 0.16 / 8 = 2 m.
HEIGHT, WIDTH, FOCAL, BASELINE_M, DISPARITY, DEPTH_M = 64, 240, 100.0, 0.16, 8, 2.0
LEFT, RIGHT = "/stereo/left/image_rect", "/stereo/right/image_rect"
INFOS = ("/stereo/left/camera_info", "/stereo/right/camera_info")
MOUNTED = [
    ("base_link", "lidar", np.eye(4)),
    ("base_link", "camera", transform_from(R_BODY_OPTICAL, np.array([1.0, 0.0, 1.5]))),
]
# columns whose match lies in the right image, without the border of the matcher's window
INNER = (slice(8, -8), slice(16, -16))


def images(*, right_columns=0):
    """Return a textured pair. The right image is moved by some more columns to the right."""
    wide = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH + 80), dtype=np.uint8)
    wide = np.repeat(np.repeat(wide[::2, ::2], 2, axis=0), 2, axis=1)  # blobs of 2 px survive interpolation
    begin = 40
    shifted = begin + DISPARITY - right_columns
    return wide[:, begin : begin + WIDTH], wide[:, shifted : shifted + WIDTH]


def info_of(ros, *, cx=(WIDTH - 1) / 2, baseline_m=0.0, raw_cx=None, D=(), model="plumb_bob"):
    message = ros.info(0.0, focal=FOCAL, size=(HEIGHT, WIDTH), D=D)
    message.distortion_model = model
    middle = (HEIGHT - 1) / 2
    message.k = np.array([FOCAL, 0, cx if raw_cx is None else raw_cx, 0, FOCAL, middle, 0, 0, 1.0])
    message.p = np.array([FOCAL, 0, cx, -FOCAL * baseline_m, 0, FOCAL, middle, 0, 0, 0, 1.0, 0])
    return message


def drive(ros, pair=None, *, count=3, infos=None, topics=(LEFT, RIGHT), late_s=0.0, more=()):
    left, right = images() if pair is None else pair
    of_left, of_right = (info_of(ros), info_of(ros, baseline_m=BASELINE_M)) if infos is None else infos
    messages = [("/tf_static", 0.0, ros.tf(*(ros.edge(0.0, *edge) for edge in MOUNTED)))]
    for k in range(count):
        s = 0.1 * k
        pose = transform_from(np.eye(3), np.array([float(k), 0.0, 0.0]))
        messages += [
            ("/odom", s, ros.odometry(s, pose)),
            ("/points", s, ros.cloud(s, [[k, 1, 2, 3]])),
            (INFOS[0], s, of_left),
            (INFOS[1], s, of_right),
            (topics[0], s, ros.image(s, left, "mono8")),
            (topics[1], s + late_s, ros.image(s + late_s, right, "mono8")),
            *((topic, s, message) for topic, message in more),
        ]
    return messages


def opened(path, **told):
    return RosBag(path, BagSettings(want_depth=False, stereo=True, **told))


def pictures(bag):
    return [event for event in bag.events() if isinstance(event, RecordedPicture)]


def test_rectified_pairs_become_images_with_depth_and_baseline(ros, tmp_path):
    bag = opened(ros.write(tmp_path / "bag", drive(ros)))
    found = pictures(bag)
    assert len(found) == 3
    np.testing.assert_array_equal(found[0].rgb[:, :, 0], images()[0])
    assert np.median(found[0].depth[INNER]) == pytest.approx(DEPTH_M, abs=0.02)
    assert (found[0].depth[INNER] > 0).mean() > 0.9
    assert [picture.baseline_m for picture in found] == [pytest.approx(BASELINE_M)] * 3
    np.testing.assert_allclose(found[0].T_vehicle_camera, MOUNTED[1][2], atol=1e-12)
    assert bag.notes.source["depth"] == "sgbm"
    assert bag.notes.source["matching"]["method"] == "sgbm"
    topics = bag.notes.source["topics"]
    assert (topics["color"], topics["right"]) == (LEFT, RIGHT)
    assert (topics["info"], topics["right_info"]) == INFOS
    (line,) = [line for line in bag.notes.lines if line.startswith("stereo pairs")]
    assert line.startswith("stereo pairs: rectified, baseline 0.1600 m; right camera: rows ")


def test_the_baseline_counts_from_the_left_camera_wherever_the_origin_of_the_rig_is(ros, tmp_path):
    # KITTI's colour cameras: the left one is 0.06 m to the left of the origin, the right one 0.10 m to the right.
    infos = (info_of(ros, baseline_m=-0.06), info_of(ros, baseline_m=BASELINE_M - 0.06))
    (found, *_) = pictures(opened(ros.write(tmp_path / "bag", drive(ros, infos=infos))))
    assert found.baseline_m == pytest.approx(BASELINE_M)
    assert np.median(found.depth[INNER]) == pytest.approx(DEPTH_M, abs=0.02)


def test_raw_pairs_are_rectified_by_both_calibrations(ros, tmp_path):
    # The raw right camera has its optical axis 6 columns farther to the right. Without rectification the disparity would be 2 px.
    middle = (WIDTH - 1) / 2
    infos = (info_of(ros), info_of(ros, baseline_m=BASELINE_M, raw_cx=middle + 6))
    topics = ("/stereo/left/image_raw", "/stereo/right/image_raw")
    path = ros.write(tmp_path / "bag", drive(ros, images(right_columns=6), infos=infos, topics=topics))
    bag = opened(path)
    found = pictures(bag)
    assert np.median(found[0].depth[INNER]) == pytest.approx(DEPTH_M, abs=0.02)
    assert "raw images, rectified by their calibrations" in bag.notes.lines[-1]
    wrong = pictures(opened(path, rectified=True))
    assert np.median(wrong[0].depth[INNER]) == pytest.approx(DEPTH_M * DISPARITY / 2, abs=0.5)


@pytest.mark.parametrize(
    ("model", "D", "ends"), [("plumb_bob", (0.2, 0, 0, 0, 0), True), ("equidistant", (0.1, 0, 0, 0), False)]
)
def test_a_lens_is_removed_and_no_depth_lies_where_the_raw_image_ends(ros, tmp_path, model, D, ends):
    infos = (info_of(ros, D=D, model=model), info_of(ros, D=D, model=model, baseline_m=BASELINE_M))
    topics = ("/left/image_raw", "/right/image_raw")
    path = ros.write(tmp_path / "bag", drive(ros, infos=infos, topics=topics))
    bag = opened(path, topics={"info": INFOS[0], "right_info": INFOS[1]})
    (found, *_) = pictures(bag)
    columns, rows = bag._rig.lookups[0]
    outside = (columns < 0) | (columns > WIDTH - 1) | (rows < 0) | (rows > HEIGHT - 1)
    assert found.camera.distortion == ()
    # At the left edge x is 1.195. This lens shows it at 1.195 (1 + 0.2 * 1.195^2) = 1.54, the fisheye at 0.94.
    assert outside.any() == ends
    assert columns[HEIGHT // 2, 0] == pytest.approx(119.5 - (153.6 if ends else 94.1), abs=0.2)
    assert not found.depth[outside].any()
    assert (found.depth > 0).any()


def test_a_right_image_of_another_moment_is_not_a_partner(ros, tmp_path):
    bag = opened(ros.write(tmp_path / "bag", drive(ros, late_s=0.02)))
    unusable = [event for event in bag.events() if isinstance(event, Unusable)]
    assert {event.why for event in unusable} == {"no right image within 0.005 s of it"}
    assert len(unusable) == 3


def test_a_right_image_of_another_size_is_counted(ros, tmp_path):
    left, right = images()
    bag = opened(ros.write(tmp_path / "bag", drive(ros, (left, right[:, :200]))))
    (why,) = {event.why for event in bag.events() if isinstance(event, Unusable)}
    assert why == "sizes differ: left (64, 240), right (64, 200), camera (64, 240)"


@pytest.mark.parametrize(
    ("messages", "told", "remedy"),
    [
        ({"topics": ("/front/image", "/side/image")}, {}, r"no image topic has a word for the left camera.*color=LEFT"),
        (
            {"topics": ("/left/image_rect", "/side/image")},
            {},
            r"no topic of right images fits /left/image_rect; give --topic",
        ),
        (
            {},
            {"camera": PinholeCamera(WIDTH, HEIGHT, FOCAL, FOCAL, 120.0, 32.0, (0.1, 0.0, 0.0, 0.0, 0.0))},
            r"--camera has a lens",
        ),
        ({"topics": ("/left/image_raw", "/right/image_raw")}, {"baseline_m": 0.1, "topics": {"info": INFOS[0]}}, None),
    ],
)
def test_what_stereo_lacks_is_named(ros, tmp_path, messages, told, remedy):
    path = ros.write(tmp_path / "bag", drive(ros, **messages))
    if remedy is None:  # the right calibration is found beside the left one
        assert len(pictures(opened(path, **told))) == 3
        return
    with pytest.raises(DatasetError, match=remedy):
        opened(path, **told)


def test_without_a_right_calibration_the_baseline_can_be_given_if_the_images_are_rectified(ros, tmp_path):
    messages = [message for message in drive(ros) if message[0] != INFOS[1]]
    path = ros.write(tmp_path / "rectified", messages)
    with pytest.raises(DatasetError, match="give its CameraInfo with --topic right_info=NAME, or --baseline-m METRES"):
        opened(path)
    assert np.median(pictures(opened(path, baseline_m=0.32))[0].depth[INNER]) == pytest.approx(4.0, abs=0.04)
    with pytest.raises(DatasetError, match="only the CameraInfo of both cameras says how to rectify them"):
        opened(path, baseline_m=0.32, rectified=False)


def test_a_given_baseline_goes_before_a_guessed_calibration(ros, tmp_path):
    """The left camera is not the origin of this rig. A given baseline is that of the cameras, so nothing is added to it."""
    infos = (info_of(ros, baseline_m=-0.06), info_of(ros, baseline_m=BASELINE_M - 0.06))
    bag = opened(ros.write(tmp_path / "bag", drive(ros, count=1, infos=infos)), baseline_m=0.32)
    (found,) = pictures(bag)
    assert found.baseline_m == 0.32
    assert np.median(found.depth[INNER]) == pytest.approx(2 * DEPTH_M, abs=0.04)


def test_a_given_camera_keeps_the_baseline_from_the_left_camera(ros, tmp_path):
    infos = (info_of(ros, baseline_m=-0.06), info_of(ros, baseline_m=BASELINE_M - 0.06))
    camera = PinholeCamera(WIDTH, HEIGHT, FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    (found,) = pictures(opened(ros.write(tmp_path / "bag", drive(ros, count=1, infos=infos)), camera=camera))
    assert found.baseline_m == pytest.approx(BASELINE_M)


def test_swapped_cameras_to_the_right_of_the_origin_are_refused(ros, tmp_path):
    infos = (info_of(ros, baseline_m=0.54), info_of(ros, baseline_m=0.47))
    with pytest.raises(
        DatasetError, match=r"means a baseline of -0\.07 m .*if the cameras are swapped, give --topic"
    ) as caught:
        opened(ros.write(tmp_path / "bag", drive(ros, count=1, infos=infos)))
    assert caught.value.field == "right_info"


@pytest.mark.parametrize("size", [(WIDTH // 2, HEIGHT), (0, 0)])
def test_raw_cameras_of_other_sizes_are_refused(ros, tmp_path, size):
    right = info_of(ros, baseline_m=BASELINE_M)
    right.width, right.height = size
    path = ros.write(tmp_path / "bag", drive(ros, count=1, infos=(info_of(ros), right)))
    with pytest.raises(DatasetError, match=f"left images have 240x64 pixels and the right ones {size[0]}x{size[1]}"):
        opened(path, rectified=False)


@pytest.mark.parametrize(
    ("model", "D", "told"),
    [
        ("plumb_bob", (0.1, 0.0, 0.0), r"'plumb_bob' has 3 coefficients \(valid: 4, 5, 8, 12, 14\)"),
        ("equidistant", (0.1, 0.0), r"'equidistant' has 2 coefficients \(valid: 4 or more\)"),
    ],
)
def test_a_lens_with_another_number_of_coefficients_is_refused(ros, tmp_path, model, D, told):
    infos = (info_of(ros), info_of(ros, D=D, model=model, baseline_m=BASELINE_M))
    path = ros.write(tmp_path / "bag", drive(ros, count=1, infos=infos))
    with pytest.raises(DatasetError, match=f"right camera: distortion_model {told}"):
        opened(path, rectified=False)


def test_a_given_baseline_needs_no_calibration_of_the_right_camera(ros, tmp_path):
    right = info_of(ros, baseline_m=BASELINE_M)
    right.p = np.zeros(12)
    (found,) = pictures(
        opened(ros.write(tmp_path / "bag", drive(ros, count=1, infos=(info_of(ros), right))), baseline_m=BASELINE_M)
    )
    assert found.baseline_m == BASELINE_M
    assert np.median(found.depth[INNER]) == pytest.approx(DEPTH_M, abs=0.02)


def test_rectified_cameras_with_other_projections_are_refused(ros, tmp_path):
    infos = (info_of(ros), info_of(ros, cx=(WIDTH - 1) / 2 + 4, baseline_m=BASELINE_M))
    with pytest.raises(DatasetError, match=r"another cx in their P: 119.5 and 123.5 px"):
        opened(ros.write(tmp_path / "bag", drive(ros, infos=infos)))


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"p": np.zeros(12)}, "left camera: its CameraInfo has no stereo calibration"),
        ({"r": np.zeros(9)}, "left camera: its CameraInfo has no stereo calibration"),
        ({"distortion_model": "odd", "d": np.ones(5)}, "left camera: unknown distortion_model 'odd'"),
    ],
)
def test_raw_images_without_a_stereo_calibration_are_refused(ros, tmp_path, changed, why):
    left = info_of(ros)
    for name, value in changed.items():
        setattr(left, name, value)
    path = ros.write(tmp_path / "bag", drive(ros, infos=(left, info_of(ros, baseline_m=BASELINE_M))))
    with pytest.raises(DatasetError, match=why):
        opened(path, rectified=False)


def test_the_infrared_pair_of_a_depth_camera_is_a_stereo_pair(ros, tmp_path):
    topics = ("/d455/infra1/image_rect_raw", "/d455/infra2/image_rect_raw")
    more = [("/d455/color/image_raw", ros.image(0.0, np.zeros((6, 8, 3), np.uint8), "rgb8"))]
    bag = opened(
        ros.write(tmp_path / "bag", drive(ros, topics=topics, more=more)),
        topics={"info": INFOS[0], "right_info": INFOS[1]},
    )
    found = bag.notes.source["topics"]
    assert (found["color"], found["right"]) == topics
    assert len(pictures(bag)) == 3


def test_rows_are_measured_on_pairs_that_are_spread_over_the_drive(ros, tmp_path):
    path = ros.write(tmp_path / "bag", drive(ros, count=48))
    with opened_bag(path) as bag:
        stamps = [pair.stamp_s for pair in spread_pairs(bag, LEFT, RIGHT)]
    assert len(stamps) == PAIRS
    assert np.diff(stamps) == pytest.approx(4.7 / PAIRS, abs=0.1)


def test_a_bag_without_pairs_is_searched_once(ros, tmp_path, monkeypatch):
    begins = []
    path = ros.write(tmp_path / "bag", drive(ros, late_s=0.02))
    with opened_bag(path) as bag:
        messages = type(bag).messages
        monkeypatch.setattr(
            type(bag), "messages", lambda self, topics, **told: begins.append(told) or messages(self, topics, **told)
        )
        assert list(spread_pairs(bag, LEFT, RIGHT)) == []
    assert len(begins) == 1
