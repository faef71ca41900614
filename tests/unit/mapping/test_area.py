import tracemalloc

import cv2
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from model_training.mapping.area import CELL_M, covered_by


@given(seed=st.integers(0, 10**6), points=st.integers(1, 200), apart_m=st.sampled_from([0.0, 600.0, 60_000.0]))
@settings(max_examples=30, deadline=None)
def test_covered_cells_are_those_of_a_closed_image(seed, points, apart_m):
    rng = np.random.default_rng(seed)
    places = rng.uniform(-20, 20, (4, 2))
    seen = places[rng.integers(0, 4, points)] + rng.uniform(-24, 24, (points, 2)) / np.sqrt(2)
    town = rng.integers(-1, 2, 2) * apart_m
    plan = np.zeros((100, 100), np.uint8)
    at = np.floor(np.concatenate([seen, places]) / CELL_M).astype(int) + 50
    plan[at[:, 0], at[:, 1]] = 1
    closed = cv2.morphologyEx(plan, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    cells = np.stack(np.meshgrid(np.arange(100), np.arange(100), indexing="ij"), axis=-1).reshape(-1, 2)
    centres = (cells - 50 + 0.5) * CELL_M
    away = np.linalg.norm(centres[:, None] - places, axis=2).min(axis=1) > 4.0  # nearer cells always count
    inside = covered_by(np.concatenate([seen, seen + town]), np.concatenate([places, places + town]))
    for shift in (0, town):
        np.testing.assert_array_equal(inside(centres + shift)[away], closed.ravel()[away] > 0)


def test_an_area_of_two_towns_60_km_apart_takes_no_memory_for_the_ground_between():
    town = np.random.default_rng(0).uniform(-17, 17, (1000, 2))
    points = np.concatenate([town, town + [45_000.0, 40_000.0]])
    tracemalloc.start()
    inside = covered_by(points, np.array([[0.0, 0.0], [45_000.0, 40_000.0]]))
    assert inside(points).all()
    assert not inside(np.array([[20_000.0, 20_000.0]])).any()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6  # bytes; an image of the box has 450 million cells
