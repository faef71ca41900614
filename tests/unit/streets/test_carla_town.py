"""CARLA's Town01, with CARLA's own OpenDRIVE reader as the oracle."""

from collections import Counter

import numpy as np
import pytest
import shapely

from model_training.streets.collection import collection_of
from model_training.streets.opendrive import read_network, read_opendrive
from service.maps.streets import Streets


@pytest.fixture
def waypoints(town01):
    """Return road, junction flag and position of points in the middle of all driving lanes.

    Positions are in the axes of OpenDRIVE: y is opposite to CARLA's y.
    """
    carla = pytest.importorskip("carla", reason="CARLA's client is not installed")
    found = carla.Map("Town01", town01.read_text()).generate_waypoints(2.0)
    places = np.array([(point.transform.location.x, -point.transform.location.y) for point in found])
    return [str(point.road_id) for point in found], [point.is_junction for point in found], places


def test_every_driving_waypoint_lies_in_its_own_road(town01, waypoints):
    roads, _, places = waypoints
    surface = {road.id: road.surface for road in read_network(town01, lanes="driving").roads}
    outside = [surface[road].distance(shapely.Point(place)) for road, place in zip(roads, places, strict=True)]
    assert len(outside) > 3000
    assert max(outside) < 0.001  # those at a road's very end lie on its edge


@pytest.mark.parametrize("lanes", ["driving", "all"])
def test_every_driving_waypoint_gets_its_roads_name_from_the_service(town01, waypoints, lanes):
    streets = Streets.from_geojson(collection_of(read_opendrive(town01, lanes=lanes).streets).document)
    name_of_road = {road.id: road.name for road in read_network(town01).roads if road.junction is None}
    answers = Counter()
    for road, in_junction, place in zip(*waypoints, strict=True):
        index = streets.index_at(place)
        assert index >= 0
        if not in_junction:
            answers[streets[index].name == name_of_road[road]] += 1
    assert answers[False] <= 0.02 * answers[True]  # those at a road's very end may lie in what follows


def test_the_town_has_its_roads_and_junctions(town01):
    read = read_opendrive(town01)
    junctions = [street for street in read.streets if not street.divisible]
    assert (len(read.streets) - len(junctions), len(junctions), read.unnamed, read.dropped) == (26, 12, 0, ())
    assert "Road 0 / Road 1 / Road 16" in [street.name for street in junctions]
