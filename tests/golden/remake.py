"""Remake the golden pictures of imaging: `python tests/golden/remake.py`. Look at them before committing them."""

from pathlib import Path

import cv2
import numpy as np

from service.imaging.fusion import fuse, picture_of

FOLDER = Path(__file__).parent / "imaging"
MAX_RANGE_M = 40.0


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A street of few pixels: sky without depth, two façades, a road, a red sign; RGB and depth in millimetres."""
    rgb = np.zeros((48, 64, 3), np.uint8)
    v, u = np.mgrid[:48, :64]
    rgb[:] = (150, 190, 230)
    depth = np.zeros((48, 64))
    side = np.abs(u - 31.5)
    facade = (side > 8) & (np.abs(v - 20) < side * 0.7)
    rgb[facade & (u < 32)] = (180, 120, 80)
    rgb[facade & (u > 31)] = (110, 140, 100)
    depth[facade] = (300 / side)[facade]
    road = v > 20 + side * 0.7
    rgb[road] = (90, 90, 95)
    depth[road] = np.minimum(200 / np.maximum(v - 20, 1), 60)[road]
    rgb[12:20, 44:50] = (230, 10, 20)
    depth[12:20, 44:50] = 5.0
    return rgb, np.rint(1000 * depth).astype(np.uint16)


def main() -> None:
    FOLDER.mkdir(exist_ok=True)
    rgb, depth_mm = scene()
    planes = fuse(rgb, depth_mm.astype(np.float32) / np.float32(1000)).planes
    cv2.imwrite(str(FOLDER / "rgb.png"), rgb[..., ::-1])
    cv2.imwrite(str(FOLDER / "depth.png"), depth_mm)
    np.save(FOLDER / "fused.npy", planes, allow_pickle=False)
    cv2.imwrite(str(FOLDER / "picture.png"), picture_of(planes, MAX_RANGE_M)[..., ::-1])


if __name__ == "__main__":
    main()
