import numpy as np
import pytest

from model_training.simulation.blocker import Blocker
from model_training.simulation.camera import take, unit_rays
from model_training.simulation.conditions import CONDITIONS
from model_training.simulation.exposure import RGBS, exposed
from model_training.simulation.meshes import Material, MeshBuilder
from model_training.simulation.scene import Scene
from model_training.simulation.sensor_parameters import RgbParameters
from model_training.simulation.shading import Light, shade
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from
from service.imaging.view_grid import ViewGrid

CAMERA = PinholeCamera(96, 72, 48.0, 48.0, 47.5, 35.5)
GRID = ViewGrid()
CLEAR = CONDITIONS["clear"]


def pose(*, heading_deg=0.0, x_m=0.0, z_m=1.5):
    return transform_from(rotation_z(np.deg2rad(heading_deg)) @ R_BODY_OPTICAL, np.array([x_m, 0.0, z_m]))


def picture_of(wall, condition_name="clear", *, seed=0, T_map_camera=None, blocker=None, model=RGBS["automatic"]):
    condition = CONDITIONS[condition_name]
    rays, z = unit_rays(CAMERA)
    light = Light.of(condition, np.random.default_rng(seed))
    return take(
        wall.scene,
        wall.ground,
        CAMERA,
        pose() if T_map_camera is None else T_map_camera,
        light,
        condition,
        model,
        np.random.default_rng(seed),
        rays_camera=rays,
        z_of_ray=z,
        blocker=blocker,
    )


def test_depth_of_a_wall_square_to_the_axis_is_its_distance(wall):
    depth_m = picture_of(wall).depth_m
    np.testing.assert_allclose(depth_m, wall.x_m, rtol=1e-5)


def test_the_sky_has_no_depth(wall):
    assert not picture_of(wall, T_map_camera=pose(heading_deg=180)).depth_m.any()


def test_pictures_are_neither_black_nor_white(wall):
    rgb = picture_of(wall).rgb
    assert 60 < rgb.mean() < 210


def test_matte_walls_are_blank_to_stereo_and_the_sky_is_not(wall):
    assert picture_of(wall).blank.all()
    assert not picture_of(wall, T_map_camera=pose(heading_deg=180)).blank.any()


def linear_light(wall, condition_name, azimuth_deg, *, x_m):
    """Return the linear light from the wall at an azimuth off the optical axis."""
    azimuth = np.deg2rad(azimuth_deg)
    rays = np.array([[np.cos(azimuth), np.sin(azimuth), 0.0]], np.float32)
    origin, condition = np.array([x_m, 0.0, 1.5]), CONDITIONS[condition_name]
    light = Light.of(condition, np.random.default_rng(0))
    colour = shade(
        wall.scene,
        wall.ground,
        origin,
        rays,
        wall.scene.hits(origin, rays),
        light,
        condition,
        forward=np.array([1.0, 0, 0]),
    )
    return float(colour.mean())


def test_night_is_dark_beyond_the_headlights(wall):
    night, clear = (linear_light(wall, name, 40.0, x_m=12.0) for name in ("night", "clear"))
    assert night < 0.05 * clear


def test_headlights_light_what_is_near_and_ahead(wall):
    near = linear_light(wall, "night", 0.0, x_m=14.0)
    assert near > 5 * linear_light(wall, "night", 0.0, x_m=-30.0)
    assert near > 20 * linear_light(wall, "night", 40.0, x_m=14.0)


def test_fog_brightens_distant_surfaces(wall):
    """At a distance beyond the visibility, the wall has the colour of the air."""
    light = Light.of(CONDITIONS["fog"], np.random.default_rng(0))
    assert linear_light(wall, "fog", 0.0, x_m=-60.0) == pytest.approx(float(light.horizon.mean()), rel=0.02)


def test_rain_and_snow_are_seen_in_the_air(wall):
    for name in ("rain", "snow"):
        picture = picture_of(wall, name).rgb.astype(float).mean(axis=2)
        still = picture_of(wall, "clear").rgb.astype(float).mean(axis=2)
        assert np.percentile(picture, 99) - np.median(picture) > 1.5 * (np.percentile(still, 99) - np.median(still))


def test_a_shadow_falls_away_from_the_sun():
    builder = MeshBuilder()
    ground = np.array([[[-50, -50, 0], [50, -50, 0], [50, 50, 0]], [[-50, -50, 0], [50, 50, 0], [-50, 50, 0]]], float)
    builder.triangles(ground, np.full(3, 0.4), Material.MATTE)
    builder.box(np.array([0.0, 0.0, 0.0]), (1.0, 1.0, 4.0), 0.0, np.full(3, 0.4), Material.MATTE)
    scene = Scene(builder.mesh())
    toward_sun = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)
    lit = scene.lit(np.array([[-2.0, 0.0, 0.05], [2.0, 0.0, 0.05]], np.float32), toward_sun)
    assert lit.tolist() == [False, True]


def columns_behind(blocker, T_map_camera):
    """Return the share of the columns of the view grid that the body blocks at camera height."""
    azimuths = GRID.azimuths_rad
    rays_level = np.stack([np.cos(azimuths), np.sin(azimuths), np.zeros(len(azimuths))], axis=1)
    R_map_level = T_map_camera[:3, :3] @ R_BODY_OPTICAL.T
    distances = blocker.scene.distances(T_map_camera[:3, 3], rays_level @ R_map_level.T)
    return np.mean(distances > 0), distances[distances > 0]


