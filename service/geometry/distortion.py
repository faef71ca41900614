"""Lens distortion: OpenCV's model (Brown and Conrady, rational, thin prism, tilt) and its fisheye model (Kannala and Brandt).

Both models map a ray to a point of the distorted image in units of the focal length: ``u = fx * x + cx``, ``v = fy * y + cy``.

- ``brown_conrady``: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tau_x, tau_y]]]]. Brown, "Close-Range Camera Calibration",
  Photogrammetric Engineering 37 (8), 1971; the further terms as in OpenCV (``cv2.projectPoints``).
- ``kannala_brandt``: k1 to k4 of ``theta * (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)``, with the angle theta from the
  optical axis. Kannala and Brandt, "A Generic Camera Model", IEEE PAMI 28 (8), 2006, equation 6 (``cv2.fisheye``).
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import RequestError
from service.geometry.camera import DistortionModel, PinholeCamera

#: Numbers of coefficients that OpenCV accepts.
COEFFICIENTS: dict[DistortionModel, tuple[int, ...]] = {"brown_conrady": (4, 5, 8, 12, 14), "kannala_brandt": (4,)}
#: Largest magnitude of each coefficient. Radial terms of a telephoto lens are large, because its radius is small: at 20 degrees of view,
#: k3 = 1000 moves the edge of the image by 3 %. Decentring and thin prism beyond 1, and a sensor tilted by more than 0.5 rad, are no
#: photographic lens. The angles of a fisheye lens are large, so its terms are small.
LIMITS: dict[DistortionModel, tuple[tuple[str, float], ...]] = {
    "brown_conrady": (
        ("k1", 1e3), ("k2", 1e3), ("p1", 1.0), ("p2", 1.0), ("k3", 1e3), ("k4", 1e3), ("k5", 1e3), ("k6", 1e3),
        ("s1", 1.0), ("s2", 1.0), ("s3", 1.0), ("s4", 1.0), ("tau_x", 0.5), ("tau_y", 0.5),
    ),
    "kannala_brandt": (("k1", 10.0), ("k2", 10.0), ("k3", 10.0), ("k4", 10.0)),
}  # fmt: skip
#: Largest angle from the optical axis of a ray that a ``brown_conrady`` lens sees. Its radius is a tangent.
MOST_TANGENT_DEG = 89.0
#: Least growth of the distorted radius with the angle, relative to that at the centre. Below it a pixel covers 50 times the angle of the
#: central pixel, and the inverse of the model is ill-conditioned.
LEAST_GROWTH = 0.02
#: Samples of the test of monotony: directions around the optical axis, and radii on either side of the corner's.
_DIRECTIONS, _RADII = 64, 256
_NEWTON_STEPS, _CONVERGED = 30, 1e-9

Points = Float64[NDArray[np.float64], "*shape 2"]
Rays = Float64[NDArray[np.float64], "*shape 3"]


def coefficient_problem(model: DistortionModel, distortion: Sequence[float]) -> str | None:
    """Check the number and the size of coefficients.

    Args:
        model: of the lens.
        distortion: coefficients in OpenCV order. Zeros of any number are no distortion of ``brown_conrady``.

    Returns:
        The problem with its remedy; None if there is none.
    """
    counts = COEFFICIENTS[model]
    if model == "brown_conrady" and not any(distortion):
        return None
    if len(distortion) not in counts:
        wanted = " or ".join(filter(None, (", ".join(map(str, counts[:-1])), str(counts[-1]))))
        names = ", ".join(name for name, _ in LIMITS[model])
        return (
            f"the model {model} does not have {len(distortion)} coefficients; send {wanted} of {names}, in this order"
        )
    for value, (name, limit) in zip(distortion, LIMITS[model], strict=False):
        if not abs(value) <= limit:
            return (
                f"{name} = {value:g} is no lens, because it exceeds {limit:g}; check the order of the coefficients (OpenCV) and "
                "distortion_model"
            )
    return None


def reach_of(camera: PinholeCamera) -> float:
    """Compute the largest angle of a ray that a distorted image shows, and check that the model is invertible up to there.

    The distorted radius must grow from the centre to the farthest corner of the image. Otherwise two rays meet in one pixel.

    Args:
        camera: with distortion.

    Returns:
        The angle from the optical axis, radians. A fisheye lens may see more than a quarter turn. An image that is larger than the
        lens's image circle gives pi.

    Raises:
        RequestError: the model is not invertible over the image.
    """
    return _kannala_brandt_reach(camera) if camera.distortion_model == "kannala_brandt" else _brown_reach(camera)


def distorted_pixels(camera: PinholeCamera, xy: Points) -> Points:
    """Project rays into the distorted image.

    Args:
        camera: intrinsics and distortion.
        xy: x / z and y / z of each ray.

    Returns:
        u and v, pixels. They are meaningless for rays beyond ``reach_of``.
    """
    with np.errstate(all="ignore"):
        if camera.distortion_model == "kannala_brandt":
            radius = np.hypot(xy[..., 0], xy[..., 1])
            theta = np.arctan(radius)
            factor = np.where(radius > 0, theta / radius, 1.0) * _fisheye_factor(camera.distortion, theta)
            xd, yd = xy[..., 0] * factor, xy[..., 1] * factor
        else:
            xd, yd = _tilted(_padded(camera), *_bent(_padded(camera), xy[..., 0], xy[..., 1]))
    return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1)


def rays_of(camera: PinholeCamera, pixels: Points) -> Rays:
    """Compute the ray of points of a distorted image: the inverse of ``distorted_pixels``.

    Args:
        camera: intrinsics and distortion, invertible over the image.
        pixels: u and v, inside the image.

    Returns:
        Unit rays in the optical frame. NaN where the lens sees nothing.

    Raises:
        RequestError: the model is not invertible over the image.
    """
    xd, yd = (pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy
    if camera.distortion_model == "kannala_brandt":
        return _fisheye_rays(camera, xd, yd)
    d, reach = _padded(camera), reach_of(camera)
    xd, yd = _untilted(d, xd, yd)
    x, y = _unbent(d, xd, yd, math.tan(reach))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def corners_of(camera: PinholeCamera) -> Points:
    """Return the outer corners of an image in units of the focal length, without the distortion (4, 2).

    Args:
        camera: intrinsics.
    """
    u, v = np.array([-0.5, camera.width - 0.5]), np.array([-0.5, camera.height - 0.5])
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    return np.stack([x.ravel(), y.ravel()], axis=-1)


def _corner_radius(camera: PinholeCamera) -> float:
    return float(np.hypot(*corners_of(camera).T).max())


def _not_invertible(camera: PinholeCamera, why: str) -> RequestError:
    other = "kannala_brandt" if camera.distortion_model == "brown_conrady" else "brown_conrady"
    return RequestError(
        f"camera.distortion: the model {camera.distortion_model} is not invertible over the image, because {why}; check the order of the "
        f"coefficients and whether the lens is {other} (camera.distortion_model), calibrate with points up to the corners of the image, "
        "or crop both images and send cx and cy of the crop",
        field="camera.distortion",
    )


# -- Brown and Conrady


def _padded(camera: PinholeCamera) -> tuple[float, ...]:
    return (*camera.distortion, *(0.0,) * (14 - len(camera.distortion)))


def _bent(
    d: tuple[float, ...], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distort points before the tilt of the sensor."""
    r2 = x * x + y * y
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = d[:12]
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
    return xd, yd


