"""Call every C function with random inputs, ordinary and extreme, and print a hash of each result.

``python_in`` runs this module in an unpacked wheel. Under sanitizers a bad access ends in a report. The lines of two
compilers' builds must be equal. All NaN values compare equal, because no standard fixes their bit pattern.

Example: python -m benchmarks.native.inputs --rounds 40
"""

import argparse
import ctypes
import hashlib
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.errors import StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_x, rotation_y, rotation_z, transform_from
from service.imaging import depth16
from service.imaging.level import level_camera
from service.imaging.resample import resample
from service.imaging.view_grid import ViewGrid, fan_planes, panorama_from_points
from service.registration.kernel import (
    STATE,
    SURFEL,
    BeamModel,
    QueryPoints,
    SolverOptions,
    align,
    consistency,
    gradients,
    render,
)
from service.registration.points import PointSettings, blocks_of, inverse_depth_noise, points_of
from service.registration.rays import RayPicture, RaySettings, adjust
from service.registration.register import Registered
from service.registration.surfel_map import SurfelMap
from service.registration.visibility import SurfelRaycaster

Floats = NDArray[np.float64]

#: Height and width of images, pixels: one pixel, one row, one column, flat, two sizes that no block size divides, and a
#: usual one.
SIZES = ((1, 1), (1, 7), (7, 1), (16, 2560), (48, 64), (61, 33), (240, 320))


def camera_of(rng: np.random.Generator, height: int, width: int) -> PinholeCamera:
    """Make a camera with a field of view from very narrow to very wide; its centre may lie outside the image.

    Args:
        rng: source of randomness.
        height: height of the image, pixels.
        width: width of the image, pixels.
    """
    focal = width * float(np.exp(rng.uniform(-2.5, 2.5)))
    at = rng.uniform(-0.5, 1.5, 2) if rng.random() < 0.2 else rng.uniform(0.4, 0.6, 2)
    return PinholeCamera(width, height, focal, focal * rng.uniform(0.8, 1.25), at[0] * width, at[1] * height)


