"""A spinning LiDAR."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.conditions import Condition
from model_training.simulation.meshes import Material
from model_training.simulation.reflectance import reflectance_of
from model_training.simulation.scene import Scene
from model_training.simulation.terrain import GroundPicture


@dataclass(frozen=True, slots=True)
class LidarModel:
    """Geometry and errors of a LiDAR; metres, degrees, shares."""

    name: str
    channels: int
    columns: int
    top_deg: float
    bottom_deg: float
    range_noise_m: float = 0.02
    dropout: float = 0.03
    max_range_m: float = 100.0

    def rays(self) -> NDArray[np.float32]:
        """Unit rays (channels * columns, 3) in the LiDAR frame, row by row from the top, azimuth from -pi upwards."""
        elevation = np.deg2rad(np.linspace(self.top_deg, self.bottom_deg, self.channels))[:, None]
        azimuth = (np.arange(self.columns) / self.columns * 2 * np.pi - np.pi)[None, :]
        flat = np.cos(elevation) * np.ones_like(azimuth)
        rays = np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) * np.ones_like(azimuth)], axis=-1
        )
        return rays.reshape(-1, 3).astype(np.float32)


LIDARS = {
    m.name: m
    for m in (
        LidarModel("paper_32", 32, 1024, 15.0, -15.0),
        LidarModel("vlp_16", 16, 1024, 15.0, -15.0, 0.03),
        LidarModel("hdl_64", 64, 1024, 2.0, -24.8),
        LidarModel("os1_128", 128, 1024, 22.5, -22.5, 0.02),
    )
}

INTENSITY_NOISE = np.float32(0.08)  # of the logarithm: speckle and the pulse's own scatter
#: Glass mostly lets the beam through or mirrors it away.
_RETURNS = np.ones(len(Material), np.float32)
_RETURNS[Material.GLASS] = 0.75


def scan(
    scene: Scene, ground: GroundPicture, model: LidarModel, rays: NDArray[np.float32], T_map_lidar: NDArray[np.float64],
    condition: Condition, rng: np.random.Generator,
) -> NDArray[np.float32]:  # fmt: skip
    """One revolution from a standing sensor.

    Returns:
        Points (n, 4): x, y, z in the LiDAR frame (m) and intensity (0..1), as KITTI lays them out. The intensity is made up
        for the distance, as sensors report it, but not for the angle of incidence, which a sensor cannot know.
    """
    R = T_map_lidar[:3, :3].astype(np.float32)
    rays_map = rays @ R.T
    hits = scene.hits(T_map_lidar[:3, 3], rays_map)
    met = hits.primitive >= 0
    primitive = np.maximum(hits.primitive, 0)
    reflectance = np.zeros(len(rays), np.float32)
    reflectance[met] = reflectance_of(scene, ground, T_map_lidar[:3, 3], rays_map[met], hits.of(met), condition)
    distance = hits.distance.copy()
    count = len(distance)
    chance = rng.random(count, dtype=np.float32)
    keep_share = (1.0 - model.dropout) * _RETURNS[scene.mesh.material[primitive]]
    if condition.extinction_per_m > 0:
        # A return is heard while reflectance / r^2 * exp(-2 a r) stays over that of a 10 % target at the nominal range.
        heard = reflectance / np.maximum(distance, 0.5) ** 2 * np.exp(-2 * condition.extinction_per_m * distance)
        met &= heard > 0.1 / model.max_range_m**2
    distance += rng.standard_normal(count, dtype=np.float32) * np.float32(model.range_noise_m)
    met &= (distance > 0.3) & (distance < model.max_range_m) & (chance < keep_share)
    if condition.false_returns > 0:
        reach = rng.exponential(condition.false_reach_m, count).astype(np.float32) + np.float32(0.8)
        false = (rng.random(count) < condition.false_returns) & ((reach < distance) | ~met)
        distance = np.where(false, reach, distance)
        reflectance = np.where(false, np.float32(0.05), reflectance)
        met |= false
    reflectance *= np.exp(INTENSITY_NOISE * rng.standard_normal(count, dtype=np.float32))
    np.minimum(reflectance, np.float32(1), out=reflectance)
    points = np.concatenate([rays * distance[:, None], reflectance[:, None]], axis=1, dtype=np.float32)
    result: NDArray[np.float32] = points[met]
    return result
