import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model_training.mapping.between import PlannedPlaces
from model_training.mapping.survey import travelled_m
from model_training.mapping.tile_area import TILE_MARGIN_M, Square, cloud_margin_m
from model_training.mapping.tiles import columns_and_rows, require_tile_edge, tile_parts
from service.errors import DatasetError
from service.imaging.view_grid import MAX_RANGE_M
from service.scoring.rendered_depth import REACH_M


def track(xy):
    """Return poses at positions on the ground."""
    poses = np.tile(np.eye(4), (len(xy), 1, 1))
    poses[:, :2, 3] = xy
    return poses


def parts_of(xy, *, kept=None, tile_m=100.0, between_m=0.0):
    """Return the tiles of a traversal by column and row."""
    poses = track(xy)
    kept = np.arange(len(poses)) if kept is None else np.array(kept)
    found = list(tile_parts(poses, kept, tile_m=tile_m, between_m=between_m, voxel_m=0.3))
    squares = [(part.square.column, part.square.row) for part in found]
    assert squares == sorted(set(squares))
    return dict(zip(squares, found, strict=True))


@pytest.mark.parametrize(
    ("x_m", "column"),
    [(0.0, 0), (99.999, 0), (100.0, 1), (-0.001, -1), (-100.0, -1), (-100.001, -2), (np.nextafter(100.0, 0), 0)],
)
def test_a_square_has_its_lower_edges_and_not_its_upper_ones(x_m, column):
    assert columns_and_rows(np.array([[x_m, 50.0], [50.0, x_m]]), 100.0).tolist() == [[column, 0], [0, column]]


@given(st.floats(-1e6, 1e6), st.floats(50.0, 10_000.0))
def test_products_with_the_edge_decide_as_in_the_format(x_m, tile_m):
    ((column, row),) = columns_and_rows(np.array([[x_m, 0.0]]), tile_m)
    assert column * tile_m <= x_m < (column + 1) * tile_m
    assert row == 0


def test_scans_are_divided_by_their_given_positions():
    found = parts_of([(10, 10), (90, 10), (100, 10), (110, 110), (-5, 10)])
    assert {square: part.order[part.plan.at_scan].tolist() for square, part in found.items()} == {
        (-1, 0): [4],
        (0, 0): [0, 1],
        (1, 0): [2],
        (1, 1): [3],
    }


def test_a_tile_reads_the_scans_that_measure_its_cloud_only():
    """The regions of the tile end at 102.4 m. Its cloud ends 1.6 m further, so the last scan of its cloud stands before 144 m."""
    x_m = [50.0, 143.9, 144.1, -41.5, -41.7]
    found = parts_of([(x, 50.0) for x in x_m])
    assert sorted(found) == [(-1, 0), (0, 0), (1, 0)]
    assert found[0, 0].order.tolist() == [0, 1, 3]
    np.testing.assert_allclose(found[0, 0].travelled_m, travelled_m(track([(x, 50.0) for x in x_m]))[[0, 1, 3]])


def test_a_tile_without_a_neighbour_reads_further():
    """Nobody drove in the square from 50 to 100 m. Its regions end at 102.4 m, and 1.6 m and 40 m more are 144 m."""
    found = parts_of([(25.0, 25.0), (143.9, 25.0), (144.1, 25.0)], tile_m=50.0)
    assert sorted(found) == [(0, 0), (2, 0)]
    assert found[0, 0].order.tolist() == [0, 1]


def test_the_cloud_reaches_what_a_camera_at_the_edge_sees():
    """50 m beyond the square lies the region from 128 to 153.6 m, or from -51.2 m. The cloud has all of it, and 1.6 m more."""
    area = parts_of([(50.0, 50.0)])[0, 0].area
    points = np.array([[155.1, 50.0, 3.0], [155.3, 50.0, 3.0], [-52.7, -52.7, 0.0], [50.0, -52.9, 0.0]])
    assert area.is_in_cloud(points).tolist() == [True, False, True, False]
    assert max(MAX_RANGE_M, REACH_M) < TILE_MARGIN_M
    centres = 25.6 * (np.array([[5, 1, 0], [6, 1, 0], [-2, -2, 0], [-3, 1, 0]]) + 0.5)
    assert area.has_cells(centres).tolist() == [True, False, True, False]


def test_tiles_divide_the_regions_between_them():
    """Region 4 has its centre at 115.2 m, in the second square. The first tile only has 1.6 m of it, without cells."""
    found = parts_of([(50.0, 50.0), (150.0, 50.0)])
    first, second = found[0, 0].area, found[1, 0].area
    assert (first.beside, second.beside) == (((1, 0),), ((0, 0),))
    points = np.array([[x, 50.0, 0.0] for x in (100.7, 103.9, 104.1)])
    assert first.is_in_cloud(points).tolist() == [True, True, False]
    assert second.is_in_cloud(points).tolist() == [False, True, True]
    centres = 25.6 * (np.array([[3, 1, 0], [4, 1, 0]]) + 0.5)
    assert first.has_cells(centres).tolist() == [True, False]
    assert second.has_cells(centres).tolist() == [False, True]


