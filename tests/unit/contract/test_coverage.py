import json
import threading
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from service.contract import coverage
from service.contract.coverage import coverage_geojson, covered
from service.errors import BusyError, TooLargeError
from service.geometry.earth import Georeference
from service.maps.reader import MapBundle
from service.runtime.admission import MIB, MemoryBudget

BERLIN = Georeference(52.52, 13.405, 70.0)


@pytest.fixture(autouse=True)
def counted(monkeypatch):
    """Constants that these tests assume, and nothing kept from another test."""
    monkeypatch.setattr(coverage, "CELL_M", 5.0)
    monkeypatch.setattr(coverage, "REACH_M", 7.5)
    coverage._kept.clear()


def map_of(places_m, *, earth=None, version="v1"):
    """Return what the coverage reads of a map."""
    manifest = SimpleNamespace(version=version, counts=SimpleNamespace(places=len(places_m)))
    return SimpleNamespace(
        path="/maps/town", name="town", manifest=manifest, earth=earth, places_xy=np.ascontiguousarray(places_m.T)
    )


def collection_of(*maps, budget=None):
    """Return the bytes of the answer."""
    with (budget or MemoryBudget(64 * MIB)).hold() as hold:
        return coverage_geojson(maps, hold)


def streets_m(count):
    """Return places on straight streets in all directions, one place for each metre."""
    rng = np.random.default_rng(1)
    starts, headings = rng.uniform(-800, 800, (count, 1, 2)), rng.uniform(0, 2 * np.pi, count)
    steps = np.arange(200.0)[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])[:, None]
    return (starts + steps).reshape(-1, 2)


