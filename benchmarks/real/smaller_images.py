"""A copy of a KITTI drive whose images are smaller: a real street as a stereo rig with fewer pixels, or a shorter baseline, sees it.

Disparity errors stay a fraction of a pixel. So depth errors grow with the factor.
"""

import shutil
from pathlib import Path

import cv2

_IMAGES = (".jpg", ".png")
_CALIBRATION = "calib_cam_to_cam.txt"


def write_smaller_images(drive: Path, folder: Path, factor: int) -> Path:
    """Copy a drive, with the files of its day, and shrink its images; return the folder of the copy.

    Args:
        drive: folder of the drive, ``.../DAY/DAY_drive_NUMBER_sync``.
        folder: folder that receives the copy of the day. An earlier copy is deleted.
        factor: factor of both sides of the images.
    """
    shutil.rmtree(folder, ignore_errors=True)
    copy = folder / drive.name
    shutil.copytree(drive, copy)
    for file in drive.parent.glob("*.txt"):
        shutil.copy(file, folder / file.name)
    calibration = folder / _CALIBRATION
    calibration.write_text("".join(f"{scaled(line, factor)}\n" for line in calibration.read_text().splitlines()))
    for file in sorted(each for each in copy.rglob("*") if each.suffix in _IMAGES):
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise FileNotFoundError(f"{file} is no image")
        size = round(image.shape[1] / factor), round(image.shape[0] / factor)
        cv2.imwrite(str(file), cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return copy


def scaled(line: str, factor: int) -> str:
    """Return a line of KITTI's camera calibration for smaller rectified images; other lines stay.

    A principal point refers to the centre of the first pixel, so half a pixel is added before the division.

    Args:
        line: ``KEY: VALUES``.
        factor: factor of both sides of the images.
    """
    key, _, text = line.partition(":")
    if not key.startswith(("P_rect_", "S_rect_")):
        return line
    values = [float(each) for each in text.split()]
    if key.startswith("S_rect_"):
        values = [float(round(side / factor)) for side in values]
    else:  # rows of the projection matrix (3 x 4): fx, 0, cx, fx tx; 0, fy, cy, fy ty; the last row stays
        for k in (0, 3, 5, 7):
            values[k] /= factor
        for k in (2, 6):
            values[k] = (values[k] + 0.5) / factor - 0.5
    return f"{key}: " + " ".join(f"{value:.9e}" for value in values)
