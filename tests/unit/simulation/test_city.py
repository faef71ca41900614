from typing import Any

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree

from model_training.simulation import city as module
from model_training.simulation.city import CAR_ROWS_M, City
from model_training.simulation.districts import DISTRICTS, DOWNTOWN, MIXED_SHARES, RESIDENTIAL, WOODED
from model_training.simulation.streets import TABLE_I, paper_streets, random_streets, streets_geojson
from model_training.simulation.terrain import Terrain

#: The paper's Table I, written off by hand.
PAPER_CLASSES = {
    "Beginning of street 1": 56,
    "End of street 1": 54,
    "Beginning of street 2": 22,
    "End of street 2": 67,
    "Street 3": 11,
    "Beginning of street 4": 38,
    "End of street 4": 25,
    "Beginning of street 5": 76,
    "End of street 5": 37,
    "Street 6": 34,
    "Beginning of street 7": 53,
    "End of street 7": 32,
    "Street 8": 49,
    "Beginning of street 9": 20,
    "End of street 9": 21,
    "Between": 31,
}


NETWORKS = [paper_streets(np.random.default_rng(0))]
NETWORKS += [random_streets(np.random.default_rng(seed), (200.0, 260.0)) for seed in range(4)]


def test_the_papers_city_has_the_classes_of_table_i():
    features = streets_geojson(paper_streets(np.random.default_rng(0)))["features"]
    assert [f["properties"]["name"] for f in features] == list(PAPER_CLASSES)
    assert [f["properties"]["class_index"] for f in features] == list(range(16))


def test_table_i_has_the_papers_counts():
    assert [count for _, _, count in TABLE_I] == list(PAPER_CLASSES.values())
    assert sum(PAPER_CLASSES.values()) == 626


def test_the_papers_city_is_about_as_large_as_the_papers():
    points = np.concatenate([line for street in paper_streets(np.random.default_rng(0)) for line in street.lines])
    width, height = points.max(axis=0) - points.min(axis=0)
    assert 70_000 < width * height < 130_000


@pytest.mark.parametrize("network", NETWORKS)
def test_street_polygons_do_not_overlap(network):
    shapes = [shapely.geometry.shape(f["geometry"]) for f in streets_geojson(network)["features"]]
    overlap = sum(a.intersection(b).area for k, a in enumerate(shapes) for b in shapes[:k])
    assert overlap < 0.02 * len(shapes)  # m2 each: corners lie on a grid of 1 cm, borders between them do not


@pytest.mark.parametrize("network", NETWORKS)
def test_street_polygons_are_valid(network):
    shapes = [shapely.geometry.shape(f["geometry"]) for f in streets_geojson(network)["features"]]
    assert [shapely.is_valid_reason(shape) for shape in shapes] == ["Valid Geometry"] * len(shapes)


@pytest.mark.parametrize(
    ("seed", "size_m"), [(2007, (300.0, 400.0)), (2010, (300.0, 400.0)), (2005, (600.0, 400.0)), (2052, (600.0, 400.0))]
)
def test_slivers_that_collapse_to_lines_are_no_part_of_a_street(seed, size_m):
    network = random_streets(np.random.default_rng([seed, 1]), size_m)
    found = streets_geojson(network)["features"]  # GEOS refuses to unite what has lines in it
    assert {feature["geometry"]["type"] for feature in found} <= {"Polygon", "MultiPolygon"}
    assert len(found) == sum(len(street.classes()) for street in network)


@pytest.mark.parametrize("network", NETWORKS)
def test_every_point_of_a_centre_line_lies_in_a_street(network):
    everything = shapely.union_all(
        [shapely.geometry.shape(f["geometry"]) for f in streets_geojson(network)["features"]]
    )
    points = np.concatenate([line[1:-1] for street in network for line in street.lines])
    assert shapely.contains(everything.buffer(0.05), shapely.points(points)).all()


@pytest.mark.parametrize("network", NETWORKS)
def test_identifiers_of_classes_are_unique(network):
    identifiers = [f["properties"]["id"] for f in streets_geojson(network)["features"]]
    assert len(set(identifiers)) == len(identifiers)


def test_the_same_seed_gives_the_same_city():
    one, other = (City(seed=8, size_m=(60.0, 60.0)) for _ in range(2))
    np.testing.assert_array_equal(one.static.triangles, other.static.triangles)


def test_other_seeds_give_other_cities():
    one, other = (City(seed=seed, size_m=(60.0, 60.0)) for seed in (8, 9))
    assert one.streets_geojson() != other.streets_geojson()
    assert one.static.triangles.shape != other.static.triangles.shape


def test_a_larger_city_has_more_streets():
    rng = np.random.default_rng
    assert len(random_streets(rng(0), (400.0, 400.0))) > len(random_streets(rng(0), (160.0, 160.0)))


