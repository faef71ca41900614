"""Another rig is a window of the simulated picture: every ray of it sees what it saw before."""

import numpy as np
import pytest

from model_training.calibration.rigs import RIGS, Rig
from service.geometry.camera import PinholeCamera
from service.retrieval.query import Query

CAMERA = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)


@pytest.fixture
def query() -> Query:
    rng = np.random.default_rng(0)
    depth_m = rng.uniform(1, 40, (48, 64)).astype(np.float32)
    return Query(rgb=rng.integers(0, 255, (48, 64, 3), np.uint8), depth_m=depth_m, camera=CAMERA)


def test_a_window_is_cut_out_of_the_middle(query: Query) -> None:
    """Half of 64 columns are 16 to 47, a quarter of 48 rows 18 to 29."""
    seen = Rig("half", 0.5, 0.25, stereo=False).seen(query)
    np.testing.assert_array_equal(seen.depth_m, query.depth_m[18:30, 16:48])
    np.testing.assert_array_equal(seen.rgb, query.rgb[18:30, 16:48])
    assert seen.camera == PinholeCamera(32, 12, 32.0, 32.0, 15.5, 5.5)
    assert seen.baseline_m is None


@pytest.mark.parametrize("rig", RIGS)
def test_every_pixel_keeps_its_ray(query: Query, rig: Rig) -> None:
    seen = rig.seen(query)
    rays = query.camera.rays_of_pixels()
    v, u = np.argwhere(query.depth_m == seen.depth_m[0, 0])[0]
    height, width = seen.depth_m.shape
    np.testing.assert_allclose(seen.camera.rays_of_pixels(), rays[v : v + height, u : u + width])


def test_a_stereo_rig_says_its_baseline(query: Query) -> None:
    """80 px m over a focal length of 32 px are 2.5 m."""
    assert Rig("wide", 1.0, 0.41, stereo=True).seen(query).focal_baseline_px_m == pytest.approx(80.0)


@pytest.mark.parametrize(("width", "height"), [(0.0, 0.5), (0.5, 1.1)])
def test_a_window_beyond_the_picture_is_refused(width: float, height: float) -> None:
    with pytest.raises(ValueError, match="rig odd"):
        Rig("odd", width, height, stereo=False)


def test_a_spinning_lidar_measures_on_its_beams_only(query: Query) -> None:
    """The horizon of this camera lies between rows 23 and 24. A beam 45 degrees up is out of its view."""
    seen = Rig("rings", beams_deg=(0.0, 45.0)).seen(query)
    rows = np.flatnonzero((seen.depth_m > 0).any(axis=1))
    assert set(rows) <= {23, 24}
    assert len(rows) > 0
    np.testing.assert_array_equal(seen.depth_m[rows], query.depth_m[rows])
    np.testing.assert_array_equal(seen.rgb, query.rgb)