def _bent_jacobian(
    d: tuple[float, ...], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Derivatives of ``_bent``: dxd/dx, dxd/dy, dyd/dx, dyd/dy."""
    r2 = x * x + y * y
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = d[:12]
    above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = above / below
    slope = (k1 + r2 * (2 * k2 + 3 * k3 * r2) - radial * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / below  # by r2
    prism_x, prism_y = 2 * (s1 + 2 * s2 * r2), 2 * (s3 + 2 * s4 * r2)
    xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + prism_x * x
    xy = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y + prism_x * y
    yx = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y + prism_y * x
    yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + prism_y * y
    return xx, xy, yx, yy


def _tilt(d: tuple[float, ...]) -> Float64[NDArray[np.float64], "3 3"]:
    """Homography of a tilted sensor, as OpenCV's ``computeTiltProjectionMatrix``."""
    sx, cx, sy, cy = math.sin(d[12]), math.cos(d[12]), math.sin(d[13]), math.cos(d[13])
    R = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return np.asarray(np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R)


def _tilted(
    d: tuple[float, ...], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return (x, y) if d[12] == d[13] == 0 else _homography(_tilt(d), x, y)


def _untilted(
    d: tuple[float, ...], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return (x, y) if d[12] == d[13] == 0 else _homography(np.asarray(np.linalg.inv(_tilt(d)), np.float64), x, y)


def _homography(
    H: Float64[NDArray[np.float64], "3 3"], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Map points by a homography. NaN where they lie behind it."""
    z = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    z = np.where(z > 0, z, np.nan)
    return (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / z, (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / z


@lru_cache(maxsize=64)
def _brown_reach(camera: PinholeCamera) -> float:
    """See ``reach_of``. Sampled on circles of rays around the optical axis."""
    d, corner, most = _padded(camera), _corner_radius(camera), math.tan(math.radians(MOST_TANGENT_DEG))
    near = min(corner, most)
    radii = np.linspace(0, near, _RADII + 1)
    if near < most:
        radii = np.append(radii, np.geomspace(near, most, _RADII + 1)[1:])
    around = np.arange(_DIRECTIONS) * (2 * np.pi / _DIRECTIONS)
    x, y = radii[:, None] * np.cos(around), radii[:, None] * np.sin(around)
    with np.errstate(all="ignore"):
        distorted = np.hypot(*_tilted(d, *_bent(d, x, y)))
        xx, xy, yx, yy = _bent_jacobian(d, x, y)
        growth = np.diff(distorted, axis=0) / np.diff(np.arctan(radii))[:, None]
        grows = np.concatenate([np.ones((1, _DIRECTIONS), np.bool_), growth >= LEAST_GROWTH]) & (xx * yy - xy * yx > 0)
        shown = distorted.min(axis=1) >= corner  # false for NaN
    end = int(np.argmin(grows.all(axis=1))) if not grows.all() else len(radii)
    first = int(np.argmax(shown)) if shown.any() else len(radii)
    if first < end:
        return math.atan(radii[first])
    if end == len(radii):
        raise _not_invertible(
            camera, f"no ray within {MOST_TANGENT_DEG:g} degrees of the optical axis reaches the corners of the image"
        )
    raise _not_invertible(
        camera,
        f"the radius stops growing {math.degrees(math.atan(radii[end])):.1f} degrees from the optical axis, before it reaches the "
        "farthest corner",
    )


def _unbent(
    d: tuple[float, ...], xd: NDArray[np.float64], yd: NDArray[np.float64], most: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Invert ``_bent`` by Newton's method, from the radius that the radial terms alone give. NaN beyond the radius ``most``."""
    table = np.linspace(0, most, 4 * _RADII)
    with np.errstate(all="ignore"):
        radial, _ = _bent((*d[:2], 0.0, 0.0, *d[4:8], *(0.0,) * 6), table, np.zeros_like(table))
        bent = np.maximum.accumulate(np.nan_to_num(radial))
        radius = np.hypot(xd, yd)
        stretched = np.interp(radius, bent, table) / np.where(radius > 0, radius, 1.0)
        x, y = xd * stretched, yd * stretched
        for _ in range(_NEWTON_STEPS):
            fx, fy = _bent(d, x, y)
            off_x, off_y = xd - fx, yd - fy
            if not np.nanmax(np.hypot(off_x, off_y), initial=0.0) > _CONVERGED / 100:
                break
            xx, xy, yx, yy = _bent_jacobian(d, x, y)
            determinant = xx * yy - xy * yx
            step_x, step_y = (yy * off_x - xy * off_y) / determinant, (xx * off_y - yx * off_x) / determinant
            size, limit = np.hypot(step_x, step_y), 0.5 * np.hypot(x, y) + 0.1
            short = np.where(size > limit, limit / size, 1.0)
            x, y = x + short * step_x, y + short * step_y
        fx, fy = _bent(d, x, y)
        good = (np.hypot(xd - fx, yd - fy) <= _CONVERGED) & (np.hypot(x, y) <= 1.01 * most)
    return np.where(good, x, np.nan), np.where(good, y, np.nan)


# -- Kannala and Brandt


def _fisheye_factor(distortion: tuple[float, ...], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    k1, k2, k3, k4 = distortion
    t2 = theta * theta
    return 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))


def _fisheye_growth(distortion: tuple[float, ...], theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Derivative of the distorted radius by the angle."""
    k1, k2, k3, k4 = distortion
    t2 = theta * theta
    return 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


@lru_cache(maxsize=64)
def _kannala_brandt_reach(camera: PinholeCamera) -> float:
    theta = np.linspace(0, np.pi, 8 * _RADII + 1)
    corner = _corner_radius(camera)
    shown = theta * _fisheye_factor(camera.distortion, theta) >= corner
    grows = _fisheye_growth(camera.distortion, theta) >= LEAST_GROWTH
    first = int(np.argmax(shown)) if shown.any() else len(theta) - 1
    if grows[: first + 1].all():
        return float(theta[first])
    stops_deg = math.degrees(theta[int(np.argmin(grows))])
    raise _not_invertible(
        camera,
        f"the radius stops growing {stops_deg:.1f} degrees from the optical axis, before it reaches the farthest corner",
    )


def _fisheye_rays(camera: PinholeCamera, xd: NDArray[np.float64], yd: NDArray[np.float64]) -> Rays:
    reach = reach_of(camera)
    table = np.linspace(0, reach, 4 * _RADII)
    bent = table * _fisheye_factor(camera.distortion, table)
    radius = np.hypot(xd, yd)
    theta = np.interp(radius, bent, table)
    for _ in range(4):
        theta = theta - (theta * _fisheye_factor(camera.distortion, theta) - radius) / _fisheye_growth(
            camera.distortion, theta
        )
        theta = np.clip(theta, 0, reach)
    theta = np.where(radius <= bent[-1] + _CONVERGED, theta, np.nan)
    sine = np.where(radius > 0, np.sin(theta) / np.where(radius > 0, radius, 1.0), 0.0)
    return np.stack([xd * sine, yd * sine, np.cos(theta)], axis=-1)
