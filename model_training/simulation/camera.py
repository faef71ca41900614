"""Render the RGB image and the true depth of one camera pose."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.simulation.blocker import Blocker
from model_training.simulation.conditions import Condition
from model_training.simulation.exposure import RgbModel, exposed
from model_training.simulation.meshes import Material
from model_training.simulation.scene import Hits, Scene
from model_training.simulation.shading import Light, shade, shadows
from model_training.simulation.terrain import GroundPicture
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import rays_of

#: Pixels between shadow rays, horizontally and vertically: a quarter of the rays.
SHADOW_STEP = 2


@dataclass(frozen=True)
class Picture:
    """A rendered RGB-D image.

    Attributes:
        rgb: sRGB image (H, W, 3).
        depth_m: true depth (H, W), z in the optical frame, metres; 0 where no surface is hit.
        blank: pixels (H, W) on glass, metal or plain walls, where a stereo matcher finds no texture.
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    blank: NDArray[np.bool_]


def unit_rays(camera: PinholeCamera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the unit rays (N, 3) of all N = H * W pixels in the optical frame, row by row, and their z components (N,).

    A pixel whose ray has no z, or that the lens does not see, has a z component of 0, so its depth is 0.

    Args:
        camera: intrinsics and distortion.

    Raises:
        RequestError: the distortion is not invertible over the image.
    """
    if camera.is_distorted:
        pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
        bent = np.nan_to_num(rays_of(camera, pixels.reshape(-1, 2).astype(np.float64)))
        bent[~bent.any(axis=1), 2] = -1.0
        return bent.astype(np.float32), np.maximum(bent[:, 2], 0).astype(np.float32)
    rays = camera.rays_of_pixels().reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    return (rays / length[:, None]).astype(np.float32), (1.0 / length).astype(np.float32)


def take(
    scene: Scene,
    ground: GroundPicture,
    camera: PinholeCamera,
    T_map_camera: NDArray[np.float64],
    light: Light,
    condition: Condition,
    model: RgbModel,
    rng: np.random.Generator,
    *,
    rays_camera: NDArray[np.float32],
    z_of_ray: NDArray[np.float32],
    blocker: Blocker | None = None,
    metering: float | None = None,
) -> Picture:
    """Render an RGB-D image.

    Args:
        scene: static objects and occupants of the traversal.
        ground: cover of the ground.
        camera: intrinsics.
        T_map_camera: camera pose (4, 4), optical frame to map frame, metres.
        light: sun and sky of the traversal.
        condition: weather and light of the traversal.
        model: RGB camera.
        rng: random generator of the frame.
        rays_camera: unit rays (N, 3) of ``unit_rays``.
        z_of_ray: z components (N,) of ``unit_rays``.
        blocker: vehicle body that occludes a part of the scene.
        metering: exposure factor, as in ``exposed``; None draws it.
    """
    R = T_map_camera[:3, :3].astype(np.float32)
    origin = T_map_camera[:3, 3]
    rays = rays_camera @ R.T
    hits = scene.hits(origin, rays)
    shape = (camera.height, camera.width)
    material = scene.mesh.material[np.maximum(hits.primitive, 0)]
    lit = _lit(scene, origin, rays, hits, light, shape) if condition.sun_strength > 0 else None
    linear = shade(scene, ground, origin, rays, hits, light, condition, forward=T_map_camera[:3, 2], lit=lit)
    distance = hits.distance
    if blocker is not None:
        stopped, near, albedo = blocker.over(origin, rays, hits)
        distance = np.where(stopped, near, distance)
        material = np.where(stopped, Material.METAL, material)
        linear = np.where(stopped[:, None], albedo * light.sky, linear)
    rgb = exposed(linear.reshape(*shape, 3), model, condition, rng, metering=metering)
    depth = (distance * z_of_ray).reshape(shape)
    blank = ((material == Material.GLASS) | (material == Material.METAL) | (material == Material.MATTE)).reshape(shape)
    return Picture(rgb, depth, blank & (depth > 0))


def _lit(
    scene: Scene,
    origin: NDArray[np.float64],
    rays: NDArray[np.float32],
    hits: Hits,
    light: Light,
    shape: tuple[int, int],
) -> NDArray[np.bool_]:
    """Return which pixels see the sun (N,): cast shadow rays on a coarser grid and copy each result to its neighbours."""

    def coarse(values: NDArray[np.float32]) -> NDArray[np.float32]:
        picked = values.reshape(*shape, -1)[::SHADOW_STEP, ::SHADOW_STEP]
        return picked.reshape(-1, picked.shape[-1])

    directions, distance, normal = coarse(rays), coarse(hits.distance), coarse(hits.normal)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    normal = normal * np.where((normal * directions).sum(axis=1, keepdims=True) > 0, np.float32(-1), np.float32(1))
    points = origin.astype(np.float32) + directions * distance
    lit = shadows(scene, points, normal, light)
    small = lit.reshape(-(-shape[0] // SHADOW_STEP), -(-shape[1] // SHADOW_STEP)).astype(np.uint8)
    spread = cv2.resize(small, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(spread, np.uint8).reshape(-1) > 0
