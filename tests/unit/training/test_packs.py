import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.simulation.city import City  # after the skip
from model_training.simulation.meshes import joined
from model_training.simulation.plan import CameraPlan
from model_training.simulation.scene import Scene
from model_training.simulation.stereo_pair import STEREOS
from model_training.simulation.traversal import upright_on
from model_training.training import packs as module
from model_training.training.matched_views import MatchedRig
from model_training.training.packs import OWN_DRIVES, Pack, PackPlan, make_pack, make_packs, rows_seen_by
from model_training.training.random_rigs import FIELD_OF_VIEW_DEG, FOCAL_BASELINE_PX_M, HEIGHT_M, random_rigs
from model_training.training.recipe import (
    CALIBRATION_SEEDS,
    EVALUATION_SEEDS,
    RECIPES,
    STOCK_CITIES,
    TRAINING_SEEDS,
    VALIDATION_SEEDS,
    more_street_plans,
    paper_plans,
    stock_plans,
    street_plans,
    validation_plans,
)
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid

PLAN = PackPlan(seed=1002, places=6, queries_a_place=2, lidar="hdl_64", size_m=(60.0, 60.0))


@pytest.fixture(scope="module")
def pack(grid, tmp_path_factory):
    folder = tmp_path_factory.mktemp("packs") / PLAN.stem
    make_pack(PLAN, folder, grid)
    return Pack.open(folder)


def test_a_pack_holds_what_its_plan_says(pack, grid):
    assert pack.panoramas.shape == (6, grid.rows, grid.around)
    assert pack.intensities.shape == pack.panoramas.shape
    assert pack.ranges.shape == (12, grid.rows, grid.columns)
    assert pack.rgb.shape == (12, grid.rows, grid.columns, 3)
    assert (pack.places.shape, pack.queries.shape) == ((6, 4), (12, 4))


def test_every_query_has_a_place_within_reach(pack):
    distances = np.linalg.norm(pack.queries[:, None, :2] - pack.places[None, :, :2], axis=2)
    assert distances.min(axis=1).max() <= 2.0 + 1e-6


def test_panoramas_and_queries_measure_something(pack):
    assert (np.asarray(pack.panoramas) > 0).mean() > 0.2
    assert (np.asarray(pack.ranges) > 0).mean() > 0.3
    assert np.asarray(pack.rgb).std() > 10


def test_rows_above_a_lidar_that_looks_down_are_not_seen(pack, grid):
    elevations = np.rad2deg(grid.elevations_rad)
    assert not pack.rows_seen[elevations > 5].any()
    assert pack.rows_seen[elevations < 0].all()


def test_heights_are_those_of_sensors(pack):
    assert np.abs(pack.places[:, 3] - 1.8).max() < 0.4
    assert ((pack.queries[:, 3] >= 1.2) & (pack.queries[:, 3] <= 1.9)).all()


def test_one_seed_gives_one_pack(pack, grid, tmp_path):
    make_pack(PLAN, tmp_path / "again", grid)
    again = Pack.open(tmp_path / "again")
    for name in set(Pack.__annotations__) - {"seen"}:
        np.testing.assert_array_equal(getattr(pack, name), getattr(again, name))


