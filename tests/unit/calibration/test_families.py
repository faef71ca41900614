import pytest

from model_training.calibration.families import FAMILIES, FAMILY_CITIES, Family, family_plan, related
from model_training.calibration.plans import SEQUENCE
from model_training.simulation.stereo_pair import STEREOS


def test_there_are_at_least_twelve_families_with_names_of_their_own():
    names = {family.name for family in FAMILIES}
    assert len(names) == len(FAMILIES) >= 12


def test_the_families_differ_in_survey_depth_and_height():
    lidars = {"vlp_16", "hdl_32", "hdl_64", "os1_64", "os1_128", "pandar_64", "livox_mid_360"}
    assert lidars == {family.lidar for family in FAMILIES}
    assert {1.0, 2.0, 5.0, 10.0} <= {family.spacing_m for family in FAMILIES}
    heights = [family.camera_height_m for family in FAMILIES]
    assert min(heights) <= 0.5
    assert max(heights) >= 2.5


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_each_city_of_a_family_is_a_valid_plan_with_half_a_thousand_queries(family: Family):
    plans = [family_plan(family, index).checked() for index in range(FAMILY_CITIES)]
    for plan in plans:
        traversals = [query.traversal for query in plan.queries]
        assert len(set(traversals)) == len(traversals)
        assert 0 not in traversals  # the survey's own
        expected = family.stereo.focal_baseline_px_m if family.matched else None
        assert plan.focal_baseline_px_m() == expected
    assert [plan.queries[-1].sequence for plan in plans] == [None, SEQUENCE]
    assert len({plan.name for plan in plans}) == FAMILY_CITIES
    assert sum(query.count * len(query.depths) for plan in plans for query in plan.queries) >= 500


def test_only_single_queries_of_several_cameras_have_several_frames():
    (family,) = (family for family in FAMILIES if family.cameras > 1)
    queries = family_plan(family, FAMILY_CITIES - 1).queries
    assert [query.cameras for query in queries] == [family.cameras] * (len(queries) - 1) + [None]


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_walls_and_rooms_have_the_depth_of_the_family(family: Family):
    """Stereo matchers have no modelled preset, so ``stereo`` stands for them."""
    model = family.depth_model()
    if family.matched:
        assert set(family.depths) <= set(STEREOS)
        assert model.name == "stereo"
    else:
        assert family.depths == (model.name,)
        assert model.max_range_m == (family.depth.max_range_m or 40.0)


def test_relatives_share_a_lidar_a_camera_a_depth_type_or_a_spacing():
    groups = related()
    assert groups["lidar.hdl_64"] == ("car", "car_sparse")
    assert groups["lidar.vlp_16"] == ("zed2", "d455", "vlp_16")
    assert groups["spacing.2.5_m"] == ("car", "four_cameras")
    assert groups["depth.stereo_matching"] == ("car", "car_sparse", "robot", "zed2", "oak_d", "lorry")
    assert groups["lidar.paper_32"] == ("precise", "stereo", "narrow")
    assert "lidar.pandar_64" not in groups  # one family only: its own row leaves it out
    assert "depth.monocular" not in groups
