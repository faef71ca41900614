"""A spinning LiDAR."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.blocker import Blocker
from model_training.simulation.conditions import Condition
from model_training.simulation.meshes import Material
from model_training.simulation.reflectance import reflectance_of
from model_training.simulation.scene import Scene
from model_training.simulation.survey_drive import SurveyModel, moved_m
from model_training.simulation.terrain import GroundPicture
from service.geometry.rigid import rotation_z


@dataclass(frozen=True, slots=True)
class LidarModel:
    """Geometry and errors of a LiDAR.

    Attributes:
        name: name of the preset.
        channels: number of beams.
        columns: number of firings per revolution.
        top_deg: elevation of the highest beam, degrees.
        bottom_deg: elevation of the lowest beam, degrees.
        range_noise_m: standard deviation of the range, metres.
        dropout: share of returns that are lost.
        max_range_m: largest range, metres.
        beams_deg: elevation of each beam, degrees, from the top; empty: evenly spaced.
        non_repetitive: the ``channels * columns`` points of a scan cover the field of view evenly, at other directions in each scan, like
            those of a Livox sensor. The LiDAR then has no rings.
    """

    name: str
    channels: int
    columns: int
    top_deg: float
    bottom_deg: float
    range_noise_m: float = 0.02
    dropout: float = 0.03
    max_range_m: float = 100.0
    beams_deg: tuple[float, ...] = ()
    non_repetitive: bool = False

    def rays(self) -> NDArray[np.float32]:
        """Return the N = channels * columns unit rays (N, 3), LiDAR frame, row by row from the top, azimuth ascending from -pi.

        A LiDAR without rings has no rows: its rays come in the order of the points.
        """
        if self.non_repetitive:
            return self._even_rays()
        beams_deg = self.beams_deg or np.linspace(self.top_deg, self.bottom_deg, self.channels)
        elevation = np.deg2rad(np.asarray(beams_deg))[:, None]
        azimuth = (np.arange(self.columns) / self.columns * 2 * np.pi - np.pi)[None, :]
        flat = np.cos(elevation) * np.ones_like(azimuth)
        rays = np.stack(
            [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) * np.ones_like(azimuth)], axis=-1
        )
        return rays.reshape(-1, 3).astype(np.float32)

    def _even_rays(self) -> NDArray[np.float32]:
        """Rays that cover the field of view evenly: Roberts' R2 sequence (2018) over azimuth and elevation."""
        azimuth, elevation = ((np.arange(self.channels * self.columns)[:, None] * _R2) % 1.0).T
        azimuth = 2 * np.pi * azimuth - np.pi
        elevation = np.deg2rad(self.bottom_deg + (self.top_deg - self.bottom_deg) * elevation)
        flat = np.cos(elevation)
        return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1).astype(np.float32)


#: Steps of Roberts' R2 sequence: 1/p and 1/p^2, where p^3 = p + 1.
_R2 = np.array([0.7548776662466927, 0.5698402909980532])
#: Beams of the HDL-64E: two blocks of 32 beams, spaced 1/3 and 1/2 degree (Velodyne, HDL-64E S2 manual).
_HDL_64 = tuple(2.0 - k / 3 for k in range(32)) + tuple(-8.83 - k / 2 for k in range(32))
#: Beams of the Pandar64: dense near the horizon, sparse above and below it (Hesai, Pandar64 manual; rounded to 0.01 degrees).
_PANDAR_64 = (
    (14.88, 11.03, 8.06, 5.06, 3.04)
    + tuple(2.03 - k * 8.09 / 48 for k in range(49))
    + (-7.06, -8.06, -9.06, -9.89, -11.03, -12.01, -12.97, -13.93, -18.89, -24.9)
)


def _with_beams(name: str, beams_deg: tuple[float, ...]) -> LidarModel:
    return LidarModel(name, len(beams_deg), 1024, beams_deg[0], beams_deg[-1], beams_deg=beams_deg)


