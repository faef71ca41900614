"""Errors of a depth camera that triangulates. They grow with the square of the distance.

The presets ``precise`` and ``stereo`` come from the feasibility study (November 2026), both at focal length x baseline = 80 px m.
Gross errors of stereo matching (bleeding edges, invented depth in sky, glass and blank walls, holes): Scharstein and
Szeliski, IJCV 47, 2002; Menze and Geiger, CVPR 2015.
"""

from dataclasses import dataclass
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.simulation.conditions import Condition
from service.registration.points import FOCAL_BASELINE_PX_M

Depth = NDArray[np.float32]

#: Depth of pixels without a surface while disparities are computed, metres.
BEYOND_M = 200.0


@dataclass(frozen=True, slots=True)
class DepthModel:
    """Parameters of a depth camera. Pixels refer to an image that is 640 pixels wide.

    Attributes:
        name: name of the preset.
        focal_baseline_px_m: focal length times baseline, pixels times metres.
        noise_px: standard deviation of the disparity noise, pixels.
        correlated: share of the noise variance that patches of 16 and 60 px have in common.
        step_px: quantisation step of the disparity, pixels; 0: none.
        offset_px: standard deviation of the disparity offset of a frame, pixels.
        scale_error: standard deviation of the relative scale error of a frame.
        bleeding: share of depth edges that take the depth of the foreground.
        hole_level: patches where a unit normal field exceeds this level have no depth.
        invented_frames: share of frames with invented depth in sky, glass and blank walls.
        min_range_m: smallest measured depth, metres.
        max_range_m: largest measured depth, metres.
    """

    name: str
    focal_baseline_px_m: float = FOCAL_BASELINE_PX_M
    noise_px: float = 0.1
    correlated: float = 0.5
    step_px: float = 1 / 16
    offset_px: float = 0.0
    scale_error: float = 0.003
    bleeding: float = 0.42
    hole_level: float = 2.3
    invented_frames: float = 0.0
    min_range_m: float = 0.4
    max_range_m: float = 40.0


#: Presets of modelled depth by name.
DEPTHS = {
    m.name: m
    for m in (
        DepthModel("ideal", noise_px=0.0, step_px=0.0, scale_error=0.0, bleeding=0.0, hole_level=99.0),
        DepthModel("precise"),
        DepthModel("stereo", noise_px=0.5, offset_px=0.05, scale_error=0.01, hole_level=1.9, invented_frames=0.3),
    )
}


def _field(rng: np.random.Generator, shape: tuple[int, int], patch: int, smooth: bool = True) -> Depth:
    """Draw a field of unit normal values that are correlated over ``patch`` pixels."""
    rows, columns = max(2, shape[0] // patch), max(2, shape[1] // patch)
    coarse = rng.standard_normal((rows, columns), dtype=np.float32)
    field = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC if smooth else cv2.INTER_LINEAR)
    return np.asarray(field, np.float32)


def measured_depth(
    clean_m: Depth, blank: NDArray[np.bool_], model: DepthModel, condition: Condition, rng: np.random.Generator
) -> Depth:
    """Return the depth (H, W) that the camera measures, z in metres; 0 where it measures nothing.

    Args:
        clean_m: true depth (H, W), z in metres; 0 where there is no surface.
        blank: pixels (H, W) without texture (glass, plain walls), where stereo may invent depth.
        model: depth camera.
        condition: weather and light.
        rng: random generator of the frame.
    """
    shape = clean_m.shape
    zoom = shape[1] / 640.0

    def patch(pixels: float) -> int:
        whole: int = max(1, round(pixels * zoom))
        return whole

    is_surface = clean_m > 0
    z = np.where(is_surface, clean_m, np.float32(BEYOND_M))
    if condition.extinction_per_m > 0:  # a contrast below 5 % gives no match (Koschmieder)
        is_surface &= np.exp(-condition.extinction_per_m * z) > 0.05
    size = 2 * patch(2) + 1
    near = cv2.erode(z, np.ones((size, size), np.uint8))
    edge = (z - near) > np.maximum(0.5, 0.08 * near)
    mixing = np.float32(0.3 * rng.random())
    bleed = edge & (_unit(_field(rng, shape, patch(12), smooth=False)) > _level_of(model.bleeding))
    z = np.where(bleed, near * (1 - mixing) + np.minimum(z, np.float32(60)) * mixing, z)
    measured = (is_surface | bleed) & (z < 150)
    noise = np.zeros(shape, np.float32)
    sigma = model.noise_px * condition.disparity_noise
    if sigma > 0:
        common = 0.65 * _unit(_field(rng, shape, patch(16))) + 0.35 * _unit(_field(rng, shape, patch(60)))
        own = rng.standard_normal(shape, dtype=np.float32)
        weight = model.correlated
        noise = _unit(common) * np.float32(weight**0.5) + own * np.float32((1 - weight) ** 0.5)
    offset = np.float32(model.offset_px * rng.standard_normal())
    disparity = (
        np.float32(model.focal_baseline_px_m) / np.maximum(z, np.float32(0.2)) + noise * np.float32(sigma) + offset
    )
    if model.step_px > 0:
        disparity = np.rint(disparity / np.float32(model.step_px)) * np.float32(model.step_px)
    seen = np.float32(model.focal_baseline_px_m) / np.maximum(disparity, np.float32(0.1))
    measured &= disparity > 0.2
    measured &= _field(rng, shape, patch(20)) < model.hole_level - 1.6 * condition.holes
    if model.bleeding > 0:
        measured &= ~(edge & ~bleed & (rng.random(shape, dtype=np.float32) < 0.5))
    if rng.random() < model.invented_frames:
        made_up = np.exp(0.3 * _field(rng, shape, max(2, shape[0] // 5))) * np.float32(20)
        region = _field(rng, shape, max(2, shape[0] // 7)) > 0.3
        invented = region & (~is_surface | (blank & (_field(rng, shape, patch(40)) > 0.8)))
        seen, measured = np.where(invented, made_up, seen), measured | invented
    seen = seen * np.float32(1 + model.scale_error * rng.standard_normal())
    measured &= (seen > model.min_range_m) & (seen < model.max_range_m)
    return np.where(measured, seen, np.float32(0)).astype(np.float32)


def _level_of(share: float) -> float:
    """Return the level that a unit normal field exceeds in a given share of its pixels."""
    return NormalDist().inv_cdf(1 - share) if share > 0 else float("inf")


def _unit(field: Depth) -> Depth:
    """Scale a field to a standard deviation of 1."""
    return field / np.float32(max(1e-6, float(field.std())))
