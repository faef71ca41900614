"""Colour along rays: sun with shadows, sky light, textures, sky and clouds, haze, headlights."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.conditions import Condition
from model_training.simulation.meshes import Material
from model_training.simulation.scene import Hits, Scene
from model_training.simulation.terrain import Cover, GroundPicture

Colour = NDArray[np.float32]

#: Linear albedo of each ``Cover``.
_COVER_ALBEDO = np.zeros((len(Cover), 3), np.float32)
_COVER_ALBEDO[Cover.GRASS] = (0.14, 0.21, 0.07)
_COVER_ALBEDO[Cover.ASPHALT] = (0.12, 0.12, 0.125)
_COVER_ALBEDO[Cover.PAVING] = (0.34, 0.33, 0.31)
_COVER_ALBEDO[Cover.MARKING] = (0.62, 0.62, 0.60)
_COVER_ALBEDO[Cover.SOIL] = (0.22, 0.16, 0.11)

#: Rays shaded at a time. Their working set fits in the processor's cache.
CHUNK = 8192
#: Contrast of the texture of each ``Material``.
_ROUGHNESS = np.array([0.25, 0.12, 0.30, 0.05, 0.45, 0.04], np.float32)


@dataclass(frozen=True, slots=True)
class Light:
    """Sun and sky of one traversal. Colours are linear light (3,).

    Attributes:
        toward_sun: unit direction to the sun (3,), map frame.
        sun: direct sunlight.
        sky: ambient light from the sky.
        zenith: colour of the sky at the zenith.
        horizon: colour of the sky at the horizon.
        clouds: cloudiness; the sky has more clouds with a larger value.
        haze_per_m: extinction of visible light, per metre.
    """

    toward_sun: NDArray[np.float64]
    sun: Colour
    sky: Colour
    zenith: Colour
    horizon: Colour
    clouds: float
    haze_per_m: float

    @staticmethod
    def of(
        condition: Condition,
        rng: np.random.Generator,
        *,
        elevation_deg: float | None = None,
        azimuth_deg: float | None = None,
    ) -> "Light":
        """Draw the light of a traversal. The sun's azimuth and the clouds differ between traversals.

        Args:
            condition: weather and light.
            rng: random generator of the traversal.
            elevation_deg: elevation of the sun above the horizon, degrees; None draws it near the condition's.
            azimuth_deg: azimuth of the sun, degrees from east (x), counter-clockwise; None draws it.
        """
        spread = 12.0 if condition.sun_elevation_deg > 20 else 2.0
        elevation = np.deg2rad(condition.sun_elevation_deg + rng.uniform(-spread, spread))
        azimuth = rng.uniform(0, 2 * np.pi)
        elevation = elevation if elevation_deg is None else np.deg2rad(elevation_deg)
        azimuth = azimuth if azimuth_deg is None else np.deg2rad(azimuth_deg)
        warm = np.clip(1.2 - np.sin(elevation), 0.0, 1.0)
        sun = np.array([1.0, 0.95 - 0.15 * warm, 0.85 - 0.4 * warm]) * 2.4 * condition.sun_strength
        grey = 1.0 if condition.sun_strength == 0 else rng.uniform(0.0, 0.5)
        blue, white = np.array([0.30, 0.45, 0.80]), np.array([0.70, 0.72, 0.75])
        zenith = (blue * (1 - grey) + white * grey) * condition.ambient
        horizon = (np.array([0.72, 0.80, 0.92]) * (1 - grey) + white * 1.05 * grey) * condition.ambient
        f = np.float32
        return Light(
            np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]),
            sun.astype(f),
            (0.75 * (0.5 * zenith + 0.5 * horizon)).astype(f),
            zenith.astype(f),
            horizon.astype(f),
            float(rng.uniform(0.1, 0.8)),
            condition.extinction_per_m + 1.0 / 2500.0,
        )


def hashed(cells: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return a pseudo-random number from -1 to 1 for each cell (n,), by an integer hash.

    Args:
        cells: integer cell coordinates (n, 3).
    """
    h = cells[:, 0].astype(np.uint32) * np.uint32(73856093)
    h ^= cells[:, 1].astype(np.uint32) * np.uint32(19349663)
    h ^= cells[:, 2].astype(np.uint32) * np.uint32(83492791)
    h ^= h >> np.uint32(13)
    h *= np.uint32(1274126177)
    h ^= h >> np.uint32(16)
    return (h & np.uint32(0xFFFF)).astype(np.float32) / np.float32(32767.5) - np.float32(1)


