"""A service with a tiled map gives the answers of the same map in one bundle, and describes it in the same way."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pydantic import SecretStr

from service.errors import SearchError
from service.geometry.rigid import transform_from
from service.maps import tiles as tiles_module
from service.maps.content import BundleContent
from service.maps.store.transfer import push
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.settings import MapUrl, Settings
from tests.unit.lattice import as_tile

TILE_M = 50.0


def part_of(content: BundleContent, keep: Any, **changed: Any) -> BundleContent:
    """Return a tile with some of the places, and with their streets only."""
    views = keep[content.view_place]
    streets = content.streets
    assert streets is not None
    used = sorted({int(number) for number in content.place_street[keep] if number >= 0})
    return replace(
        content,
        T_map_place=content.T_map_place[keep],
        place_street=np.array([used.index(number) for number in content.place_street[keep]], np.int32),
        view_place=np.repeat(np.arange(keep.sum(), dtype=np.int32), content.headings),
        view_heading_rad=content.view_heading_rad[views],
        descriptors=content.descriptors[views],
        streets={**streets, "features": [streets["features"][number] for number in used]},
        **changed,
    )


@pytest.fixture(scope="module")
def tiled_path(content: BundleContent, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map in tiles. Each has only its own streets, and that of the second street stands 0.3 m higher."""
    folder, tiles = tmp_path_factory.mktemp("tiles"), {}
    cells = np.floor(content.T_map_place[:, :2, 3] / TILE_M).astype(int)
    for column, row in np.unique(cells, axis=0).tolist():
        tiles[column, row] = folder / f"{column}_{row}"
        part = part_of(content, (cells == (column, row)).all(axis=1))
        if row == 2:
            higher = np.stack([transform_from(T[:3, :3], T[:3, 3] + 0.3 * T[:3, 2]) for T in part.T_map_place])
            part = replace(part, T_map_place=higher, parameters={**part.parameters, "lidar_height_m": 2.1})
        write_bundle(tiles[column, row], as_tile(part))
    write_tiled(folder / "maps" / "tiny", tiles, TILE_M, name="tiny")
    return folder / "maps" / "tiny"


@pytest.fixture(scope="module")
def tiled_engine(tiled_path: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(tiled_path.parent,), threads=1, queue=1))
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def tiled(tiled_engine: Engine, client_of: Callable[[Engine], httpx.Client]) -> httpx.Client:
    return client_of(tiled_engine)


@pytest.fixture(scope="module")
def whole(
    content: BundleContent, tmp_path_factory: pytest.TempPathFactory, client_of: Callable[[Engine], httpx.Client]
) -> Iterator[httpx.Client]:
    """The map in one bundle, whose surfels are rounded like those of tiles."""
    maps = tmp_path_factory.mktemp("whole") / "maps"
    write_bundle(maps / "tiny", as_tile(content))
    engine = Engine.open(Settings(maps=(maps,), threads=1, queue=1))
    yield client_of(engine)
    engine.close()


