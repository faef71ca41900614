"""How stereo matching errs: disparities against the scans of a survey that passed the same way.

A point of the scan ahead counts where the scan behind says the same, which drops what moves and what only one of them sees. So real and
simulated recordings are measured alike, by sensors and not by a truth that only the simulator has.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset, QueryFrame
from model_training.importing.lidar_depth import visible_points
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import transform_points

#: Two scans say the same where their disparities differ by less than this, within so many pixels each way.
AGREE_PX, REACH_PX = 0.5, 2
#: Mean size of the horizontal gradient (grey values a pixel) over a patch of this side, from which it counts as textured.
TEXTURED, PATCH_PX = 1.5, 9
#: An error larger than this is an outlier, as in KITTI's stereo benchmark (Menze and Geiger, CVPR 2015).
OUTLIER_PX = 3.0
LAGS_PX = (2, 4, 8, 12, 16, 24, 32, 48, 64)


@dataclass(frozen=True, slots=True)
class DisparityErrors:
    """Of all points of a recording.

    Attributes:
        error_px: (n) measured less scanned disparity; NaN where nothing was matched.
        textured: (n) whether the picture has texture there.
        z_m: (n) depth by the scan, metres.
        line: (n) of which picture and row it is; the numbers only tell rows apart.
        column: (n) in the picture.
    """

    error_px: NDArray[np.float64]
    textured: NDArray[np.bool_]
    z_m: NDArray[np.float64]
    line: NDArray[np.int64]
    column: NDArray[np.int64]

    def sizes(self, *, textured: bool) -> NDArray[np.float64]:
        """Absolute errors of what was matched, textured or not."""
        error = self.error_px[(self.textured == textured) & np.isfinite(self.error_px)]
        sizes: NDArray[np.float64] = np.abs(error)
        return sizes

    def unmatched(self, *, textured: bool) -> float:
        """Share of the points where nothing was matched."""
        return float(np.isnan(self.error_px[self.textured == textured]).mean())

    def outliers(self, *, nearest_m: float, farthest_m: float) -> float:
        """Share of what was matched in a range of depths that is off by more than ``OUTLIER_PX``."""
        error = self.error_px[(self.z_m >= nearest_m) & (self.z_m < farthest_m) & np.isfinite(self.error_px)]
        return float((np.abs(error) > OUTLIER_PX).mean()) if len(error) else float("nan")

    def correlation_length_px(self) -> float:
        """Distance along a row at which the errors' correlation falls to 1/e; outliers are clipped.

        Interpolated between ``LAGS_PX``; the last of them where it does not fall so far.
        """
        error = np.clip(self.error_px - np.nanmedian(self.error_px), -OUTLIER_PX, OUTLIER_PX)
        matched = np.isfinite(error)
        width = int(self.column.max()) + max(LAGS_PX) + 1
        at = self.line * width + self.column
        values = dict(zip(at[matched].tolist(), error[matched].tolist(), strict=True))
        spread = float(np.mean(error[matched] ** 2))
        if spread == 0:
            return 0.0
        before_px, before = 0.0, 1.0
        for lag in LAGS_PX:
            products = [value * values[place + lag] for place, value in values.items() if place + lag in values]
            correlation = float(np.mean(products)) / spread if products else 0.0
            if correlation <= np.exp(-1):
                share = (before - np.exp(-1)) / max(before - correlation, 1e-9)
                return float(before_px + share * (lag - before_px))
            before_px, before = float(lag), correlation
        return float(LAGS_PX[-1])

    @staticmethod
    def joined(parts: "list[DisparityErrors]") -> "DisparityErrors":
        """Of several recordings; rows stay apart."""
        first = np.cumsum([0] + [int(part.line.max()) + 1 for part in parts])
        lines = np.concatenate([part.line + start for part, start in zip(parts, first, strict=False)])
        error_px, textured, z_m, column = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("error_px", "textured", "z_m", "column")
        )
        return DisparityErrors(error_px, textured, z_m, lines, column)


def disparity_errors(dataset: Dataset, query_set: str) -> DisparityErrors:
    """Compare each query's depth with the nearest scans ahead of it and behind it.

    Args:
        dataset: with the baseline of its stereo rig, and a survey that drove the queries' way.
        query_set: with truth.

    Raises:
        ValueError: the dataset has no baseline, or no query lies between two scans.
    """
    sensor = dataset.description.sensors.cameras[0]
    if sensor.depth.baseline_m is None:
        raise ValueError(f"{dataset.folder}: depth.baseline_m is not given; import a stereo recording")
    focal_baseline, camera = sensor.fx * sensor.depth.baseline_m, sensor.pinhole()
    T_map_lidar = dataset.survey_poses()
    found: list[DisparityErrors] = []
    for frame in dataset.queries(query_set):
        between = _scans_between(frame, T_map_lidar)
        if between is None or frame.T_map_camera is None:
            continue
        T_camera_map = np.linalg.inv(frame.T_map_camera)
        ahead, behind = (
            _disparities(
                transform_points(T_camera_map @ T_map_lidar[k], dataset.scan(k)[:, :3].astype(float)),
                camera,
                focal_baseline,
            )
            for k in between
        )
        counted = _agreeing(ahead, behind)
        depth_m = frame.depth_m()[counted]
        with np.errstate(divide="ignore"):
            measured = np.where(depth_m > 0, focal_baseline / depth_m, np.nan)
        row, column = np.nonzero(counted)
        found.append(
            DisparityErrors(
                (measured - ahead[counted]).astype(float), (gradient_of(frame.rgb()) >= TEXTURED)[counted],
                focal_baseline / ahead[counted].astype(float), row, column,
            )
        )  # fmt: skip
    if not found:
        raise ValueError(f"{dataset.folder}: no query of {query_set!r} lies between two scans")
    return DisparityErrors.joined(found)


def gradient_of(rgb: UInt8[NDArray[np.uint8], "H W 3"]) -> Float32[NDArray[np.float32], "H W"]:
    """Mean size of the horizontal gradient around each pixel, grey values a pixel: what a matcher along rows can hold on to."""
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    steps = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)) / 8  # Sobel sums eight differences of one pixel
    return np.asarray(cv2.blur(steps, (PATCH_PX, PATCH_PX)), np.float32)


def _scans_between(frame: QueryFrame, T_map_lidar: NDArray[np.float64]) -> tuple[int, int] | None:
    """The nearest scan ahead of the camera and the nearest behind it."""
    if frame.T_map_camera is None:
        return None
    away = T_map_lidar[:, :3, 3] - frame.T_map_camera[:3, 3]
    along, distance = away @ frame.T_map_camera[:3, 2], np.linalg.norm(away, axis=1)
    ahead, behind = np.flatnonzero(along >= 0), np.flatnonzero(along < 0)
    if not len(ahead) or not len(behind):
        return None
    return int(ahead[distance[ahead].argmin()]), int(behind[distance[behind].argmin()])


def _disparities(
    points: NDArray[np.float64], camera: PinholeCamera, focal_baseline_px_m: float
) -> Float32[NDArray[np.float32], "H W"]:
    """Of the points that the camera sees, at their pixels; 0 elsewhere."""
    uv, z_m = visible_points(points, np.eye(4), camera)
    found = np.zeros((camera.height, camera.width), np.float32)
    column, row = np.rint(uv).astype(int).T
    found[row, column] = focal_baseline_px_m / z_m
    return found


def _agreeing(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels of the one near which all that the other has is the same, and it has something."""
    around = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    most = cv2.dilate(other, around)
    least = cv2.erode(np.where(other > 0, other, np.float32(np.inf)), around)
    agreeing: NDArray[np.bool_] = (
        (one > 0) & (most > 0) & (np.abs(one - most) < AGREE_PX) & (np.abs(one - least) < AGREE_PX)
    )
    return agreeing