@pytest.mark.parametrize("seed", range(12))
def test_a_blocker_hides_the_wanted_share_of_the_columns(seed):
    T = pose(heading_deg=30.0 * seed)
    share, _ = columns_behind(Blocker.before(T, 0.0, 0.25, np.random.default_rng(seed)), T)
    assert share == pytest.approx(0.25, abs=0.03)


def test_a_blocker_stands_three_to_eight_metres_away():
    T = pose()
    nearest = [
        columns_behind(Blocker.before(T, 0.0, 0.25, np.random.default_rng(seed)), T)[1].min() for seed in range(30)
    ]
    assert min(nearest) >= 2.99
    assert max(nearest) <= 8.01


def test_a_blocker_is_in_depth_and_colour(wall):
    T = pose()
    blocked = picture_of(wall, blocker=Blocker.before(T, 0.0, 0.25, np.random.default_rng(1)))
    hidden = blocked.depth_m < 10
    assert 0.1 < hidden.mean() < 0.4
    contrast = np.abs(blocked.rgb[hidden].mean(axis=0) - blocked.rgb[~hidden].mean(axis=0)).max()
    assert contrast > 5


def test_one_seed_gives_one_picture(wall):
    one, other = picture_of(wall, "snow", seed=4), picture_of(wall, "snow", seed=4)
    np.testing.assert_array_equal(one.rgb, other.rgb)


def grey(value, shape=(48, 64)):
    return np.full((*shape, 3), value, np.float32)


def test_a_metered_picture_is_as_bright_in_half_the_light():
    bright, dim = (exposed(grey(light), RGBS["automatic"], CLEAR, np.random.default_rng(1)) for light in (0.4, 0.2))
    assert abs(float(bright.mean()) - float(dim.mean())) < 3


def test_a_fixed_exposure_is_darker_in_half_the_light():
    bright, dim = (exposed(grey(light), RGBS["fixed"], CLEAR, np.random.default_rng(1)) for light in (0.4, 0.2))
    assert dim.mean() < 0.85 * bright.mean()


@pytest.mark.parametrize("preset", ["automatic", "fixed"])
def test_a_stop_more_is_brighter_by_as_much_as_twice_the_light(preset):
    plain = RGBS["fixed"]
    one_more = exposed(grey(0.2), RgbParameters(exposure_ev=1.0).on(preset), CLEAR, np.random.default_rng(1))
    assert one_more.mean() > exposed(grey(0.2), RgbParameters().on(preset), CLEAR, np.random.default_rng(1)).mean() + 20
    if preset == "fixed":
        assert (
            abs(float(one_more.mean()) - float(exposed(grey(0.4), plain, CLEAR, np.random.default_rng(1)).mean())) < 2
        )


def test_noise_has_the_requested_size():
    quiet = exposed(
        grey(0.3, (200, 200)), RgbParameters(noise=0, noise_per_gain=0).on("automatic"), CLEAR, np.random.default_rng(1)
    )
    loud = exposed(
        grey(0.3, (200, 200)), RgbParameters(noise=8, noise_per_gain=0).on("automatic"), CLEAR, np.random.default_rng(1)
    )
    assert quiet.std() == 0
    # A colour's own noise is half of what all share, and less after it is enlarged.
    assert 8.0 < loud[..., 0].std() < 8.0 * (1 + 0.5**2) ** 0.5


def test_the_sun_has_the_given_direction():
    light = Light.of(CLEAR, np.random.default_rng(0), elevation_deg=30.0, azimuth_deg=90.0)
    np.testing.assert_allclose(light.toward_sun, [0.0, np.cos(np.pi / 6), 0.5], atol=1e-12)


def test_telling_the_sun_draws_no_other_clouds():
    told = Light.of(CLEAR, np.random.default_rng(0), elevation_deg=30.0, azimuth_deg=90.0)
    assert told.clouds == Light.of(CLEAR, np.random.default_rng(0)).clouds


def test_a_machine_vision_camera_answers_in_proportion_and_clips():
    """Display value 0.26 * 1.6 for the metered value 0.26, with noise of about one grey level."""
    quiet = RgbParameters(noise=0.0, noise_per_gain=0.0).on("machine")
    light = grey(0.1)
    light[:, ::2] = 0.2
    picture = exposed(light, quiet, CLEAR, np.random.default_rng(1), metering=1.0)
    dim, bright = picture[:, 1::2].mean(), picture[:, ::2].mean()
    assert bright == pytest.approx(2 * dim, abs=1.0)
    light[:4, :4] = 5.0
    clipped = exposed(light, RGBS["machine"], CLEAR, np.random.default_rng(1), metering=1.0)  # noise and all
    assert (clipped[:3, :3] == 255).all()


def test_a_machine_vision_camera_has_more_contrast_than_one_that_maps_tones():
    light = grey(0.05)
    light[:, 16:] = 0.8
    mapped, in_proportion = (
        exposed(light, RGBS[name], CLEAR, np.random.default_rng(1), metering=1.0) for name in ("automatic", "machine")
    )
    ratio_mapped, ratio = (float(each[:, 17:].mean() / each[:, :15].mean()) for each in (mapped, in_proportion))
    assert ratio == pytest.approx(16.0, rel=0.1)  # as of the light
    assert ratio_mapped < 6.0


def test_shade_is_darker_in_hard_light():
    """A wall that faces away from the sun gets only light of the sky, 0.45 of that of a clear day."""
    rng = [np.random.default_rng(3) for _ in range(2)]
    clear, hard = (Light.of(CONDITIONS[name], each) for name, each in zip(("clear", "hard_light"), rng, strict=True))
    np.testing.assert_allclose(hard.sky, 0.45 * clear.sky, rtol=1e-5)
    np.testing.assert_allclose(hard.sun, clear.sun, rtol=1e-6)
