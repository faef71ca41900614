"""KITTI's calibration in the layouts of its benchmarks: left and right colour camera, and LiDAR."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.errors import DatasetError
from service.geometry.rigid import Transform, transform_from

Matrix = NDArray[np.float64]
_OBJECT = {"P2": (3, 4), "P3": (3, 4), "R0_rect": (3, 3), "Tr_velo_to_cam": (3, 4)}


@dataclass(frozen=True, slots=True)
class KittiCalibration:
    """Left colour camera (2), its baseline to the right one (3), and the mounting of the LiDAR.

    Attributes:
        fx: pixels.
        fy: pixels.
        cx: pixels.
        cy: pixels.
        focal_baseline_px_m: fx times the baseline of cameras 2 and 3, pixels times metres: z is this over the disparity. None
            if the right camera is not calibrated.
        T_camera_lidar: maps points from the LiDAR frame to the optical frame of camera 2, with the offset in P2 (4, 4).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    focal_baseline_px_m: float | None
    T_camera_lidar: Transform

    @property
    def baseline_m(self) -> float | None:
        """Distance of cameras 2 and 3, metres; None if the right camera is not calibrated."""
        return None if self.focal_baseline_px_m is None else self.focal_baseline_px_m / self.fx


def read_calibration(path: Path) -> KittiCalibration:
    """Read the calibration of a frame in the object layout: P2, P3, R0_rect and Tr_velo_to_cam.

    Args:
        path: the file ``calib/NNNNNN.txt``.

    Raises:
        DatasetError: the file is missing, or a matrix in it is missing, broken or impossible.
    """
    matrices = read_matrices(path, _OBJECT)
    return calibration_from(
        path, P2=matrices["P2"], P3=matrices["P3"], R0=matrices["R0_rect"], Tr=matrices["Tr_velo_to_cam"]
    )


def calibration_from(path: Path, *, P2: Matrix, P3: Matrix | None, R0: Matrix, Tr: Matrix) -> KittiCalibration:
    """Combine the matrices of a calibration.

    P2 is K [I | t]. So t = K^-1 times its last column maps the rectified frame of camera 0 to the frame of camera 2.

    Args:
        path: of the file, for errors.
        P2: projection of the left camera, from the rectified frame of camera 0 (3, 4).
        P3: the same of the right camera (3, 4); None if it is not calibrated.
        R0: rectification of camera 0 (3, 3).
        Tr: maps points from the LiDAR frame to camera 0 before rectification (3, 4).

    Raises:
        DatasetError: they are no rigid mounting, or no stereo pair.
    """
    K = P2[:, :3]
    rotation = R0 @ Tr[:, :3]
    is_rotation = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    baseline = None if P3 is None else float(P2[0, 3] - P3[0, 3])
    if not is_rotation or K[0, 0] <= 0 or K[1, 1] <= 0 or (baseline is not None and baseline <= 0):
        raise DatasetError(
            f"{path}: R0_rect and Tr_velo_to_cam are not a rotation, or P2 and P3 are not a stereo pair with the "
            "right camera on the right; copy the file from the recording again",
            field=path.name,
        )
    translation = R0 @ Tr[:, 3] + np.linalg.solve(K, P2[:, 3])
    return KittiCalibration(
        fx=float(K[0, 0]),
        fy=float(K[1, 1]),
        cx=float(K[0, 2]),
        cy=float(K[1, 2]),
        focal_baseline_px_m=baseline,
        T_camera_lidar=transform_from(rotation, translation),
    )


def read_matrices(
    path: Path, shapes: Mapping[str, tuple[int, ...]], *, optional: frozenset[str] = frozenset()
) -> dict[str, Matrix]:
    """Read lines of the form ``KEY: numbers``.

    Args:
        path: of the file.
        shapes: wanted keys, each with its shape.
        optional: keys that may be missing; they are then missing in the result too.

    Returns:
        A matrix per key, of the wanted shape.

    Raises:
        DatasetError: the file is missing, or a matrix in it is missing or broken.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(
            f"{path} cannot be read ({error}); every frame that is used as a query needs its calibration",
            field=path.name,
        ) from error
    rows = dict(line.split(":", 1) for line in lines if ":" in line)
    matrices = {}
    for key, shape in shapes.items():
        if key in optional and key not in rows:
            continue
        try:
            values = np.array(rows[key].split(), np.float64)
            matrices[key] = values.reshape(shape)
        except (KeyError, ValueError) as error:
            size = "x".join(str(n) for n in shape)
            raise DatasetError(
                f"{path}: {key} is missing or is not {size} numbers; copy the file from the recording again",
                field=path.name,
            ) from error
        if not np.isfinite(values).all():
            raise DatasetError(f"{path}: {key} is not finite; copy the file from the recording again", field=path.name)
    return matrices
