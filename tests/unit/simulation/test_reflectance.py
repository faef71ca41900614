import numpy as np
import pytest

from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.reflectance import PANE, reflectance_of
from model_training.simulation.scene import Scene
from model_training.simulation.terrain import Cover, GroundPicture

ORIGIN = np.zeros(3)


def returns(material, grey=0.5, *, turned_deg=0.0, cover=Cover.ASPHALT, condition="clear", count=400):
    """Return the mean return of beams that hit a face of a small box 10 m ahead, rotated about the vertical."""
    builder = MeshBuilder()
    builder.box(np.array([10.0, 0.0, -4.0]), (0.2, 8.0, 8.0), np.deg2rad(turned_deg), np.full(3, grey), material)
    scene = Scene(builder.mesh())
    spread = np.random.default_rng(0).uniform(-0.1, 0.1, (count, 2))
    rays = np.c_[np.ones(count), spread]
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    hits = scene.hits(ORIGIN, rays)
    assert (hits.primitive >= 0).all()
    ground = GroundPicture(np.full((200, 200), int(cover), np.uint8), (0.0, -10.0))
    return reflectance_of(scene, ground, ORIGIN, rays, hits, CONDITIONS[condition])


def test_a_lighter_wall_of_one_paint_returns_more():
    """Paints differ, so the test compares means over many."""
    light, dark = (
        np.mean([returns(Material.MATTE, base + k * 0.004).mean() for k in range(20)]) for base in (0.6, 0.2)
    )
    assert 2.0 < light / dark < 4.5


def test_paints_of_one_brightness_differ():
    means = [returns(Material.MATTE, 0.5 + k * 0.002).mean() for k in range(20)]
    assert max(means) / min(means) > 1.5


def test_the_return_falls_with_the_cosine_of_the_angle():
    straight, slanted = (returns(Material.MATTE, turned_deg=angle).mean() for angle in (0.0, 60.0))
    assert slanted / straight == pytest.approx(0.5, rel=0.15)


def test_leaves_are_bright_though_they_look_dark():
    assert returns(Material.FOLIAGE, 0.12).mean() > 3 * returns(Material.GROUND, 0.12).mean()


def test_grass_is_brighter_than_asphalt_and_markings_more_than_paving():
    grass, asphalt, paving, marking = (
        returns(Material.GROUND, cover=cover).mean()
        for cover in (Cover.GRASS, Cover.ASPHALT, Cover.PAVING, Cover.MARKING)
    )
    assert grass > 3 * asphalt
    assert marking > 2 * paving


def test_a_pane_hardly_answers():
    assert returns(Material.GLASS).max() <= PANE


def test_wet_walls_return_less():
    assert returns(Material.MATTE, condition="rain").mean() < 0.8 * returns(Material.MATTE).mean()


def test_returns_are_shares():
    found = returns(Material.GROUND, cover=Cover.MARKING)
    assert found.min() >= 0.0
    assert found.max() <= 1.0