def depth_of(rng: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """Make a depth image (height, width) in metres with gaps, and at times with NaN, infinite, negative, huge or tiny values.

    Args:
        rng: source of randomness.
        height: height of the image, pixels.
        width: width of the image, pixels.
    """
    depth = rng.uniform(0.3, 45.0, (height, width)).astype(np.float32)
    if rng.random() < 0.5:  # smooth, like surfaces
        depth = np.linspace(1, rng.uniform(2, 40), width, dtype=np.float32)[None] + 0.01 * depth
        depth = np.array(np.broadcast_to(depth, (height, width)))
    depth[rng.random((height, width)) < rng.choice([0.0, 0.3, 1.0], p=[0.5, 0.4, 0.1])] = 0
    if rng.random() < 0.4:
        for value in (np.nan, np.inf, -np.inf, -1.0, 1e38, 1e-38):
            depth[rng.random((height, width)) < 0.03] = value
    return depth


def rotation_of(rng: np.random.Generator) -> Floats:
    """Make an arbitrary rotation (3, 3).

    Args:
        rng: source of randomness.
    """
    a, b, c = rng.uniform(-np.pi, np.pi, 3)
    return np.asarray(rotation_z(a) @ rotation_y(b) @ rotation_x(c))


def street(rng: np.random.Generator) -> SurfelMap:
    """Make a map of a ground, two house fronts and a wall across, with a few thousand surfels; sometimes with one.

    Args:
        rng: source of randomness.
    """
    x, y, z = np.arange(-30, 30, 0.5), np.arange(-6, 6, 0.5), np.arange(0, 8, 0.5)
    parts = [
        (np.stack([g.ravel() for g in np.meshgrid(x, y, [0.0])], 1), (0, 0, 1)),
        (np.stack([g.ravel() for g in np.meshgrid(x, [-6.0], z)], 1), (0, 1, 0)),
        (np.stack([g.ravel() for g in np.meshgrid(x, [6.0], z)], 1), (0, -1, 0)),
        (np.stack([g.ravel() for g in np.meshgrid([25.0], y, z)], 1), (-1, 0, 0)),
    ]
    surfels = np.zeros(sum(len(points) for points, _ in parts), SURFEL)
    surfels["xyz"] = np.concatenate([points for points, _ in parts]) + rng.normal(0, 0.03, (len(surfels), 3))
    normals = np.concatenate([np.tile(normal, (len(points), 1)) for points, normal in parts]) + rng.normal(
        0, 0.05, (len(surfels), 3)
    )
    surfels["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    surfels["thickness_m"], surfels["points"] = rng.uniform(0, 0.1, len(surfels)), 5
    if rng.random() < 0.1:
        surfels = surfels[:1].copy()
    return SurfelMap.prepare(np.array([500.0, -300.0, 40.0]), surfels)


def points_for(rng: np.random.Generator) -> QueryPoints:
    """Make any number of query points, including none; some are NaN, infinite or far away.

    Args:
        rng: source of randomness.
    """
    count = int(rng.choice([0, 1, 31, 32, 33, 500]))
    xyz = rng.uniform(-25, 25, (count, 3)).astype(np.float32)
    if rng.random() < 0.4 and count:
        xyz[rng.random(count) < 0.1] = rng.choice([np.nan, np.inf, 1e30, -1e12])
    with np.errstate(all="ignore"):
        ray = xyz / np.linalg.norm(xyz, axis=1, keepdims=True)
    sigma, weight, q = rng.uniform(0, 2, count), rng.uniform(0, 1, count), rng.uniform(0, 0.5, count)
    return QueryPoints(xyz, ray, *(each.astype(np.float32) for each in (sigma, weight, q)))


def states_for(rng: np.random.Generator) -> NDArray[Any]:
    """Make solver states (n,) near and far; some are invalid poses.

    Args:
        rng: source of randomness.
    """
    states = np.zeros(int(rng.integers(0, 4)), STATE)
    for state in states:
        state["R"], state["t"] = rotation_z(rng.uniform(-np.pi, np.pi)), rng.uniform(-20, 20, 3)
        state["anchor"], state["up"] = state["t"], (0, 0, 1)
        if rng.random() < 0.2:
            state[rng.choice(["R", "t", "anchor", "up"])].flat[0] = rng.choice([np.nan, np.inf, 1e300])
        state["offset"] = rng.choice([0.0, 0.3, -2.0, np.nan], p=[0.4, 0.3, 0.2, 0.1])
        state["log_scale"] = rng.choice([0.0, 0.02, 800.0], p=[0.5, 0.4, 0.1])
    return states


OPTIONS = SolverOptions(iterations=6, reach=1.0, robust_first=1.0, robust_last=0.1, free_offset=True)
BEAM = BeamModel(
    hit=0.7,
    new=0.1,
    removed=0.1,
    outlier=0.1,
    roughness_m=0.1,
    span_m=40.0,
    threshold_sigmas=2.0,
    margin_m=0.3,
    unmapped_m=60.0,
)
#: Largest size of random data for the codecs, bytes.
LARGE = 400


def _resample(rng: np.random.Generator, height: int, width: int) -> list[NDArray[Any]]:
    rgb = rng.integers(0, 256, (height, width, 3), np.uint8)
    scale = int(rng.integers(1, 4))
    depth = depth_of(rng, height * scale, width * scale) if rng.random() < 0.3 else depth_of(rng, height, width)
    R = rotation_of(rng) if rng.random() < 0.5 else R_BODY_OPTICAL.T @ rotation_z(rng.uniform(-0.5, 0.5))
    observed = rng.random(depth.shape) < 0.8 if rng.random() < 0.3 else None
    return list(resample(rgb, depth, camera_of(rng, height, width), R, ViewGrid(), observed))


def _level(rng: np.random.Generator, height: int, width: int) -> list[NDArray[Any]]:
    down = rng.normal(size=3) if rng.random() < 0.5 else None
    level = level_camera(
        depth_of(rng, height, width),
        camera_of(rng, height, width),
        down_camera=down,
        nominal_height_m=rng.uniform(0.2, 3.0),
    )
    return [level.R_level_camera, np.array(level.height_m)]


def _points(rng: np.random.Generator, height: int, width: int) -> list[NDArray[Any]]:
    depth, camera = depth_of(rng, height, width), camera_of(rng, height, width)
    noise = inverse_depth_noise(depth).total
    settings = PointSettings(columns=int(rng.choice([1, 8, 128, 5000])))
    blocks = blocks_of(depth, camera, settings, noise=noise)
    points = points_of(depth, camera, R_BODY_OPTICAL, 1.5, PointSettings())
    return [np.array(noise), blocks.z_m, points.xyz, points.sigma, points.weight]


def _views(rng: np.random.Generator) -> list[NDArray[Any]]:
    grid = ViewGrid(rows=int(rng.choice([1, 2, 5, 32])), columns=int(rng.choice([1, 3, 128])))
    count = int(rng.choice([0, 1, 50, 20000]))
    points = rng.normal(0, [20, 20, 2, 1], (count, 4)).astype(np.float32)
    if rng.random() < 0.3 and count:
        points[rng.integers(count), 3] = rng.choice([np.nan, np.inf, -1e30, 1e30])
    panorama = panorama_from_points(points, grid)
    rows_seen = rng.random(grid.rows) < 0.9
    headings = rng.uniform(-10, 10, int(rng.choice([0, 1, 24])))
    return [panorama, fan_planes(panorama, headings, sensor_height_m=1.5, rows_seen=rows_seen, grid=grid)]


def _align(rng: np.random.Generator, cloud: SurfelMap) -> list[NDArray[Any]]:
    points, states = points_for(rng), states_for(rng)
    align(cloud.pieces, points, states, OPTIONS, tolerance_m=0.2)
    found = [states[name] for name in states.dtype.names or ()]
    for state in states[:1]:
        patch = (np.arange(len(points)) // 7).astype(np.int32)
        found.append(gradients(cloud.pieces, points, states[:1], OPTIONS, patch))
        del state
    grid = cloud.grid
    return [*found, cloud.surfels, grid.slots, grid.regions, grid.blocks, grid.cells, grid.others]


def _render(rng: np.random.Generator, cloud: SurfelMap, height: int, width: int) -> list[NDArray[Any]]:
    height, width = min(height, 96), min(width, 128)
    camera = camera_of(rng, height, width)
    T = transform_from(rotation_of(rng) @ R_BODY_OPTICAL, rng.uniform(-20, 20, 3))
    drawn = render(
        cloud.pieces,
        T_map_camera=T,
        camera=camera,
        size_m=rng.uniform(0.05, 2),
        reach_m=40.0,
    )
    count = int(rng.integers(1, 300))
    pixel = rng.integers(0, drawn.size, count).astype(np.int32)
    z, sigma = rng.uniform(0.1, 60, count), rng.uniform(1e-3, 2, count)
    if rng.random() < 0.2:
        z[0] = rng.choice([np.nan, np.inf])
    told = consistency(
        drawn, pixel, z, sigma, rng.uniform(0, 0.3, count).astype(np.float32), BEAM, scale=1.01, offset=0.1
    )
    return [drawn, np.array(told)]


def _rays(rng: np.random.Generator, cloud: SurfelMap, height: int, width: int) -> list[NDArray[Any]]:
    height, width = min(height, 96), min(width, 128)
    camera = camera_of(rng, height, width)
    settings = RaySettings(fewest=1, patch=int(rng.choice([1, 6, 16])))
    raycaster = SurfelRaycaster(cloud, settings)
    R, t = rotation_z(rng.uniform(-np.pi, np.pi)), np.r_[rng.uniform(-20, 20), rng.uniform(-5, 5), 1.5]
    T_level_camera = transform_from(R_BODY_OPTICAL, np.zeros(3))
    hits = raycaster.intersect(transform_from(R, t) @ T_level_camera, camera)
    with np.errstate(all="ignore"):
        inverse = np.where((depth := depth_of(rng, height, width)) > 0, 1 / depth, 0).astype(np.float32)
    picture = RayPicture(
        inverse, camera, T_level_camera, 1e-3, (None, 80.0)[rng.integers(2)], rng.random((height, width)) < 0.3
    )
    found = Registered(R, cloud.origin_m + t, 1.0, 0.0, 0.9, np.eye(8), 0)
    adjusted = adjust(raycaster, [picture], found, settings)
    if adjusted is None:
        return [hits]
    pose, scatter = adjusted
    return [hits, pose.R_map_level, pose.camera_m, np.array([pose.scale, pose.offset]), pose.information, scatter]


def _codecs(rng: np.random.Generator, height: int, width: int) -> list[NDArray[Any]]:
    """Decode rows of random filters and data; only the codec's own bounds protect it."""
    height, width = min(height, 64), min(width, 64)
    rows = rng.integers(0, 256, (height, 1 + 2 * width), np.uint8)
    rows[:, 0] = rng.integers(0, 6 if rng.random() < 0.3 else 5, height)
    raw, out = rows.tobytes(), np.zeros((height, width), np.uint16)
    buffer = (ctypes.c_char * len(raw)).from_buffer_copy(raw)
    done = depth16.library().streetfix_unfilter(buffer, height, width, out.ctypes.data)
    packed = rng.integers(0, 256, int(rng.integers(0, LARGE)), np.uint8)
    if rng.random() < 0.7:  # small numbers, so that the codec reads more than a few pixels
        packed &= 0x77
    data, pixels = packed.tobytes(), np.zeros((height, width), np.uint16)
    given = (ctypes.c_char * len(data)).from_buffer_copy(data) if data else None
    read = depth16.library().streetfix_rvl(given, len(data), pixels.size, pixels.ctypes.data)
    return [np.array([done, read]), out[:done], pixels]


def digest(arrays: list[NDArray[Any]]) -> str:
    """Hash shapes, types and bits of arrays; every NaN counts as the same.

    Args:
        arrays: arrays of any shape.
    """
    told = hashlib.sha256()
    for array in arrays:
        array = np.ascontiguousarray(array)
        if array.dtype.kind == "f":
            array = np.where(np.isnan(array), np.array(np.nan, array.dtype), array)
        told.update(f"{array.shape} {array.dtype}".encode() + array.tobytes())
    return told.hexdigest()[:16]


def rounds(seed: int, count: int) -> None:
    """Call every function in each round with one image size, and print the hash of each result.

    Args:
        seed: seed of the inputs.
        count: number of rounds.
    """
    np.seterr(all="ignore")  # some inputs are meaningless on purpose
    rng = np.random.default_rng(seed)
    for number in range(count):
        cloud = street(rng)
        height, width = SIZES[number % len(SIZES)]
        cases: dict[str, Callable[[], list[NDArray[Any]]]] = {
            "resample": partial(_resample, rng, height, width),
            "level": partial(_level, rng, height, width),
            "views": partial(_views, rng),
            "points": partial(_points, rng, height, width),
            "align": partial(_align, rng, cloud),
            "render": partial(_render, rng, cloud, height, width),
            "rays": partial(_rays, rng, cloud, height, width),
            "codecs": partial(_codecs, rng, height, width),
        }
        for name, case in cases.items():
            try:
                told = digest(case())
            except (StreetfixError, np.linalg.LinAlgError) as error:  # the inputs were refused, or too few to solve
                told = f"refused: {type(error).__name__} {error}"
            print(number, name, f"{height}x{width}", told, flush=True)


def main() -> None:
    """Parse the arguments and run the rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40, help="inputs for each function")
    parser.add_argument("--seed", type=int, default=0, help="seed of the inputs")
    arguments = parser.parse_args()
    rounds(arguments.seed, arguments.rounds)


if __name__ == "__main__":
    main()
