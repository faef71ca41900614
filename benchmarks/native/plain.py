"""The compiled functions in NumPy, vectorised, to compare results and processor time with the C code."""

import numpy as np
from numpy.typing import NDArray

from service.geometry.camera import PinholeCamera
from service.geometry.rigid import Rotation, Transform
from service.imaging import level
from service.imaging.resample import FEWEST_SAMPLES, _sub_rays
from service.imaging.view_grid import ViewGrid
from service.registration.kernel import BLOCK, KEY_BITS, NUMBER_BITS, REGION, NearestGrid, QueryPoints, SolverOptions
from service.registration.points import LEAST_NOISE, NOISE_ROWS, NOISE_STEPS, PointSettings
from service.registration.rays import RayPicture, RaySettings
from service.registration.visibility import DiscSettings

Floats = NDArray[np.float64]


def fit_ground(
    depth_m: NDArray[np.float32], camera: PinholeCamera, R: Rotation, height_m: float, height_std_m: float
) -> list[float]:
    """Fit the ground as ``level._fit_ground`` does.

    Args:
        depth_m: depth z (H, W), metres, 0 where nothing was measured.
        camera: intrinsics.
        R: rotation from the optical frame to the nominal level frame.
        height_m: height of the camera, mean of its prior.
        height_std_m: standard deviation of this prior.

    Returns:
        Slopes, offset (m), and the numbers of measured pixels, of those on the plane and of those below it.
    """
    own = camera.scaled_to(depth_m.shape[1], depth_m.shape[0])
    step = max(1, depth_m.shape[1] // level.STEP_PIXELS)
    v, u = (
        each.reshape(-1) for each in np.mgrid[step // 2 : depth_m.shape[0] : step, step // 2 : depth_m.shape[1] : step]
    )
    z = depth_m[v, u].astype(np.float64)
    measured = (z > level.NEAR_M) & (z < level.REACH_M)
    rays = np.stack([(u - own.cx) / own.fx, (v - own.cy) / own.fy, np.ones(len(u))], axis=1)
    points = (z[measured, None] * rays[measured]) @ R.T
    prior = np.diag([1 / level.TILT_PRIOR_RAD**2, 1 / level.TILT_PRIOR_RAD**2, 1 / height_std_m**2])
    mean = solution = np.array([0.0, 0.0, -height_m])
    near = points[points[:, 2] < -0.3 * height_m]
    design, z = np.column_stack([near[:, :2], np.ones(len(near))]), near[:, 2]
    reach = np.hypot(near[:, 0], near[:, 1])
    certainty = 1.0 / ((level.NOISE_M + level.NOISE_PER_M * reach) ** 2 * level.CORRELATED)
    for band_m, band_slope, above in level.BANDS:
        off, band = z - design @ solution, band_m + band_slope * reach
        keep = (off > -band) & (off < above * band)
        if not keep.any():
            break
        weighted = design * np.where(keep, certainty, 0.0)[:, None]
        solution = np.linalg.solve(weighted.T @ design + prior, weighted.T @ z + prior @ mean)
    off, band = z - design @ solution, level.BANDS[-1, 0] + level.BANDS[-1, 1] * reach
    return [*solution.tolist(), int(measured.sum()), int((np.abs(off) <= band).sum()), int((off < -3 * band).sum())]


def resampled(
    rgb: NDArray[np.uint8],
    depth_m: NDArray[np.float32],
    camera: PinholeCamera,
    R: Rotation,
    grid: ViewGrid,
    observed: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Resample both images to a view grid as ``resample.resample`` does.

    Args:
        rgb: image (H, W, 3).
        depth_m: depth z (h, w), metres, 0 where nothing was measured.
        camera: intrinsics.
        R: rotation from the level frame of the view to the optical frame.
        grid: view grid.
        observed: pixels of the depth image that the sensor could see (h, w); None: all.

    Returns:
        Range (rows, columns), colour (rows, columns, 3), and whether a ray of the cell hits the depth image.
    """
    x, y, z = np.einsum("ij,sjc->isc", R, _sub_rays(grid).astype(np.float64))

    def pixels(height: int, width: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
        own = camera.scaled_to(width, height)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = np.rint(x / z * own.fx + own.cx), np.rint(y / z * own.fy + own.cy)
        inside = (z > 1e-3) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        return np.where(inside, v, 0).astype(np.intp), np.where(inside, u, 0).astype(np.intp), inside

    row, column, seen = pixels(*depth_m.shape)
    unseen = np.zeros_like(seen) if observed is None else seen & ~observed[row, column]
    seen &= ~unseen
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = depth_m[row, column] / z
    valid = seen & (ranges >= grid.min_range_m) & (ranges <= grid.max_range_m)
    count = valid.sum(axis=0)
    ranked = np.sort(np.where(valid, ranges, np.inf), axis=0)
    median = np.take_along_axis(ranked, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    row, column, hit = pixels(*rgb.shape[:2])
    hit &= ~unseen
    colour = (rgb[row, column] * hit[..., None]).sum(axis=0) / np.maximum(hit.sum(axis=0), 1)[:, None]
    shape = (grid.rows, grid.columns)
    found = np.where(count >= FEWEST_SAMPLES, median, 0).astype(np.float32).reshape(shape)
    return found, colour.astype(np.float32).reshape(*shape, 3), seen.any(axis=0).reshape(shape)


def blocks(depth_m: NDArray[np.float32], settings: PointSettings, noise: float) -> NDArray[np.float32]:
    """Thin a depth image to blocks as ``points.blocks_of`` does; return their depth, metres, 0 for none.

    Args:
        depth_m: depth z (H, W), metres, 0 where nothing was measured.
        settings: of the blocks and their edges.
        noise: standard deviation of one pixel's inverse depth, 1/m.
    """
    size = max(1, depth_m.shape[1] // settings.columns)
    rows, columns, skip = depth_m.shape[0] // size, depth_m.shape[1] // size, max(1, size // 4)
    whole = depth_m[: rows * size, : columns * size].reshape(rows, size, columns, size)[:, ::skip, :, ::skip]
    block = whole.transpose(0, 2, 1, 3).reshape(rows * columns, -1)
    with np.errstate(divide="ignore"):
        inverse = np.sort(np.where(block > 0, 1 / block, np.float32(np.inf)), axis=1)
    count, each = np.isfinite(inverse).sum(axis=1), np.arange(rows * columns)
    last = np.maximum(count - 1, 0)
    low, high = inverse[each, (0.1 * last).astype(int)], inverse[each, (0.9 * last).astype(int)]
    middle = (inverse[each, last // 2] + inverse[each, np.maximum(count, 1) // 2]) / 2
    enough = count >= max(1, (block.shape[1] + 1) // 2)
    with np.errstate(invalid="ignore"):
        kept = enough & (high - low - 2.56 * noise < settings.edge * middle) & (1 / middle < settings.reach_m)
    return np.where(kept, 1 / middle, 0).astype(np.float32).reshape(rows, columns)


def noise_of(depth_m: NDArray[np.float32]) -> float:
    """Estimate the total noise of a depth image, 1/m, as ``points.inverse_depth_noise`` does without a rig.

    Args:
        depth_m: depth z (H, W), metres, 0 where nothing was measured.
    """
    with np.errstate(divide="ignore"):
        inverse = np.where(depth_m > 0, 1 / depth_m, np.float32(np.nan))[::NOISE_ROWS]
    seconds = (np.abs(inverse[:, : -2 * k] - 2 * inverse[:, k:-k] + inverse[:, 2 * k :]) for k in NOISE_STEPS)
    medians = [float(np.median(second[~np.isnan(second)])) for second in seconds]
    return max(1.4826 * max(medians) / 6**0.5, LEAST_NOISE)


def surfels_of_cells(grid: NearestGrid, cells: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the surfel of each cell of a lookup grid as ``kernel.surfels_at`` does; -1 for none.

    Args:
        grid: lookup grid of the map, with at least one region.
        cells: numbers of the cells along x, y and z, (..., 3).
    """
    region, block, cell = cells // (REGION * BLOCK), cells // BLOCK % REGION, cells % BLOCK
    inside = ((region >= 0) & (region < 1 << KEY_BITS)).all(axis=-1)
    key = np.where(inside, region @ [1 << 2 * KEY_BITS, 1 << KEY_BITS, 1], 0)
    at = np.minimum(np.searchsorted(grid.regions["key"], key), len(grid.regions) - 1)
    number = np.where(inside, block @ [REGION * REGION, REGION, 1], 0)
    word, bit = grid.regions["has"][at, number // 64], (number % 64).astype(np.uint64)
    inside &= (grid.regions["key"][at] == key) & (word >> bit & np.uint64(1) > 0)
    row = grid.regions["before"][at, number // 64] + np.bitwise_count(word & ((np.uint64(1) << bit) - np.uint64(1)))
    found = grid.blocks[np.where(inside, grid.regions["block"][at] + row, 0)]
    part = np.asarray(cell // 4 @ [4, 2, 1], np.int64)[..., None]
    bit = (cell % 4 @ [16, 4, 1]).astype(np.uint64)
    filled = np.take_along_axis(found["filled"], part, axis=-1)[..., 0]
    inside &= (filled >> bit & np.uint64(1)) > 0
    shift = (NUMBER_BITS * np.maximum(part[..., 0] - 1, 0)).astype(np.uint64)
    before = np.where(part[..., 0] > 0, found["before"] >> shift & np.uint64((1 << NUMBER_BITS) - 1), np.uint64(0))
    entry = before.astype(np.int64) + np.bitwise_count(filled & ((np.uint64(1) << bit) - np.uint64(1)))
    first = grid.regions["cells"][at] + found["first"]
    own, start = found["own"] & 255, found["own"] >> 8
    read = np.append(grid.cells, np.uint8(0)).astype(np.int64)

    def byte(at_byte: NDArray[np.int64], where: NDArray[np.bool_]) -> NDArray[np.int64]:
        return read[np.where(inside & where, at_byte, 0)]

    wide = found["before"] >> np.uint64(63) > 0
    narrow = byte(first + entry, ~wide)
    is_own = ~wide & (narrow < own)
    listed = first - 2 * (narrow - own + 1)
    foreign = byte(listed, ~wide & ~is_own) + (byte(listed + 1, ~wide & ~is_own) << 8)
    three = sum(byte(first + 3 * entry + k, wide) << 8 * k for k in range(3))
    number = np.where(wide, three, np.where(is_own, start + narrow, foreign))
    surfel, other, owned = (grid.regions[name].astype(np.int64)[at] for name in ("surfel", "other", "surfels"))
    others = np.append(grid.others, np.int32(0))[np.where(inside & (number >= owned), other + number - owned, 0)]
    return np.asarray(np.where(inside, np.where(number < owned, surfel + number, others), -1))


def information(
    grid: NearestGrid, surfels: NDArray[np.void], points: QueryPoints, states: NDArray[np.void], options: SolverOptions
) -> tuple[Floats, Floats]:
    """Sum the normal equations of a Gauss-Newton step as ``kernel.align`` does in its last iteration, for all starts at once.

    Args:
        grid: lookup grid of the map.
        surfels: of the map, (S,) of ``PACKED_SURFEL``.
        points: points of the query.
        states: starts, (n,) of ``STATE``.
        options: of the solver; the robust kernel has its last width.

    Returns:
        Matrices (n, 8, 8) and right sides (n, 8), both without priors.
    """
    f64 = np.float64
    R, scale = states["R"], np.exp(states["log_scale"])
    stretch = scale[:, None] / (1 + states["offset"][:, None] * points.q)
    y = (stretch[..., None] * points.xyz) @ R.transpose(0, 2, 1)
    at = y + states["t"][:, None]
    cell = np.floor((at - grid.origin_m) / grid.cell_m).astype(np.int64)
    found = surfels_of_cells(grid, cell)
    use = found >= 0
    near = grid.unpacked(surfels, np.maximum(found, 0).ravel()).reshape(found.shape)
    normal, off = near["normal"].astype(f64), at - near["xyz"]
    use &= (off**2).sum(axis=2) <= options.reach**2
    r, along_y = (normal * off).sum(axis=2), (normal * y).sum(axis=2)
    facing = (normal * (points.ray @ R.transpose(0, 2, 1))).sum(axis=2)
    J = np.concatenate(
        [normal, np.cross(y, normal), along_y[..., None], (-along_y * points.q * stretch / scale[:, None])[..., None]],
        axis=2,
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(along_y != 0, 1 - r / along_y, 1).clip(0.5, 2)
    along2, rest = (points.sigma * facing) ** 2, options.surface**2 + near["thickness_m"].astype(f64) ** 2
    k2 = 4 * (along2 * ratio**2 + rest) + options.robust_last**2
    w = np.where(use, points.weight * (k2 / (k2 + r * r)) ** 2 / (along2 * ratio**3 + rest), 0)
    weighted = (J * w[..., None]).transpose(0, 2, 1)
    return weighted @ J, -(weighted @ r[..., None])[..., 0]


def intersect(
    surfels: NDArray[np.void], numbers: NDArray[np.int32], T: Transform, camera: PinholeCamera, settings: DiscSettings
) -> NDArray[np.int32]:
    """Cast the rays of a small image on discs as ``SurfelRaycaster.intersect`` does; return indices (H, W), -1 for none.

    Every pair of a disc and a pixel of its window is computed at once.

    Args:
        surfels: surfels that may be seen, (S,) of ``SURFEL``.
        numbers: their indices in the map (S,).
        T: T_map_camera, surfels' frame.
        camera: intrinsics of the small image.
        settings: of the discs.
    """
    x, normal = (surfels["xyz"] - T[:3, 3]) @ T[:3, :3], surfels["normal"].astype(np.float64) @ T[:3, :3]
    off = (normal * x).sum(axis=1)
    seen = (x[:, 2] >= settings.nearest_m) & (x[:, 2] <= settings.reach_m)
    seen &= np.abs(off) >= settings.grazing * np.linalg.norm(x, axis=1)
    x, normal, off, numbers = x[seen], normal[seen], off[seen], numbers[seen]
    depths = np.stack([np.maximum(x[:, 2] - settings.radius_m, 0.05), x[:, 2] + settings.radius_m])
    windows = []
    for axis, focal, centre, side in (
        (0, camera.fx, camera.cx, camera.width),
        (1, camera.fy, camera.cy, camera.height),
    ):
        edges = np.concatenate([(x[:, axis] - settings.radius_m) / depths, (x[:, axis] + settings.radius_m) / depths])
        first = np.ceil(edges.min(axis=0) * focal + centre).clip(0, side).astype(int)
        last = np.floor(edges.max(axis=0) * focal + centre).clip(-1, side - 1).astype(int)
        windows += [first, np.maximum(last - first + 1, 0)]
    left, across, top, down = windows
    count = across * down
    disc = np.repeat(np.arange(len(x)), count)
    k = np.arange(len(disc)) - np.repeat(np.cumsum(count) - count, count)
    u, v = left[disc] + k % across[disc], top[disc] + k // across[disc]
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = off[disc] / (normal[disc] * ray).sum(axis=1)
        apart2 = ((ray * z[:, None] - x[disc]) ** 2).sum(axis=1)
    hit = apart2 <= settings.radius_m**2
    pixel, z, apart2, disc = (v * camera.width + u)[hit], z[hit], apart2[hit], disc[hit]
    first = np.full(camera.width * camera.height, np.inf)
    np.minimum.at(first, pixel, z)
    among = z <= first[pixel] + settings.same_surface_m
    pixel, apart2, disc = pixel[among], apart2[among], disc[among]
    order = np.lexsort((apart2, pixel))
    at, rank = np.unique(pixel[order], return_index=True)
    surfel_of = np.full(len(first), -1, np.int32)
    surfel_of[at] = numbers[disc[order[rank]]]
    return surfel_of.reshape(camera.height, camera.width)


def normal_equations(
    surfels: NDArray[np.void], picture: RayPicture, surfel_of: NDArray[np.int32], T: Transform, settings: RaySettings
) -> Floats:
    """Sum the normal equations (8, 8) of an image's inverse depths as ``streetfix_normal_equations`` does, at scale 1 and offset 0.

    Args:
        surfels: the surfel of each pixel, (H, W) of ``SURFEL``; any where ``surfel_of`` is -1.
        picture: image of inverse depths; its camera is the centre of rotation.
        surfel_of: index of the surfel in each pixel, -1 for none.
        T: T_map_camera, surfels' frame.
        settings: of the adjustment.
    """
    camera, unit = picture.camera, 0.0 if picture.focal_baseline_px_m is None else 1 / picture.focal_baseline_px_m
    down, across = (-(-side // settings.patch) for side in (camera.height, camera.width))
    v, u = np.nonzero((surfel_of >= 0) & (picture.inverse > 0))
    inverse, near = picture.inverse[v, u].astype(np.float64), surfels[v, u]
    ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))], axis=1) @ T[:3, :3].T
    normal = near["normal"].astype(np.float64)
    along, off = (normal * ray).sum(axis=1), (normal * (near["xyz"] - T[:3, 3])).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = off / along
        use = (np.abs(along) >= settings.grazing) & (z >= settings.nearest_m) & (z <= settings.reach_m)
    u, v, inverse, ray, normal, z, along = (each[use] for each in (u, v, inverse, ray, normal, z, along))
    k = (1 / z**2 / along)[:, None]
    r = inverse - 1 / z
    ones = np.ones((len(z), 1))
    J = np.concatenate([k * normal, k * np.cross(z[:, None] * ray, normal), 1 / z[:, None], -unit * ones, ones], axis=1)
    variance = picture.noise**2 + (settings.surface_m / z**2) ** 2
    k2 = settings.robust**2 * variance
    w = (k2 / (k2 + r * r)) ** 2 / variance
    patch, count = v // settings.patch * across + u // settings.patch, down * across
    own = np.stack([np.bincount(patch, w * column, count) for column in J.T], axis=1)
    pixels = np.maximum(np.bincount(patch, minlength=count), 1)
    moved = np.bincount(patch, picture.movable[v, u] * inverse**4, count) / pixels
    common = (settings.shared * picture.noise) ** 2 + settings.moved_m**2 * moved
    share = 1 / (own[:, 8] + 1 / common)
    H: Floats = J[:, :8].T @ (w[:, None] * J[:, :8]) - own[:, :8].T @ (share[:, None] * own[:, :8])
    return H