def test_a_place_is_surrounded_if_no_other_tile_has_a_surface_within_45_m():
    """The regions of the second tile begin at 102.4 m, and the first tile has 1.6 m of them."""
    area = parts_of([(50.0, 50.0), (150.0, 50.0)])[0, 0].area
    places = np.array([[58.9, 50.0], [59.1, 50.0], [1.0, 99.0]])
    assert area.surrounds(places).tolist() == [True, False, True]


def test_a_place_between_scans_is_in_the_square_of_its_position():
    """Between 98 and 106 m, places at 100.7 and 103.3 m; beyond the ends at 95.3, 92.7, 90 and 108.7, 111.3, 114 m."""
    found = parts_of([(98, 10), (106, 10)], between_m=3.0)
    left, right = found[0, 0].plan, found[1, 0].plan
    assert left.at_scan.tolist() == [True, False]
    assert right.at_scan.tolist() == [False, True]
    assert list(left.on_way) == list(right.on_way) == [1]
    np.testing.assert_allclose(left.on_way[1], [-1 / 3, -2 / 3, -1])
    np.testing.assert_allclose(right.on_way[1], [1 / 3, 2 / 3, 4 / 3, 5 / 3, 2])


def test_a_place_beyond_an_end_has_its_scans_however_far_they_are():
    """The traversal begins in column 11. Its first place beyond the end is in column 10, whose regions end at 537.6 m. So the second scan
    is farther from its cloud than 40 m, and another street drives around."""
    way = [(564.85 + 14.9 * k, 25.0) for k in range(4)]
    around = [(x, y) for y in (75.0, -25.0) for x in (525.0, 575.0)]
    found = parts_of([*way, (2000.0, 0.0), *around], tile_m=50.0, between_m=14.0)
    part = found[10, 0]
    (k, shares), *others = part.plan.on_way.items()
    assert (shares, others) == ((-1.0,), [])
    assert part.order[[k - 1, k]].tolist() == [0, 1]


def test_a_square_with_places_between_scans_alone_is_a_tile():
    """The way crosses the corner of a square in which no scan stands."""
    found = parts_of([(95, 103), (103, 95)], between_m=6.0)
    assert sorted(found) == [(0, 0), (0, 1), (1, 0)]
    assert not found[0, 0].plan.at_scan.any()
    assert dict(found[0, 0].plan.on_way) == {1: (0.5,)}


def test_a_square_that_is_only_near_a_scan_is_no_tile():
    assert list(parts_of([(99.0, 99.0)])) == [(0, 0)]


def test_scans_count_in_their_square_kept_or_not():
    found = parts_of([(10, 0), (20, 0), (30, 0), (110, 0), (120, 0)], kept=[0, 2, 3])
    assert {square: part.survey_scans for square, part in found.items()} == {(0, 0): 3, (1, 0): 2}


@given(
    st.lists(st.tuples(st.floats(-14, 14), st.floats(-14, 14)), min_size=1, max_size=60),
    st.sampled_from([50.0, 70.0, 333.3]),
    st.sampled_from([0.0, 3.0]),
)
def test_each_kept_scan_and_each_place_between_scans_is_in_exactly_one_tile(steps, tile_m, between_m):
    xy = np.cumsum(np.array(steps), axis=0)
    found = parts_of(xy, tile_m=tile_m, between_m=between_m)
    at_scan, on_way = [], []
    for part in found.values():
        assert set(np.flatnonzero(part.area.reads(xy)).tolist()) <= set(part.order.tolist())
        assert part.square.within(cloud_margin_m(0.3) + 40.0, xy[part.order]).all()
        at_scan += part.order[part.plan.at_scan].tolist()
        for k, shares in part.plan.on_way.items():
            assert part.order[k - 1] == part.order[k] - 1  # both scans are at hand
            on_way += [(int(part.order[k]), share) for share in shares]
    assert sorted(at_scan) == list(range(len(xy)))
    whole = PlannedPlaces.of(track(xy), between_m).on_way
    assert sorted(on_way) == sorted((k, share) for k, shares in whole.items() for share in shares)


@pytest.mark.parametrize("tile_m", [49.9, 10_001.0, 0.0, -100.0, float("nan"), float("inf")])
def test_an_edge_that_the_format_does_not_allow_is_refused(tile_m):
    with pytest.raises(DatasetError, match=rf"^tile_m: {tile_m:g} is not valid; give 50 to 10,000 metres$") as refused:
        require_tile_edge(tile_m)
    assert refused.value.field == "tile_m"


def test_a_survey_too_far_from_the_zero_of_its_frame_is_refused_with_a_remedy():
    with pytest.raises(DatasetError, match="subtract an offset from all poses, or give a larger --tile-m"):
        columns_and_rows(np.array([[0.0, 0.0], [5.1e7, 0.0]]), 50.0)


def test_a_square_with_a_margin_contains_its_lower_edges():
    square = Square(1, -1, 100.0)
    inside = square.within(10.0, np.array([[90.0, -110.0], [209.9, 9.9], [210.0, -50.0], [150.0, 10.0], [89.9, -50.0]]))
    assert inside.tolist() == [True, True, False, False, False]
