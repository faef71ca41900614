"""Measure the errors of stereo matching: compare disparities with the scans of a survey along the same path.

A point of the scan ahead counts if the scan behind has the same disparity there. This removes dynamic objects and points that only one
scan sees. The reference comes from sensors, not from a ground truth that only the simulator has. So real and simulated recordings are
measured in the same way.
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

#: Two scans agree at a pixel if their disparities differ by less than ``AGREE_PX``, for all points within ``REACH_PX`` along each axis.
AGREE_PX, REACH_PX = 0.5, 2
#: A pixel is textured if the mean absolute horizontal gradient (grey values per pixel) of its patch is at least ``TEXTURED``.
TEXTURED, PATCH_PX = 1.5, 9
#: An error larger than this is an outlier, as in KITTI's stereo benchmark (Menze and Geiger, CVPR 2015).
OUTLIER_PX = 3.0
#: Distances along a row for the correlation of errors, pixels.
LAGS_PX = (2, 4, 8, 12, 16, 24, 32, 48, 64)


@dataclass(frozen=True, slots=True)
class DisparityErrors:
    """The disparity errors of all points of a recording.

    Attributes:
        error_px: measured disparity minus disparity of the scan, pixels; NaN where nothing was matched (n,).
        textured: whether the image has texture at the point (n,).
        z_m: depth of the point in the scan, metres (n,).
        line: number of the image and its row. It only tells rows apart (n,).
        column: column in the image (n,).
    """

    error_px: NDArray[np.float64]
    textured: NDArray[np.bool_]
    z_m: NDArray[np.float64]
    line: NDArray[np.int64]
    column: NDArray[np.int64]

    def sizes(self, *, textured: bool) -> NDArray[np.float64]:
        """Return the absolute errors of the matched points, pixels (m,).

        Args:
            textured: select the points with texture, or those without.
        """
        error = self.error_px[(self.textured == textured) & np.isfinite(self.error_px)]
        sizes: NDArray[np.float64] = np.abs(error)
        return sizes

    def unmatched(self, *, textured: bool) -> float:
        """Return the share of points without a match.

        Args:
            textured: select the points with texture, or those without.
        """
        return float(np.isnan(self.error_px[self.textured == textured]).mean())

    def outliers(self, *, nearest_m: float, farthest_m: float) -> float:
        """Return the share of matched points whose error exceeds ``OUTLIER_PX``; NaN without matched points.

        Args:
            nearest_m: smallest depth of the points, metres, inclusive.
            farthest_m: largest depth, metres, exclusive.
        """
        error = self.error_px[(self.z_m >= nearest_m) & (self.z_m < farthest_m) & np.isfinite(self.error_px)]
        return float((np.abs(error) > OUTLIER_PX).mean()) if len(error) else float("nan")

    def correlation_length_px(self) -> float:
        """Return the distance along a row at which the correlation of the errors falls to 1/e, pixels.

        Outliers are clipped. The value is interpolated between ``LAGS_PX``. It is the last of them if the correlation stays above 1/e.
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
        """Join the errors of several images or recordings, and renumber their rows so that no two share a number.

        Args:
            parts: the errors to join, at least one.
        """
        first = np.cumsum([0] + [int(part.line.max()) + 1 for part in parts])
        lines = np.concatenate([part.line + start for part, start in zip(parts, first, strict=False)])
        error_px, textured, z_m, column = (
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("error_px", "textured", "z_m", "column")
        )
        return DisparityErrors(error_px, textured, z_m, lines, column)


def disparity_errors(dataset: Dataset, query_set: str) -> DisparityErrors:
    """Compare the depth of each query with the nearest scan ahead of it and the nearest behind it.

    Args:
        dataset: a dataset with the baseline of its stereo rig and a survey along the path of the queries.
        query_set: name of a query set with ground truth.

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
                (measured - ahead[counted]).astype(float),
                (gradient_of(frame.rgb()) >= TEXTURED)[counted],
                focal_baseline / ahead[counted].astype(float),
                row,
                column,
            )
        )
    if not found:
        raise ValueError(f"{dataset.folder}: no query of {query_set!r} lies between two scans")
    return DisparityErrors.joined(found)


def gradient_of(rgb: UInt8[NDArray[np.uint8], "H W 3"]) -> Float32[NDArray[np.float32], "H W"]:
    """Return the mean absolute horizontal gradient around each pixel, grey values per pixel: the texture that a matcher along rows uses.

    Args:
        rgb: the image.
    """
    grey = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), 1.0)
    steps = np.abs(cv2.Sobel(grey, cv2.CV_32F, 1, 0)) / 8  # Sobel sums eight differences of one pixel
    return np.asarray(cv2.blur(steps, (PATCH_PX, PATCH_PX)), np.float32)


def _scans_between(frame: QueryFrame, T_map_lidar: NDArray[np.float64]) -> tuple[int, int] | None:
    """Return the indices of the nearest scan ahead of the camera and the nearest behind it; None if one is missing."""
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
    """Return an image with the disparity of each visible point at its pixel, 0 elsewhere."""
    uv, z_m = visible_points(points, np.eye(4), camera)
    found = np.zeros((camera.height, camera.width), np.float32)
    column, row = np.rint(uv).astype(int).T
    found[row, column] = focal_baseline_px_m / z_m
    return found


def _agreeing(one: NDArray[np.float32], other: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels of ``one`` near which ``other`` has points, and all of them agree with it."""
    around = np.ones((2 * REACH_PX + 1, 2 * REACH_PX + 1), np.uint8)
    most = cv2.dilate(other, around)
    least = cv2.erode(np.where(other > 0, other, np.float32(np.inf)), around)
    agreeing: NDArray[np.bool_] = (
        (one > 0) & (most > 0) & (np.abs(one - most) < AGREE_PX) & (np.abs(one - least) < AGREE_PX)
    )
    return agreeing