def _sky(rays: NDArray[np.float32], light: Light, condition: Condition) -> Colour:
    up = np.clip(rays[:, 2:3], 0, 1)
    colour = light.horizon + (light.zenith - light.horizon) * np.sqrt(up)
    spread = rays[:, :2] / (up + 0.15)
    wave = np.sin(spread[:, 0] * 3.1 + 1.7 * np.sin(spread[:, 1] * 2.3)) * np.sin(
        spread[:, 1] * 3.7 + 1.3 * np.sin(spread[:, 0] * 1.9)
    )
    cover = np.clip(wave + light.clouds, 0, 1)[:, None].astype(np.float32)
    colour = colour + (np.float32(0.95 * condition.ambient) - colour) * cover * 0.8
    if condition.sun_strength > 0:
        toward = np.clip(rays @ light.toward_sun.astype(np.float32), 0, 1)[:, None]
        colour = colour + light.sun * (toward**400 * 8 + condition.glare * (toward**12 * 0.8 + toward**60 * 3))
    shaded: Colour = colour.astype(np.float32)
    return shaded


def albedo_of(
    scene: Scene, ground: GroundPicture, points: NDArray[np.float32], hits: Hits, condition: Condition
) -> Colour:
    """Return the textured albedo (n, 3) of the intersected surfaces, 0 to 1.

    Args:
        scene: mesh that the rays intersect.
        ground: cover of the ground.
        points: points of intersection (n, 3), map frame, metres.
        hits: intersections. Every ray must have one.
        condition: weather: wet and snow-covered surfaces change their albedo.
    """
    primitive = hits.primitive
    material = scene.mesh.material[primitive]
    albedo = scene.mesh.albedo[primitive]
    on_ground = material == Material.GROUND
    albedo[on_ground] = _COVER_ALBEDO[ground.at(points[on_ground, :2])]
    fine = hashed(np.floor(points * np.array([9, 9, 14], np.float32)).astype(np.int32))
    coarse = hashed(np.floor(points * np.float32(1.1)).astype(np.int32))
    albedo = albedo * (1 + _ROUGHNESS[material] * (0.65 * fine + 0.5 * coarse))[:, None]
    brick = material == Material.BRICK
    course = np.modf(np.abs(points[brick, 2]) * np.float32(1 / 0.24))[0] < 0.18
    albedo[brick] *= np.where(course, np.float32(1.25), np.float32(0.95))[:, None]
    if condition.wet > 0:
        albedo *= np.float32(1 - 0.45 * condition.wet)
    if condition.snow_cover > 0:
        flat = np.abs(hits.normal[:, 2]) > 0.6 * np.linalg.norm(hits.normal, axis=1)
        lying = flat & (coarse > 1 - 2 * condition.snow_cover)
        albedo[lying] = 0.85
    clipped: Colour = np.clip(albedo, 0.0, 1.0)
    return clipped


def shade(
    scene: Scene,
    ground: GroundPicture,
    origin: NDArray[np.float64],
    rays: NDArray[np.float32],
    hits: Hits,
    light: Light,
    condition: Condition,
    *,
    forward: NDArray[np.float64],
    lit: NDArray[np.bool_] | None = None,
) -> Colour:
    """Return the linear light (n, 3) that comes along each ray from a surface or the sky.

    Args:
        scene: mesh that the rays intersect.
        ground: cover of the ground.
        origin: origin of the rays (3,), map frame, metres.
        rays: unit directions (n, 3), map frame.
        hits: intersections of the rays.
        light: sun and sky of the traversal.
        condition: weather and light of the traversal.
        forward: optical axis (3,), map frame, for the headlights.
        lit: which intersections see the sun (n,); None casts shadow rays here.
    """
    colour = np.empty((len(rays), 3), np.float32)
    for start in range(0, len(rays), CHUNK):
        part = slice(start, start + CHUNK)
        some = Hits(hits.distance[part], hits.primitive[part], hits.normal[part])
        met, missed = np.flatnonzero(some.primitive >= 0), np.flatnonzero(some.primitive < 0)
        ahead, found = rays[part], np.empty((len(some.primitive), 3), np.float32)
        found[missed] = _sky(ahead.take(missed, axis=0), light, condition)
        found[met] = _surfaces(
            scene,
            ground,
            origin,
            ahead.take(met, axis=0),
            Hits(some.distance.take(met), some.primitive.take(met), some.normal.take(met, axis=0)),
            light,
            condition,
            forward,
            None if lit is None else lit[part].take(met),
        )
        colour[part] = found
    return colour