def test_a_pack_that_fails_half_way_is_not_there(grid, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr(module, "_queries", fail)
    with pytest.raises(OSError, match="full"):
        make_pack(PLAN, tmp_path / "half", grid)
    assert not (tmp_path / "half").exists()


def test_remains_of_a_stopped_run_do_no_harm(pack, grid, tmp_path):
    (tmp_path / "new.part").mkdir()
    (tmp_path / "new.part" / "places.npy").write_bytes(b"half")
    make_pack(PLAN, tmp_path / "new", grid)
    np.testing.assert_array_equal(Pack.open(tmp_path / "new").places, pack.places)
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_pack_that_another_process_makes_meanwhile_stays(grid, tmp_path, monkeypatch):
    """A killed training leaves processes that simulate. The next training makes the same city beside them."""
    folder = tmp_path / "city"

    def meanwhile(*_):
        folder.mkdir()
        (folder / "places.npy").write_bytes(b"of the other process")
        return {}

    monkeypatch.setattr(module, "_queries", meanwhile)
    make_pack(PLAN, folder, grid)
    assert (folder / "places.npy").read_bytes() == b"of the other process"
    assert [path.name for path in tmp_path.iterdir()] == ["city"]


def test_packs_that_are_there_are_not_made_again(grid, tmp_path):
    plans = [PackPlan(seed=1000 + k) for k in range(3)]
    for plan in plans:
        (tmp_path / plan.stem).mkdir()
    told = []
    folders = make_packs(plans, tmp_path, grid, report=lambda *event: told.append(event))
    assert folders == [tmp_path / plan.stem for plan in plans]
    assert told == []


def test_rows_with_hardly_a_measurement_are_not_seen():
    panoramas = np.zeros((4, 3, 100), np.float16)
    panoramas[:, 1, :1], panoramas[:, 2, :50] = 9.0, 9.0
    assert rows_seen_by(panoramas).tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("one", "other"),
    [*itertools.combinations([TRAINING_SEEDS, VALIDATION_SEEDS, CALIBRATION_SEEDS, EVALUATION_SEEDS], 2)],
)
def test_seeds_of_training_watching_calibration_and_evaluation_are_disjoint(one, other):
    assert not set(one) & set(other)


def test_the_stock_encoder_is_not_trained_on_evaluation_cities():
    plans = stock_plans(200)
    assert {plan.name for plan in plans} == {"city"}
    assert {plan.seed for plan in plans} <= set(TRAINING_SEEDS)
    assert len({plan.seed for plan in plans}) == 200


def test_training_is_watched_on_cities_of_its_own():
    assert {plan.seed for plan in validation_plans()} <= set(VALIDATION_SEEDS)


def test_the_trainings_on_many_small_cities_share_only_cities_of_the_stock_recipe():
    first, second = street_plans(), more_street_plans()
    seeds = [{plan.seed for plan in plans} for plans in (first, second)]
    stock = {plan.seed for plan in stock_plans(STOCK_CITIES)}
    assert [len(each) for each in seeds] == [len(first), len(second)] == [60, 53]
    assert seeds[0] | seeds[1] <= set(TRAINING_SEEDS)
    assert not seeds[0] & seeds[1]
    assert len(seeds[0] & stock) == 11
    assert not seeds[1] & stock
    assert RECIPES["streets"](1) == first
    assert RECIPES["more-streets"](1) == second


@pytest.mark.parametrize(("plans", "matched"), [(street_plans(), 41), (more_street_plans(), 35)])
def test_many_small_cities_have_matched_depth_and_cameras_of_all_heights(plans, matched):
    assert sum(bool(plan.rigs) for plan in plans) == matched
    assert {plan.name for plan in plans} == {"city", "mixed"}
    assert sum(plan.camera_height_m == HEIGHT_M for plan in plans if not plan.rigs) in (7, 8)


def test_random_rigs_cover_the_range_and_no_two_are_the_same():
    rigs = random_rigs(5, 200)
    assert rigs == random_rigs(5, 200)
    assert len(set(rigs)) == 200
    heights = [math.sqrt(rig.height_m[0] * rig.height_m[1]) for rig in rigs]
    assert HEIGHT_M[0] * 0.99 < min(heights) < 0.4
    assert 2.5 < max(heights) < HEIGHT_M[1] * 1.01
    baselines = [rig.model.focal_baseline_px_m for rig in rigs]
    assert FOCAL_BASELINE_PX_M[0] <= min(baselines) < 30
    assert 170 < max(baselines) <= FOCAL_BASELINE_PX_M[1]
    fields = [2 * math.degrees(math.atan(rig.camera.width / 2 / rig.camera.fx)) for rig in rigs]
    assert FIELD_OF_VIEW_DEG[0] <= min(fields) < max(fields) <= FIELD_OF_VIEW_DEG[1]
    assert {rig.model.matching for rig in rigs} == {stereo.matching for stereo in STEREOS.values()}
    assert [rig.condition for rig in rigs[:4]] == ["hard_light", "clear", "hard_light", "clear"]