def slow_rings(places_m, earth):
    """Return the rings cell by cell and corner by corner."""
    cells = {
        (x, y)
        for px, py in places_m.tolist()
        for x in range(int(px // 5) - 2, int(px // 5) + 3)
        for y in range(int(py // 5) - 2, int(py // 5) + 3)
        if np.hypot(5 * x + 2.5 - px, 5 * y + 2.5 - py) <= 7.5
    }
    rings = []
    for x, y in sorted(cells, key=lambda cell: cell[::-1]):
        if (x - 1, y) in cells:
            continue
        end = next(k for k in range(x, x + len(cells) + 1) if (k, y) not in cells)
        ring = [[5.0 * at, 5.0 * up] for at, up in ((x, y), (end, y), (end, y + 1), (x, y + 1), (x, y))]
        if earth is not None:
            on_earth = [earth.to_earth(np.array([*corner, 0.0])) for corner in ring]
            ring = [[round(longitude, 8), round(latitude, 8)] for latitude, longitude, _ in on_earth]
        rings.append(ring)
    return rings


@pytest.mark.parametrize("earth", [None, BERLIN, Georeference(-89.9, 179.99)])
@pytest.mark.parametrize("block", [7, 4096])
def test_the_answer_is_that_of_a_plain_loop_over_all_cells_and_corners(monkeypatch, earth, block):
    monkeypatch.setattr(coverage, "BLOCK", block)
    places_m = streets_m(12)
    document = {
        "type": "FeatureCollection",
        "features": [
            {
                "type": "Feature",
                "properties": {
                    "map": "town",
                    "version": "v1",
                    "frame": "map" if earth is None else "wgs84",
                    "places": len(places_m),
                    "reach_m": 7.5,
                },
                "geometry": {
                    "type": "MultiPolygon",
                    "coordinates": [[ring] for ring in slow_rings(places_m, earth)],
                },
            }
        ],
    }
    assert collection_of(map_of(places_m, earth=earth)) == json.dumps(document).encode()


def test_the_work_stays_within_the_memory_that_is_reserved():
    places_m, budget, most = streets_m(500), MemoryBudget(64 * MIB), [0.0]
    budget.watch(lambda held: most.append(max(held, most.pop())))
    opened = map_of(places_m, earth=BERLIN)
    tracemalloc.start()
    collection_of(opened, budget=budget)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak <= most[0] < 40 * MIB


def test_a_version_is_computed_once_for_all_who_ask_at_once(monkeypatch):
    made, pieces = [], coverage._pieces
    monkeypatch.setattr(coverage, "_pieces", lambda *given: made.append(1) or pieces(*given))
    opened, answers = map_of(streets_m(20)), []
    threads = [threading.Thread(target=lambda: answers.append(collection_of(opened))) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert (len(made), len(answers), len(set(answers))) == (1, 4, 1)
    collection_of(map_of(streets_m(20), version="v2"))
    assert len(made) == 2


def test_kept_features_take_their_bytes_from_the_budget_and_give_them_back(monkeypatch):
    budget, first, second = MemoryBudget(64 * MIB), map_of(streets_m(5)), map_of(streets_m(5), version="v2")
    answer = collection_of(first, budget=budget)
    feature = len(answer) - len(coverage._BEFORE) - len(coverage._AFTER)
    assert budget.held == feature
    monkeypatch.setattr(coverage, "KEPT_BYTES", feature + 1)  # room for one
    collection_of(second, budget=budget)
    assert budget.held == feature
    assert [version for _, version in coverage._kept] == ["v2"]
    monkeypatch.setattr(coverage, "KEPT_BYTES", feature - 1)  # room for none
    collection_of(map_of(streets_m(5), version="v3"), budget=budget)
    assert [version for _, version in coverage._kept] == ["v2"]
    coverage._kept.clear()
    assert budget.held == 0


def test_a_service_without_memory_refuses_and_keeps_nothing():
    budget, opened = MemoryBudget(20 * MIB), map_of(streets_m(5))
    with budget.hold() as other:
        other.grow(10 * MIB)
        with pytest.raises(BusyError):
            collection_of(opened, budget=budget)
    with pytest.raises(TooLargeError, match="STREETFIX_REQUEST_MEMORY_MIB"):
        collection_of(opened, budget=MemoryBudget(MIB))
    assert (budget.held, len(coverage._kept)) == (0, 0)
    assert b"MultiPolygon" in collection_of(opened, budget=budget)


def test_a_map_without_places_has_no_cells():
    assert covered(np.empty((0, 2))).shape == (0, 4)


def test_one_place_covers_the_cells_around_it():
    """The place is at the centre of a cell. Centres within 7.5 m are covered: 0 and 5 m along an axis, (5, 5) at 7.07 m."""
    assert covered(np.array([[2.5, 2.5]])).tolist() == [[-5, -5, 10, 0], [-5, 0, 10, 5], [-5, 5, 10, 10]]


def test_places_far_apart_are_not_joined_and_near_ones_are():
    apart = covered(np.array([[2.5, 2.5], [102.5, 2.5]]))
    assert len(apart) == 6
    joined = covered(np.array([[2.5, 2.5], [17.5, 2.5]]))
    assert joined.tolist() == [[-5, -5, 25, 0], [-5, 0, 25, 5], [-5, 5, 25, 10]]


def test_no_cell_is_covered_twice_and_every_place_lies_in_one():
    places = np.random.default_rng(0).uniform(-60, 60, (80, 2))
    rectangles = covered(places)
    inside = (
        (places[:, None, 0] >= rectangles[:, 0])
        & (places[:, None, 0] < rectangles[:, 2])
        & (places[:, None, 1] >= rectangles[:, 1])
        & (places[:, None, 1] < rectangles[:, 3])
    )
    assert (inside.sum(axis=1) == 1).all()


def test_a_map_without_georeference_is_described_in_local_metres(bundle_path):
    bundle = MapBundle.open(bundle_path)
    (feature,) = json.loads(collection_of(bundle))["features"]
    assert feature["properties"] == {
        "map": "tiny",
        "version": bundle.manifest.version,
        "frame": "map",
        "places": len(bundle.T_map_place),
        "reach_m": 7.5,
    }
    for (ring,) in feature["geometry"]["coordinates"]:
        assert ring[0] == ring[-1]
        (x0, y0), (x1, _), (_, y1) = ring[0], ring[1], ring[2]
        assert x1 > x0  # counter-clockwise: first along x, then along y
        assert y1 > y0


def test_no_maps_is_an_empty_collection():
    assert json.loads(collection_of()) == {"type": "FeatureCollection", "features": []}