def _surfaces(
    scene: Scene,
    ground: GroundPicture,
    origin: NDArray[np.float64],
    rays: NDArray[np.float32],
    hits: Hits,
    light: Light,
    condition: Condition,
    forward: NDArray[np.float64],
    lit: NDArray[np.bool_] | None,
) -> Colour:
    """Return the light (n, 3) from surfaces. Every ray must have an intersection."""
    points = origin.astype(np.float32) + rays * hits.distance[:, None]
    colour = albedo_of(scene, ground, points, hits, condition)
    normal = hits.normal / np.maximum(np.sqrt(np.einsum("ij,ij->i", hits.normal, hits.normal)), 1e-12)[:, None]
    head_on = np.einsum("ij,ij->i", normal, rays)
    normal *= np.where(head_on > 0, np.float32(-1), np.float32(1))[:, None]
    received = (0.62 + 0.38 * normal[:, 2:3]) * light.sky
    if condition.sun_strength > 0:
        if lit is None:
            lit = shadows(scene, points, normal, light)
        facing = np.maximum(normal @ light.toward_sun.astype(np.float32), 0) * lit
        received += facing[:, None] * light.sun
    if condition.headlights:
        axis = np.clip(rays @ forward.astype(np.float32), 0, 1)
        beam = np.clip((axis - 0.85) / 0.12, 0, 1) ** 2
        received += (beam * np.abs(head_on) * 14.0 / np.maximum(hits.distance, 2.0) ** 1.6)[:, None]
    colour *= received
    glass = scene.mesh.material[hits.primitive] == Material.GLASS
    if glass.any():
        mirrored = rays[glass] - 2 * (rays[glass] * normal[glass]).sum(axis=1, keepdims=True) * normal[glass]
        colour[glass] = 0.6 * colour[glass] + 0.25 * _sky(mirrored, light, condition)
    through = np.exp(np.float32(-light.haze_per_m) * hits.distance)[:, None]
    colour *= through
    colour += light.horizon * (1 - through)
    return colour


def shadows(scene: Scene, points: NDArray[np.float32], normal: NDArray[np.float32], light: Light) -> NDArray[np.bool_]:
    """Return whether each point (n,) sees the sun.

    The rays start 3 cm above the surface, so the surface does not shade itself.

    Args:
        scene: mesh that casts shadows.
        points: points on surfaces (n, 3), map frame, metres.
        normal: unit normals (n, 3) that face the viewer, map frame.
        light: sun of the traversal.
    """
    return scene.lit(points + normal * np.float32(0.03), light.toward_sun)


def to_srgb(linear: Colour, exposure: float) -> NDArray[np.float32]:
    """Return display values (0 to 255) of linear light: exposure, a soft shoulder and gamma 2.2, by lookup table.

    Args:
        linear: linear light (H, W, 3).
        exposure: factor on the light.
    """
    step = np.minimum(linear * np.float32(exposure * _CURVE_STEPS / _CURVE_END), np.float32(_CURVE_STEPS - 1))
    encoded: NDArray[np.float32] = _CURVE[step.astype(np.int32)]
    return encoded


#: Exposed light at the end of the tone curve's table, and the number of entries.
_CURVE_END, _CURVE_STEPS = 12.0, 16384


def _curve() -> NDArray[np.float32]:
    exposed = (np.arange(_CURVE_STEPS) + 0.5) / _CURVE_STEPS * _CURVE_END
    shoulder = exposed * (1 + exposed / 9.0) / (1 + exposed)
    return (255.0 * np.minimum(shoulder * 1.25, 1.0) ** (1 / 2.2)).astype(np.float32)


_CURVE = _curve()
