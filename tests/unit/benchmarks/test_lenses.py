"""Simulated queries through a lens get the poses that a pinhole camera gets, on a small map with the stock encoder."""

import numpy as np
import pytest

from benchmarks.lenses import LENSES, Answered, Photographer, answered, cost_line, line_of
from model_training.simulation.plan import SimulationPlan
from service.geometry.camera import PinholeCamera
from service.geometry.distortion import rays_of
from service.imaging.decode import decode_depth
from service.imaging.rectify import rectification_of
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.query import DepthFormat, decoded_query

SMALL = 0.5


@pytest.fixture(scope="module")
def photographer(small_dataset):
    plan = SimulationPlan.model_validate(small_dataset.description.source["plan"])
    return Photographer(small_dataset, plan)


@pytest.fixture(scope="module")
def localizer(stock_map):
    return Localizer.open(MapBundle.open(stock_map))


def small(camera: PinholeCamera) -> PinholeCamera:
    return camera.scaled_to(round(SMALL * camera.width), round(SMALL * camera.height))


def errors_of(photographer, localizer, camera):
    """Depth without noise, so that only the lens differs."""
    grid, queries = localizer.bundle.grid, []
    for number in range(len(photographer.poses)):
        rgb, depth = photographer.encoded(camera, number, "ideal")
        queries.append(decoded_query(rgb, depth, camera, DepthFormat(), grid=grid))
    return queries, answered(localizer, queries, photographer.poses)


@pytest.mark.parametrize("name", LENSES)
def test_a_lens_moves_the_pose_by_centimetres(photographer, localizer, name):
    """Images are rendered along the rays of the lens, and along those of the pinhole with the field of the rectified image."""
    lens = small(LENSES[name])
    queries, bent = errors_of(photographer, localizer, lens)
    pinhole = rectification_of(lens).camera
    assert all(query.camera == pinhole for query in queries)
    _, plain = errors_of(photographer, localizer, pinhole)
    found = plain.error_m < 0.2  # the pinhole camera is 1.8 m off at one pose of this small map
    assert found.sum() >= 4
    off_m = np.abs(bent.error_m - plain.error_m)[found]
    assert off_m.max() < 0.08
    assert np.median(off_m) < 0.03


def test_a_lens_renders_what_its_rays_meet(photographer):
    """A pixel of the lens has the depth of the pinhole pixel that looks along the same ray."""
    lens, pinhole = small(LENSES["brown_conrady"]), PinholeCamera(640, 480, 250.0, 250.0, 319.5, 239.5)
    bent, plain = (
        decode_depth(photographer.encoded(camera, 0, "ideal")[1], camera=camera) for camera in (lens, pinhole)
    )
    pixels = np.stack(np.meshgrid(np.arange(20.0, 300, 20), np.arange(20.0, 220, 20)), axis=-1)
    rays = rays_of(lens, pixels)
    u, v = (np.rint(250 * rays[..., k] / rays[..., 2] + c).astype(int) for k, c in ((0, 319.5), (1, 239.5)))
    one, other = bent[pixels[..., 1].astype(int), pixels[..., 0].astype(int)], plain[v, u]
    both = (one > 0) & (other > 0)
    assert both.mean() > 0.5
    assert np.mean(np.abs(one - other)[both] < 0.05 * one[both]) > 0.9


def test_a_row_counts_what_is_right_and_what_is_accepted():
    found = Answered(np.array([0.1, 0.3, 2.0, np.inf]), np.array([True, False, True, False]))
    assert line_of("fisheye", found) == "| fisheye | 2 of 4 | 1 | 1 | 0.200 m |"


def test_the_tables_have_a_row_for_each_camera():
    assert cost_line("fisheye", small(LENSES["kannala_brandt"]), rounds=2).startswith("| fisheye, 320 x 240 | ")
