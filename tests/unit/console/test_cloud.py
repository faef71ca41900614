"""Clouds and tracks as a browser receives them."""

import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from service.console.cloud import LEVELS, Clouds, cloud_bytes, places_bytes, thinned
from service.maps.reader import MapBundle
from service.registration.kernel import SURFEL
from service.registration.surfel_map import SurfelMap

RECORD = np.dtype([("xyz", "<u2", (3,)), ("upright", "<u2")])


@pytest.fixture(scope="module")
def bundle(bundle_path: Any) -> MapBundle:
    return MapBundle.open(bundle_path)


def read(content: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return points in the map frame, and the vertical component of each normal."""
    assert content[:4] == b"SFC1"
    count, *numbers = struct.unpack_from("<I6d", content, 4)
    records = np.frombuffer(content, RECORD, offset=56)
    assert len(records) == count
    return np.array(numbers[:3]) + records["xyz"] * np.array(numbers[3:]), records["upright"] / 65535


def a_field(columns: int, rows: int) -> SurfelMap:
    """Return flat ground with a point every 0.2 m."""
    surfels = np.zeros(columns * rows, SURFEL)
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    surfels["xyz"][:, 0], surfels["xyz"][:, 1] = 0.2 * x.ravel(), 0.2 * y.ravel()
    return SurfelMap.prepare(np.zeros(3), surfels)


def test_every_point_comes_within_a_step_of_where_it_is(bundle: MapBundle) -> None:
    assert bundle.cloud is not None
    points, upright = read(cloud_bytes(bundle.cloud, 1_000_000))
    true = bundle.cloud.unpacked(np.s_[:])["xyz"] + bundle.cloud.origin_m
    order, found = (np.lexsort(np.round(each, 1).T) for each in (true, points))
    assert np.abs(true[order].mean(axis=0) - points[found].mean(axis=0)).max() < 1e-3
    assert np.allclose(np.sort(true, axis=0), np.sort(points, axis=0), atol=2e-3)
    assert upright.min() >= 0
    assert upright.max() <= 1


def test_a_map_without_a_cloud_has_an_empty_one() -> None:
    points, _ = read(cloud_bytes(None, 1000))
    assert points.shape == (0, 3)


@pytest.mark.parametrize("most", [100, 1000, 3000])
def test_thinning_keeps_within_the_limit_and_leaves_no_gap(most: int) -> None:
    field = a_field(120, 40)
    rows = thinned(field, most)
    assert len(np.unique(rows)) == len(rows) <= most
    assert len(rows) > 0.3 * most
    kept = field.unpacked(rows)["xyz"]
    spacing = np.sqrt(24.0 * 8.0 / most)
    gaps = [np.hypot(*(kept[:, :2] - xy).T).min() for xy in ([1.0, 1.0], [12.0, 4.0], [23.0, 7.0])]
    assert max(gaps) < 3 * spacing


def test_a_cloud_that_is_small_enough_is_not_thinned() -> None:
    assert len(thinned(a_field(10, 10), 100)) == 100


def test_any_beginning_is_a_thinner_cloud_of_the_whole_map() -> None:
    points, _ = read(cloud_bytes(a_field(120, 40), 10_000))
    begun = points[:200]
    assert begun[:, 0].min() < 3
    assert begun[:, 0].max() > 21


def test_the_requested_size_is_rounded_down_to_a_level_and_kept(bundle: MapBundle) -> None:
    clouds = Clouds()
    first = clouds.of(bundle, LEVELS[2] + 1)
    assert clouds.of(bundle, LEVELS[2] + 2) is first
    assert read(clouds.of(bundle, 1))[0].shape[0] <= LEVELS[0]


def test_only_the_last_clouds_are_kept(bundle: MapBundle) -> None:
    clouds = Clouds()
    first = clouds.of(bundle, LEVELS[0])
    for level in LEVELS[1:4]:
        clouds.of(bundle, level)
    assert clouds.of(bundle, LEVELS[0]) is not first


def test_places_come_with_heading_and_street(bundle: MapBundle) -> None:
    content = places_bytes(bundle)
    assert content[:4] == b"SFP1"
    count, *origin = struct.unpack_from("<I3d", content, 4)
    records = np.frombuffer(
        content, np.dtype([("xyz", "<f4", (3,)), ("heading_rad", "<f4"), ("street", "<i4")]), offset=32
    )
    assert len(records) == count == len(bundle.places)
    assert np.allclose(records["xyz"] + origin, bundle.T_map_place[:, :3, 3], atol=1e-4)
    assert np.allclose(records["heading_rad"], 0)
    assert np.array_equal(records["street"], bundle.place_street)


def test_a_map_without_a_cloud_can_be_drawn(bundle: MapBundle) -> None:
    assert Clouds().of(replace(bundle, cloud=None), 1000)[:4] == b"SFC1"
