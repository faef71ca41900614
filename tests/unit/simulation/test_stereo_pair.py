"""Stereo-matched depth of a wall at a known distance, and the effect of a rectification error."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from model_training.datasets.dataset import Dataset
from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import DepthParameters, StereoParameters
from model_training.simulation.simulate import simulate
from model_training.simulation.stereo_pair import FEWEST_DISPARITIES, NEAREST_M, SIZES, STEREOS, StereoRig
from service.errors import DatasetError
from service.geometry.camera import PinholeCamera

CAMERA = PinholeCamera(320, 240, 160.0, 160.0, 159.5, 119.5)
PERFECT = replace(STEREOS["sgbm"], focal_baseline_px_m=80.0, offset_px=0.0, vertical_px=0.0, roll_px=0.0)


def drawn(model, seed=0):
    return StereoRig.drawn(model, CAMERA, np.random.default_rng(seed))


def wall_pair(disparity):
    """Return a textured plane perpendicular to the axis."""
    texture = np.random.default_rng(0).integers(0, 255, (240, 320 + disparity, 3), np.uint8)
    return texture[:, :320].copy(), texture[:, disparity:].copy()


def test_a_perfect_rig_has_its_right_camera_a_baseline_to_the_right():
    """80 px m over a focal length of 160 px are 0.5 m."""
    rig = drawn(PERFECT)
    assert rig.baseline_m == pytest.approx(0.5)
    expected = np.eye(4)
    expected[0, 3] = 0.5
    np.testing.assert_allclose(rig.T_left_right, expected, atol=1e-12)


@pytest.mark.parametrize("name", list(STEREOS))
def test_depth_is_focal_length_times_baseline_over_disparity(name):
    left, right = wall_pair(8)
    depth_m = drawn(replace(STEREOS[name], offset_px=0.0, vertical_px=0.0, roll_px=0.0)).depth(left, right)
    measured = depth_m[depth_m > 0]
    assert len(measured) > 0.5 * depth_m.size
    assert np.median(measured) == pytest.approx(80.0 / 8, rel=0.01)


def test_values_out_of_range_are_not_measured():
    left, right = wall_pair(8)
    assert not drawn(replace(PERFECT, max_range_m=9.0)).depth(left, right).any()
    assert not drawn(replace(PERFECT, min_range_m=11.0)).depth(left, right).any()


@pytest.mark.parametrize("seed", range(8))
def test_an_offset_shifts_a_distant_point_by_its_size(seed):
    """A camera rotated about its vertical axis sees a point at infinity straight ahead at fx * tan(angle)."""
    rig = drawn(replace(PERFECT, offset_px=2.0), seed)
    ahead = rig.T_left_right[:3, :3].T @ [0.0, 0.0, 1.0]
    moved_px = abs(CAMERA.fx * ahead[0] / ahead[2])
    assert SIZES[0] * 2.0 - 1e-3 <= moved_px <= SIZES[1] * 2.0 + 1e-3
    assert abs(ahead[1]) < 1e-12


def test_errors_of_rectification_take_both_signs():
    turns = [drawn(replace(PERFECT, offset_px=1.0), seed).T_left_right[0, 2] for seed in range(20)]
    assert min(turns) < 0 < max(turns)


@pytest.mark.parametrize(
    ("focal_baseline_px_m", "disparities"), [(80.0, FEWEST_DISPARITIES), (384.0, 128), (390.0, 144)]
)
def test_the_matcher_searches_as_near_as_the_nearest_distance(focal_baseline_px_m, disparities):
    rig = drawn(replace(PERFECT, focal_baseline_px_m=focal_baseline_px_m))
    assert rig.model.matching.disparities == disparities
    assert focal_baseline_px_m / disparities <= NEAREST_M


def pair_plan(**changed):
    query = QueryPlan(
        name="a", traversal=1, count=2, depths=("sgbm",), stereo_parameters=StereoParameters(focal_baseline_px_m=60.0)
    )
    given = {
        "name": "pairs",
        "seed": 3,
        "size_m": (60.0, 60.0),
        "spacing_m": 30.0,
        "camera": CameraPlan(width=240, height=160),
        "queries": (query,),
    }
    return SimulationPlan(**(given | changed))


def test_a_simulated_pair_measures_the_street_and_the_dataset_knows_its_baseline(tmp_path):
    simulate(pair_plan(), tmp_path / "pairs", workers=1)
    dataset = Dataset(tmp_path / "pairs")
    camera = dataset.description.sensors.cameras[0]
    assert camera.depth.baseline_m == pytest.approx(60.0 / camera.fx)
    ideal = QueryPlan(name="a", traversal=1, count=2, depths=("ideal",))
    simulate(pair_plan(queries=(ideal,)), tmp_path / "ideal", workers=1)
    for seen, true in zip(dataset.queries("a_sgbm"), Dataset(tmp_path / "ideal").queries("a_ideal"), strict=True):
        matched, truth = seen.depth_m(), true.depth_m()
        assert seen.T_map_camera is not None
        assert true.T_map_camera is not None
        np.testing.assert_allclose(seen.T_map_camera, true.T_map_camera)
        both = (matched > 0) & (truth > 0)
        assert both.mean() > 0.2
        error_px = 60.0 * np.abs(1 / matched[both] - 1 / truth[both])
        assert np.median(error_px) < 1.5
    assert np.array_equal(
        next(iter(dataset.queries("a_sgbm"))).depth_m(), _again(tmp_path, "pairs-again")
    )  # the same seed, the same bytes


def _again(tmp_path, name):
    simulate(pair_plan(), tmp_path / name, workers=2)
    return next(iter(Dataset(tmp_path / name).queries("a_sgbm"))).depth_m()


def query_of(**changed):
    return QueryPlan(**({"name": "a", "traversal": 1} | changed))


@pytest.mark.parametrize(
    ("queries", "field"),
    [
        ((query_of(depths=("sgbm", "precise")),), "depth"),
        ((query_of(depths=("sgbm",)), query_of(name="b", depths=("stereo",))), "depth"),
        ((query_of(depths=("sgbm",), depth_parameters=DepthParameters(noise_px=1)),), "depth_parameters"),
        ((query_of(depths=("stereo",), stereo_parameters=StereoParameters(offset_px=1)),), "stereo_parameters"),
        (
            (
                query_of(depths=("bm",)),
                query_of(name="b", depths=("bm",), stereo_parameters=StereoParameters(roll_px=1)),
            ),
            "stereo_parameters",
        ),
    ],
)
def test_impossible_rigs_and_options_without_effect_are_refused(queries, field):
    with pytest.raises(DatasetError) as refused:
        SimulationPlan(name="x", queries=queries).checked()
    assert refused.value.field == field


def test_numbers_out_of_bounds_are_refused():
    with pytest.raises(ValidationError):
        StereoParameters(focal_baseline_px_m=0.0)