def test_the_height_of_the_survey_and_of_clean_queries_follows_the_plan(tmp_path):
    plan = replace(PLAN, lidar_height_m=1.2, camera_height_m=(0.4, 0.5))
    make_pack(plan, tmp_path / plan.stem, ViewGrid())
    pack = Pack.open(tmp_path / plan.stem)
    assert plan.stem != PLAN.stem
    assert np.median(pack.places[:, 3]) == pytest.approx(1.2, abs=0.2)
    assert ((pack.queries[:, 3] >= 0.4) & (pack.queries[:, 3] <= 0.5)).all()


RIG = MatchedRig(
    CameraPlan(width=160, height=96, horizontal_deg=70.0).pinhole(),
    (1.4, 1.6),
    replace(STEREOS["sgbm"], focal_baseline_px_m=60.0, offset_px=0.1, vertical_px=0.05, roll_px=0.05),
)
MATCHED = PackPlan(seed=1001, places=8, queries_a_place=1, size_m=(120.0, 120.0), rigs=(RIG,))


@pytest.fixture(scope="module")
def matched(tmp_path_factory):
    folder = tmp_path_factory.mktemp("matched") / MATCHED.stem
    make_pack(MATCHED, folder, ViewGrid())
    return Pack.open(folder)


def test_matched_views_are_seen_by_a_camera_and_have_depth_within_it(matched):
    assert matched.seen is not None
    share = matched.seen.mean(axis=(1, 2))
    # 70 of the grid's 90 degrees of azimuth, and elevations beyond the picture's +-22.8 do not occur
    assert np.all((share > 0.6) & (share < 0.85))
    assert not (matched.ranges[~matched.seen] > 0).any()
    assert (matched.ranges[matched.seen] > 0).mean() > 0.4


def test_one_seed_gives_one_matched_pack(matched, tmp_path):
    make_pack(MATCHED, tmp_path / MATCHED.stem, ViewGrid())
    again = Pack.open(tmp_path / MATCHED.stem)
    for name in Pack.__annotations__:
        np.testing.assert_array_equal(getattr(matched, name), getattr(again, name), err_msg=name)


def test_a_matched_pack_that_lost_its_mask_is_refused(tmp_path, matched):
    folder = tmp_path / MATCHED.stem
    folder.mkdir()
    for name in set(Pack.__annotations__) - {"seen"}:
        np.save(folder / f"{name}.npy", getattr(matched, name))
    with pytest.raises(DatasetError, match=r"seen\.npy"):
        Pack.open(folder)


def test_other_rigs_give_other_packs():
    brighter = replace(RIG, exposure_ev=(0.5, 0.5))
    assert replace(MATCHED, rigs=(brighter,)).stem != MATCHED.stem != replace(MATCHED, rigs=(RIG, RIG)).stem


def test_matched_depth_errs_as_matching_does(matched):
    """The pose is stored, so the true depth can be rendered. Matched depth is close to it but not equal."""
    city = City(seed=MATCHED.seed, name=MATCHED.name, size_m=MATCHED.size_m)
    scene = Scene(joined([city.static, city.occupants(OWN_DRIVES)]))
    rays = ViewGrid().rays_level().reshape(-1, 3)
    errors = []
    for found, (x, y, heading, height) in zip(matched.ranges, matched.queries, strict=True):
        R = upright_on(city, x, y, heading)
        true = scene.distances(np.array([x, y, city.height(x, y) + height]), (rays @ R.T).astype(np.float32))
        both = (found.reshape(-1) > 0) & (true > 0) & (true < 15)
        errors.append(np.abs(found.reshape(-1)[both] / true[both] - 1))
    error = np.median(np.concatenate(errors))
    assert 0.002 < error < 0.08


def test_a_pack_without_matching_has_no_mask(pack):
    assert pack.seen is None


def test_the_papers_city_is_only_in_its_own_recipe():
    assert {plan.name for plan in paper_plans()} == {"paper"}
    assert {plan.name for plan in stock_plans(50) + validation_plans()} == {"city"}
    assert not {plan.name for plan in street_plans() + more_street_plans()} - {"city", "mixed"}


def test_plans_that_differ_have_packs_of_their_own():
    plans = [
        PLAN,
        PackPlan(seed=1001),
        PackPlan(seed=1002),
        PackPlan(seed=1001, lidar="vlp_16"),
        PackPlan(seed=1001, name="paper"),
    ]
    assert len({plan.stem for plan in plans}) == len(plans)
