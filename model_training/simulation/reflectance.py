"""Reflectance of surfaces at a LiDAR's infrared wavelength. It correlates with the visible colour but differs from it.

Paints of one colour differ in the near infrared. Leaves and grass are dark to the eye and bright at 905 nm. Glass returns almost
nothing. Lane markings contain retroreflective beads. Reflectances by kind: ECOSTRESS spectral library, Meerdink et al., Remote
Sensing of Environment 230, 2019. Surfaces are Lambertian, so a return falls with the cosine of the angle of incidence.
"""

import numpy as np
from numpy.typing import NDArray

from model_training.simulation.conditions import Condition
from model_training.simulation.meshes import Material
from model_training.simulation.scene import Hits, Scene
from model_training.simulation.shading import albedo_of, hashed
from model_training.simulation.terrain import Cover, GroundPicture

#: Half the range of the logarithm of reflectance among paints of one brightness.
PIGMENTS = np.float32(0.5)
#: Reflectance of leaves at 905 nm, and the visible albedo at which they have it.
LEAVES, LEAVES_OF_GREY = np.float32(0.5), np.float32(0.14)
#: Factor on the reflectance of lane markings, from their retroreflective beads.
BEADS = np.float32(1.6)
#: Reflectance of glass.
PANE = np.float32(0.05)


def reflectance_of(
    scene: Scene,
    ground: GroundPicture,
    origin: NDArray[np.float64],
    rays: NDArray[np.float32],
    hits: Hits,
    condition: Condition,
) -> NDArray[np.float32]:
    """Return the share of the pulse (n,) that the intersected surfaces send back, 0 to 1.

    Args:
        scene: mesh that the rays intersect.
        ground: cover of the ground.
        origin: origin of the rays (3,), or one origin per ray (n, 3), map frame, metres.
        rays: unit directions (n, 3), map frame.
        hits: intersections of the rays. Every ray must have one.
        condition: weather.
    """
    points = origin.astype(np.float32) + rays * hits.distance[:, None]
    grey = albedo_of(scene, ground, points, hits, condition).mean(axis=1)
    material = scene.mesh.material[hits.primitive]
    base = np.floor(scene.mesh.albedo[hits.primitive] * np.float32(1000)).astype(np.int32)
    infrared = grey * np.exp(PIGMENTS * hashed(base))
    on_ground = np.flatnonzero(material == Material.GROUND)
    cover = ground.at(points[on_ground, :2])
    infrared[on_ground] = grey[on_ground] * np.where(cover == Cover.MARKING, BEADS, np.float32(1))
    green = material == Material.FOLIAGE
    green[on_ground] = cover == Cover.GRASS
    infrared[green] = LEAVES * np.sqrt(grey[green] / LEAVES_OF_GREY)
    infrared[material == Material.GLASS] = PANE
    length = np.sqrt(np.einsum("ij,ij->i", hits.normal, hits.normal))
    cosine = np.abs(np.einsum("ij,ij->i", hits.normal, rays)) / np.maximum(length, 1e-12)
    clipped: NDArray[np.float32] = np.clip(infrared * cosine, 0.0, 1.0)
    return clipped
