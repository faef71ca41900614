"""Query views of the training set whose depth comes from matching a rendered stereo pair.

Drawn errors (``augment``) err in another way than matching does: surfaces that a matcher smooths, edges that it fattens, streaks and
holes. An encoder that has only met drawn errors finds 0.75 to 0.81 of the places of simulated pairs, and 0.77 on KITTI's drive 0005
(decision log, 2026-11-25).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from model_training.simulation.camera import take, unit_rays
from model_training.simulation.city import City
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.exposure import METERING, RGBS, RgbModel
from model_training.simulation.scene import Scene
from model_training.simulation.shading import Light
from model_training.simulation.stereo_pair import StereoModel, StereoRig
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, Transform, heading_of_camera
from service.imaging.gather import gather
from service.imaging.level import level_camera
from service.imaging.view_grid import ViewGrid

NOMINAL_HEIGHT_M = 1.5  # of a camera, as the service takes it where the picture shows no ground


@dataclass(frozen=True, slots=True)
class MatchedRig:
    """A stereo rig of the training set.

    Attributes:
        camera: of the left picture.
        height_m: of the camera above the ground, least and greatest.
        model: matcher, focal length times baseline, and how badly the rig is rectified.
        rgb: how both cameras turn light into values.
        condition: of the light.
        exposure_ev: stops that the pictures of a drive are brighter than metered, least and greatest.
    """

    camera: PinholeCamera
    height_m: tuple[float, float]
    model: StereoModel
    rgb: RgbModel = RGBS["automatic"]
    condition: str = "clear"
    exposure_ev: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class MatchedView:
    """What a rig shows of one pose on the view grid.

    Attributes:
        ranges: metres (rows, columns), 0 for no measurement.
        rgb: sRGB (rows, columns, 3).
        seen: cells that the camera looks at (rows, columns).
        heading_rad: of the view, map frame.
        height_m: of the camera above the ground, as levelling finds it.
    """

    ranges: NDArray[np.float32]
    rgb: NDArray[np.uint8]
    seen: NDArray[np.bool_]
    heading_rad: float
    height_m: float


class RigOfADrive:
    """One rig, rectified as well as one drive's was, on a scene.

    Args:
        rig: camera and matcher.
        scene: what stands there.
        city: of the scene.
        rng: draws rectification, light and exposure.
    """

    def __init__(self, rig: MatchedRig, scene: Scene, city: City, rng: np.random.Generator) -> None:
        self._rig, self._scene, self._city, self._rng = rig, scene, city, rng
        self._stereo = StereoRig.drawn(rig.model, rig.camera, rng)
        self._rays, self._z_of_ray = unit_rays(rig.camera)
        self._condition = CONDITIONS[rig.condition]
        self._light = Light.of(self._condition, rng)
        self._rgb = replace(rig.rgb, exposure_ev=rng.uniform(*rig.exposure_ev))
        cv2.setNumThreads(1)  # a process a city: more threads would only wait for each other

    def view(self, T_map_body: Transform, grid: ViewGrid) -> MatchedView:
        """Render both pictures, match them, level and resample as the service does.

        Args:
            T_map_body: the left camera's position, x forward, y left, z up.
            grid: of the views.
        """
        T_map_camera = T_map_body.copy()
        T_map_camera[:3, :3] = T_map_body[:3, :3] @ R_BODY_OPTICAL
        metering = float(self._rng.uniform(*METERING))  # both cameras of a rig are exposed alike
        left, right = (
            take(
                self._scene, self._city.ground, self._rig.camera, T, self._light, self._condition, self._rgb, self._rng,
                rays_camera=self._rays, z_of_ray=self._z_of_ray, metering=metering,
            ).rgb
            for T in (T_map_camera, T_map_camera @ self._stereo.T_left_right)
        )  # fmt: skip
        depth_m = self._stereo.depth(left, right)
        level = level_camera(depth_m, self._rig.camera, down_camera=None, nominal_height_m=NOMINAL_HEIGHT_M)
        ranges, colour, seen = gather(left, depth_m, self._rig.camera, level.R_level_camera.T, grid)
        rgb = np.rint(colour).clip(0, 255).astype(np.uint8)
        return MatchedView(ranges, rgb, seen, heading_of_camera(T_map_camera), level.height_m)