#: Presets by name.
LIDARS = {
    m.name: m
    for m in (
        LidarModel("paper_32", 32, 1024, 15.0, -15.0),
        LidarModel("vlp_16", 16, 1024, 15.0, -15.0, 0.03),
        LidarModel("hdl_32", 32, 1024, 10.67, -30.67),
        _with_beams("hdl_64", _HDL_64),
        LidarModel("os0_128", 128, 1024, 45.0, -45.0),
        LidarModel("os1_64", 64, 1024, 16.6, -16.6),
        LidarModel("os1_128", 128, 1024, 22.5, -22.5),
        _with_beams("pandar_64", _PANDAR_64),
        # 200,000 points per second for 0.2 s (Livox, Mid-360 manual).
        LidarModel("livox_mid_360", 40, 1024, 52.0, -7.0, 0.02, 0.03, 70.0, non_repetitive=True),
    )
}

#: A survey whose vehicle stands still during each scan.
STANDING = SurveyModel()
#: Standard deviation of the logarithm of the intensity: speckle and pulse-to-pulse variation.
INTENSITY_NOISE = np.float32(0.08)
#: Share of the beams that each material returns. Glass transmits or reflects some of them away.
_RETURNS = np.ones(len(Material), np.float32)
_RETURNS[Material.GLASS] = 0.75


def scan(
    scene: Scene,
    ground: GroundPicture,
    model: LidarModel,
    rays: NDArray[np.float32],
    T_map_lidar: NDArray[np.float64],
    condition: Condition,
    rng: np.random.Generator,
    *,
    survey: SurveyModel = STANDING,
    ahead: Blocker | None = None,
) -> NDArray[np.float32]:
    """Simulate one revolution.

    Args:
        scene: static objects and occupants.
        ground: cover of the ground.
        model: LiDAR.
        rays: unit rays (n, 3) of ``LidarModel.rays``, LiDAR frame.
        T_map_lidar: LiDAR pose (4, 4), LiDAR frame to map frame, metres; of a moving LiDAR, its pose in the middle of the revolution.
        condition: weather.
        rng: random generator of the scan.
        survey: motion of the vehicle.
        ahead: a vehicle that drives ahead.

    Returns:
        Points (n, 4): x, y, z in the LiDAR frame (m) and intensity (0 to 1), in KITTI's layout. The intensity is corrected for the
        distance, as sensors report it. It is not corrected for the angle of incidence, which a sensor does not know.
    """
    R = T_map_lidar[:3, :3].astype(np.float32)
    if model.non_repetitive:
        rays = rays @ rotation_z(rng.uniform(-np.pi, np.pi)).T.astype(np.float32)
    rays_map = rays @ R.T
    origin, offsets = T_map_lidar[:3, 3], None
    if survey.speed_m_s > 0:
        offsets = moved_m(rays, survey.speed_m_s)
        origin = origin + (offsets @ R.T).astype(np.float64)
    hits = scene.hits(origin, rays_map)
    met = hits.primitive >= 0
    primitive = np.maximum(hits.primitive, 0)
    reflectance = np.zeros(len(rays), np.float32)
    reflectance[met] = reflectance_of(
        scene, ground, origin if offsets is None else origin[met], rays_map[met], hits.of(met), condition
    )
    distance = hits.distance.copy()
    count = len(distance)
    chance = rng.random(count, dtype=np.float32)
    keep_share = (1.0 - model.dropout) * _RETURNS[scene.mesh.material[primitive]]
    if ahead is not None:
        stopped, near, albedo = ahead.over(origin, rays_map, hits)
        distance, met = np.where(stopped, near, distance), met | stopped
        reflectance = np.where(stopped, albedo.mean(axis=1), reflectance).astype(np.float32)
        keep_share = np.where(stopped, 1.0 - model.dropout, keep_share)
    if condition.extinction_per_m > 0:
        # A return is detected if reflectance / r^2 * exp(-2 a r) exceeds that of a 10 % target at the nominal range in clear air.
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
    xyz = rays * distance[:, None]
    if offsets is not None and survey.deskewed:
        xyz = xyz + offsets
    points = np.concatenate([xyz, reflectance[:, None]], axis=1, dtype=np.float32)
    result: NDArray[np.float32] = points[met]
    return result