def test_the_answer_is_that_of_one_bundle(
    whole: httpx.Client, tiled: httpx.Client, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    answers = []
    for each in (whole, tiled):
        response = each.post("/v1/localize", files={name: (name, data) for name, data in parts_of().items()})
        assert response.status_code == 200, response.text
        answers.append(response.json())
    one, other = answers
    assert other["status"] == one["status"] == "LOCALIZED"
    assert other["street"]["id"] == one["street"]["id"]
    assert [place["street"] for place in other["neighbours"]] == [place["street"] for place in one["neighbours"]]
    for axis in ("x", "y", "z"):
        assert other["pose"]["position"][axis] == pytest.approx(one["pose"]["position"][axis], abs=0.05)


def test_streets_and_heights_of_a_tile_are_those_of_the_map(tiled_path: Path, content: BundleContent) -> None:
    opened = TiledMap.open(tiled_path)
    assert opened.streets is not None
    assert [street.id for street in opened.streets.features] == ["s0", "s1", "s2"]
    height_m = opened.manifest.lidar_height_m
    assert height_m == pytest.approx((6 * 1.8 + 6 * 2.1) / 12)
    for number, tile in enumerate(opened.manifest.tiles):
        first = opened.tiles.first_place[number]
        places = opened.tiles.get(number).places
        assert places.tobytes() == opened.places[first : first + tile.counts.places].tobytes()
    # the ground under every place stays where it was: 0.2 m
    assert opened.T_map_place[:, 2, 3] - height_m == pytest.approx(np.full(12, 0.2))
    assert np.bincount(opened.place_street).tolist() == np.bincount(content.place_street).tolist()


def test_the_service_describes_the_whole_map(client: httpx.Client, tiled: httpx.Client) -> None:
    (one,), (other,) = (each.get("/v1/maps").json()["maps"] for each in (client, tiled))
    differ = {"version", "versions", "made_at", "tiles", "open_tiles"}
    assert {name: other[name] for name in other.keys() - differ} == {name: one[name] for name in one.keys() - differ}
    assert (one["tiles"], one["open_tiles"]) == (0, 0)
    assert other["tiles"] == 4
    assert other["open_tiles"] == 4  # the warm-up searched all tiles of this small map
    assert tiled.get("/readyz").json()["open_tiles"] == 4
    assert 'streetfix_open_tiles{map="tiny"} 4.0' in tiled.get("/metrics").text
    streets = [each.get("/v1/maps/tiny/streets").json()["features"] for each in (client, tiled)]
    assert streets[0] == streets[1]
    features = [each.get("/v1/coverage").json()["features"] for each in (client, tiled)]
    assert features[0][0]["geometry"] == features[1][0]["geometry"]


def test_readiness_tells_the_tiles_in_the_cache(
    tiled_path: Path, client_of: Callable[[Engine], httpx.Client], tmp_path: Path
) -> None:
    push(tiled_path, url := f"file://{tmp_path}/store/tiny")
    engine = Engine.open(Settings(maps=(MapUrl(url),), tile_cache=tmp_path / "cache", threads=1))
    try:
        (opened,) = (each.bundle for each in engine.registry)
        assert isinstance(opened, TiledMap)
        del opened.tiles._opened[0]
        told = client_of(engine).get("/readyz").json()
    finally:
        engine.close()
    assert (told["open_tiles"], told["cached_tiles"]) == (3, 4)


def test_the_console_draws_all_tiles(
    tiled_path: Path, client_of: Callable[[Engine], httpx.Client], bundle_path: Path
) -> None:
    counts = []
    for path in (tiled_path, bundle_path):
        engine = Engine.open(Settings(maps=(path,), threads=1, queue=1, console=True))
        try:
            cloud = client_of(engine).get("/v1/maps/tiny/cloud", params={"points": 20_000})
            assert cloud.status_code == 200
            counts.append(int.from_bytes(cloud.content[4:8], "little"))
        finally:
            engine.close()
    assert counts[0] >= counts[1] > 0


def test_a_tile_that_vanished_is_a_clear_error(
    tiled_path: Path, tmp_path: Path, client_of: Callable[[Engine], httpx.Client], parts_of: Callable[..., Any]
) -> None:
    """The tiles were open when the service started. They are opened again after they were closed."""
    import shutil

    from service.localization.localizer import Localizer
    from service.runtime.map_registry import MapRegistry

    copy = tmp_path / "tiny"
    shutil.copytree(tiled_path, copy)
    opened = TiledMap.open(copy, open_bytes=1)
    engine = Engine(MapRegistry([Localizer.open(opened)]), Settings(threads=1))
    shutil.rmtree(copy / "tiles")
    response = client_of(engine).post("/v1/localize", files={name: (name, data) for name, data in parts_of().items()})
    engine.close()
    assert response.status_code == 503
    problem = json.dumps(response.json())
    assert "manifest.json is missing" in problem
    assert str(tmp_path) not in problem


def test_a_search_server_that_fails_is_503_and_its_return_mounts_the_map(
    tiled_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    client_of: Callable[[Engine], httpx.Client],
    parts_of: Callable[..., dict[str, bytes]],
    caplog: pytest.LogCaptureFixture,
) -> None:
    pytest.importorskip("qdrant_client")
    from service.maps.qdrant import Collection, QdrantSearch, index_maps
    from tests.unit.maps.fake_qdrant import FakeQdrant

    monkeypatch.setattr(tiles_module, "MOST_SEARCHED", 3)
    files = {name: (name, data) for name, data in parts_of().items()}
    with FakeQdrant().serving() as fake:
        settings = Settings(
            maps=(tiled_path.parent,),
            threads=1,
            queue=1,
            qdrant_url=fake.url,
            qdrant_api_key=SecretStr("a-secret-key"),
            qdrant_timeout_s=60,
        )
        with pytest.raises(SearchError, match="is there such a collection"):
            Engine.open(settings)
        index_maps([tiled_path], Collection.open(fake.url))
        engine = Engine.open(settings)
        try:
            (opened,) = (each.bundle for each in engine.registry)
            assert isinstance(opened, TiledMap)
            assert isinstance(opened.search, QdrantSearch)
            assert fake.requests[-1] == "POST /points/query"  # the warm-up
            assert fake.keys[-1] == "a-secret-key"
            client = client_of(engine)
            assert client.post("/v1/localize", files=files).json()["status"] == "LOCALIZED"
            assert fake.requests.count("POST /points/query") == 2
            fake.before = _unavailable
            problem = client.post("/v1/localize", files=files)
            assert (problem.status_code, problem.json()["code"]) == (503, "search")
            assert problem.headers["Retry-After"] == "1"
            assert "127.0.0.1" not in problem.text
            assert client.get("/readyz").status_code == 200
            # A new version meets the failing server. It is mounted when the server answers again.
            engine.registry.unmount("tiny", opened.manifest.version)
            assert "status 503" in engine.watcher.scan()[0]
            assert "127.0.0.1" not in client.get("/readyz").text
            fake.before = lambda _: False
            assert engine.watcher.scan() == [f"mounted tiny {opened.manifest.version}"]
        finally:
            engine.close()
    assert "a-secret-key" not in caplog.text


def _unavailable(request: Any) -> bool:
    request.send_response(503)
    request.send_header("Content-Length", "0")
    request.end_headers()
    return True