def test_no_house_stands_on_a_carriageway(city):
    corners = np.concatenate(city._occupied)
    assert city.clearance(corners) > 0


def test_slopes_are_gentle_and_there_are_some():
    normals = np.array(
        [
            Terrain.random(np.random.default_rng(seed)).normal(xy)
            for seed in range(20)
            for xy in np.random.default_rng(seed).uniform(-200, 200, (20, 2))
        ]
    )
    slopes = np.rad2deg(np.arccos(normals[:, 2]))
    assert slopes.max() < 4.0
    assert np.median(slopes) > 0.3


def test_the_normal_of_the_ground_is_square_to_it():
    terrain, step = Terrain.random(np.random.default_rng(2)), 1e-4
    xy = np.array([31.0, -12.0])
    for direction in np.eye(2):
        rise = (terrain.height(xy + step * direction) - terrain.height(xy - step * direction)) / (2 * step)
        assert abs(terrain.normal(xy) @ [*direction, rise]) < 1e-8


@pytest.fixture
def stood(city, monkeypatch):
    """Return the positions of people and vehicles of a traversal, instead of their triangles."""

    def of(traversal, **options):
        people, vehicles = [], []
        monkeypatch.setattr(module, "add_person", lambda _builder, base, *_rest: people.append(base[:2]))
        monkeypatch.setattr(module, "add_vehicle", lambda _builder, base, *_rest: vehicles.append(base[:2]))
        city.occupants(traversal, **options)
        slots = cKDTree([slot[:2] for slot in city._parking])
        parked = [v for v in vehicles if slots.query(v)[0] < 1.0]
        return {tuple(p) for p in people}, {tuple(v) for v in parked}

    return of


def test_no_two_people_stand_at_the_same_spot(stood):
    assert not stood(0)[0] & stood(1)[0]
    assert not stood(1)[0] & stood(2)[0]
    assert len(stood(0)[0]) > 3


def test_about_half_of_the_parked_cars_stay(stood):
    survey, query = stood(0)[1], stood(1)[1]
    assert 0.35 < len(survey & query) / len(survey) < 0.65


@pytest.mark.parametrize(("changed", "stay"), [(0.0, 1.0), (1.0, 0.0)])
def test_the_share_of_parked_cars_that_change_is_an_option(stood, changed, stay):
    survey, query = stood(0, parked_changed=changed)[1], stood(1, parked_changed=changed)[1]
    assert len(survey & query) / len(survey) == pytest.approx(stay, abs=0.03)


def test_the_same_traversal_has_the_same_occupants(city):
    np.testing.assert_array_equal(city.occupants(3).triangles, city.occupants(3).triangles)


class CarParks(City):
    """A city of car parks only."""

    def _districts(self, rng):
        seeds, kinds = super()._districts(rng)
        return seeds, np.full_like(kinds, next(k for k, each in enumerate(DISTRICTS) if each.name == "car park"))


@pytest.fixture(scope="module")
def car_parks():
    return CarParks(seed=2061, name="mixed", size_m=(120.0, 120.0))


def test_a_mixed_city_has_districts_of_all_kinds_by_their_shares():
    assert sum(MIXED_SHARES) == pytest.approx(1.0)
    assert len(MIXED_SHARES) == len(DISTRICTS) == len({each.name for each in DISTRICTS})
    stub = City.__new__(City)
    stub.name, stub.half_size_m = "mixed", (4000.0, 4000.0)
    _, kinds = stub._districts(np.random.default_rng(0))
    assert len(kinds) > 2000
    np.testing.assert_allclose(np.bincount(kinds, minlength=len(DISTRICTS)) / len(kinds), MIXED_SHARES, atol=0.03)


def test_other_cities_have_the_first_three_kinds_alone():
    stub = City.__new__(City)
    stub.name, stub.half_size_m = "city", (4000.0, 4000.0)
    _, kinds = stub._districts(np.random.default_rng(0))
    assert set(kinds) == {DOWNTOWN, RESIDENTIAL, WOODED}


def test_cars_of_a_car_park_stand_in_rows_beyond_the_pavement(car_parks):
    """Elsewhere cars park on the carriageway, with a negative clearance."""
    clearance = np.array([car_parks.clearance(np.array([[x, y]])) for x, y, *_ in car_parks._parking])
    beyond = clearance > 4.0
    assert beyond.sum() > 20
    assert (clearance[~beyond] < 0.1).all()
    # pavements are 1.5 to 2.8 m wide
    for row in CAR_ROWS_M:
        assert ((clearance > row + 1.0) & (clearance < row + 4.0)).any(), row


def test_no_two_cars_of_a_car_park_stand_in_each_other(car_parks):
    spots = np.array([(x, y) for x, y, *_ in car_parks._parking if car_parks.clearance(np.array([[x, y]])) > 4.0])
    tree: Any = cKDTree(spots)
    distance, _ = tree.query(spots, k=2)
    assert distance[:, 1].min() > 2.0
