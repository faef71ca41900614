from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.geometry.rigid import R_BODY_OPTICAL, rotation_x

HEIGHT, WIDTH = 60, 220
K = np.array([[200.0, 0.0, 110.0], [0.0, 200.0, 30.0], [0.0, 0.0, 1.0]])
BASELINE_M, DISPARITY_PX = 0.5, 20  # so the wall stands at z = 200 * 0.5 / 20 = 5 m
OFFSET_M = np.array([0.06, -0.01, 0.003])  # of camera 2, as P2 hides it in its last column


def matrix_line(key: str, matrix: np.ndarray) -> str:
    return f"{key}: " + " ".join(f"{x:.12e}" for x in matrix.reshape(-1))


def calibration_text(focal_px: float = 200.0) -> str:
    camera = K.copy()
    camera[0, 0] = camera[1, 1] = focal_px
    right = OFFSET_M - [BASELINE_M, 0, 0]
    lines = [
        matrix_line("P2", np.column_stack([camera, camera @ OFFSET_M])),
        matrix_line("P3", np.column_stack([camera, camera @ right])),
        matrix_line("R0_rect", rotation_x(0.02)),
        matrix_line("Tr_velo_to_cam", np.column_stack([R_BODY_OPTICAL.T, [0.01, -0.08, -0.27]])),
    ]
    return "\n".join(lines) + "\n"


def write_frame(
    training: Path, name: str, *, right: bool = True, scan: bool = True, stored: bool = True, focal_px: float = 200.0
) -> None:
    """A wall of random dots 5 m before the camera, as a stereo pair, a scan of few points and a stored depth."""
    rng = np.random.default_rng(int(name))
    for kind in ("image_2", "image_3", "velodyne", "gt_depth", "calib"):
        (training / kind).mkdir(parents=True, exist_ok=True)
    dots = rng.integers(0, 256, (HEIGHT, WIDTH + DISPARITY_PX, 3), np.uint8)
    dots = cv2.GaussianBlur(dots, (3, 3), 0)
    cv2.imwrite(str(training / "image_2" / f"{name}.png"), dots[:, :WIDTH])
    if right:
        cv2.imwrite(str(training / "image_3" / f"{name}.png"), dots[:, DISPARITY_PX:])
    if scan:
        points = np.column_stack([rng.uniform(4, 40, 50), rng.uniform(-4, 4, (50, 2)), np.zeros(50)])
        points.astype(np.float32).tofile(training / "velodyne" / f"{name}.bin")
    if stored:
        cv2.imwrite(str(training / "gt_depth" / f"{name}.png"), np.full((HEIGHT, WIDTH), 5 * 256, np.uint16))
    (training / "calib" / f"{name}.txt").write_text(calibration_text(focal_px))


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """Two frames with all, one without a scan (and depth), one without a right picture."""
    training = tmp_path / "source" / "training"
    write_frame(training, "000003")
    write_frame(training, "000004", focal_px=190.0)
    write_frame(training, "000005", scan=False, stored=False)
    write_frame(training, "000106", right=False, stored=False)
    return training


@pytest.fixture
def add_frame(kitti: Path) -> Callable[..., None]:
    return lambda name, **options: write_frame(kitti, name, **options)


@pytest.fixture
def kitti_recording() -> Path:
    folder = Path(__file__).parents[4] / "shared" / "data" / "kitti_stereo"
    if not folder.is_dir():
        pytest.skip("the recordings (../shared/data/kitti_stereo) are not here")
    return folder
