"""The views of tiled maps in Qdrant: its local mode, behind its REST interface, and servers that misbehave."""

import shutil
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from model_training.cli.map_care import app
from service.errors import BundleError, ExtraMissingError, RequestError, SearchError
from service.maps import qdrant as qdrant_module
from service.maps.content import BundleContent
from service.maps.index import vectors_of
from service.maps.inverted_file import InvertedFile
from service.maps.manifest import Manifest, read_manifest
from service.maps.qdrant import Collection, QdrantSearch, index_maps
from service.maps.search_address import checked_name, checked_search_url
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import MOST_SEARCHED, PlaceSearch, TiledMap
from service.maps.writer import write_bundle
from tests.unit.lattice import as_tile
from tests.unit.maps.fake_qdrant import FakeQdrant

pytest.importorskip("qdrant_client")

TILES, TILE_M, SECRET = 8, 50.0, "a-secret-key"


class Row:
    """Maps whose tiles stand in a row. Tile and seed determine the descriptors."""

    def __init__(self, folder: Path, content_of: Callable[..., BundleContent]) -> None:
        self.folder, self._content_of = folder, content_of

    def _tile(self, column: int, seed: int) -> Path:
        path = self.folder / f"{column}-{seed}"
        if not path.exists():
            content = self._content_of(name="row", cloud=None)
            content.T_map_place[:, 0, 3] = column * TILE_M + 10.0
            content.T_map_place[:, 1, 3] = 10.0
            random = np.random.default_rng((column, seed)).normal(size=content.descriptors.shape)
            content.descriptors[:] = random / np.linalg.norm(random, axis=1, keepdims=True)
            write_bundle(path, as_tile(content))
        return path

    def map(self, name: str, seeds: dict[int, int] | None = None, tiles: int = TILES) -> Path:
        """Return a map; ``seeds`` are those of changed tiles."""
        made = {(column, 0): self._tile(column, (seeds or {}).get(column, 0)) for column in range(tiles)}
        write_tiled(self.folder / name, made, TILE_M, name="row")
        return self.folder / name


@pytest.fixture(scope="module")
def row(content_of: Callable[..., BundleContent], tmp_path_factory: pytest.TempPathFactory) -> Row:
    return Row(tmp_path_factory.mktemp("row"), content_of)


@pytest.fixture(scope="module")
def before(row: Row) -> Path:
    return row.map("before")


@pytest.fixture(scope="module")
def after(row: Row, before: Path) -> Path:
    """The same map after tile 3 has changed."""
    return row.map("after", {3: 1})


@pytest.fixture
def fake() -> Iterator[FakeQdrant]:
    with FakeQdrant().serving() as server:
        yield server


@pytest.fixture
def collection(fake: FakeQdrant) -> Iterator[Collection]:
    opened = Collection.open(fake.url, "town", api_key=SECRET)
    yield opened
    opened.close()


def opener(collection: Collection) -> Callable[[Manifest], QdrantSearch]:
    def open_search(of_map: Manifest) -> QdrantSearch:
        search = QdrantSearch(collection, of_map)
        search.require_complete()
        return search

    return open_search


@cache
def vectors_in(path: Path) -> Any:
    return vectors_of(TiledMap.open(path).view_index.rows[:])


def exact(path: Path, descriptor: Any, k: int) -> list[int]:
    """Return the most similar views of an exact comparison with all views, the most similar first."""
    similar = vectors_in(path) @ descriptor
    return np.argsort(-similar, kind="stable")[:k].tolist()


def queries(path: Path, count: int = 10) -> Any:
    rng = np.random.default_rng(5)
    found = rng.normal(size=(count, read_manifest(path).counts.descriptor_size)).astype(np.float32)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def test_the_shortlist_is_that_of_an_exact_search(before: Path, collection: Collection) -> None:
    index_maps([before], collection)
    search = QdrantSearch(collection, read_manifest(before))
    assert isinstance(search, PlaceSearch)
    for descriptor in queries(before):
        assert search.most_similar(descriptor, 40).tolist() == exact(before, descriptor, 40)
        assert sorted(search.shortlist(descriptor, 40).tolist()) == sorted(exact(before, descriptor, 40))


def test_a_query_searches_the_tiles_of_an_exact_search(before: Path, collection: Collection) -> None:
    index_maps([before], collection)
    opened = TiledMap.open(before, open_search=opener(collection))
    assert isinstance(opened.search, QdrantSearch)
    assert isinstance(TiledMap.open(before).search, InvertedFile)
    headings, first = opened.manifest.headings, opened.tiles.first_place
    for descriptor in queries(before):
        views = np.array(exact(before, descriptor, opened.manifest.counts.views))
        tiles = np.searchsorted(first, views // headings, side="right") - 1
        wanted = list(dict.fromkeys(tiles.tolist()))[:MOST_SEARCHED]
        part = opened.searched(descriptor)
        numbers = part.numbers_of(np.arange(len(part.places), dtype=np.int32))
        assert set((np.searchsorted(first, numbers, side="right") - 1).tolist()) == set(wanted)


def test_a_map_of_few_tiles_needs_no_server(row: Row) -> None:
    def never(_: Manifest) -> Any:
        raise AssertionError

    assert TiledMap.open(row.map("few", tiles=MOST_SEARCHED), open_search=never).search is None


def test_a_map_of_many_tiles_needs_no_search_index_beside_a_server(before: Path, collection: Collection) -> None:
    index_maps([before], collection)
    read = read_manifest(before)
    less = read.model_copy(update={"files": {k: v for k, v in read.files.items() if k != "search.faiss"}}).stamped()
    path = before.parent / "without-index"
    shutil.copytree(before, path, ignore=shutil.ignore_patterns("search.faiss"))
    (path / "manifest.json").unlink()  # it may be a hard link
    (path / "manifest.json").write_bytes(less.to_bytes())
    with pytest.raises(BundleError, match=r"search.faiss: missing"):
        TiledMap.open(path)
    assert len(TiledMap.open(path, open_search=opener(collection)).searched(queries(before)[0]).places) == 72


def test_only_changed_tiles_are_sent(before: Path, after: Path, fake: FakeQdrant, collection: Collection) -> None:
    views = read_manifest(before).tiles[0].counts.views
    first = index_maps([before], collection)
    assert (first.sent, first.kept, first.views, fake.sent) == (TILES, 0, TILES * views, TILES * views)
    again = index_maps([before], collection)
    assert (again.sent, again.kept, again.views, fake.sent) == (0, TILES, 0, TILES * views)
    changed = index_maps([after], collection)
    assert (changed.sent, changed.kept, changed.views, changed.deleted) == (1, TILES - 1, views, 0)
    assert fake.client.count("town").count == (TILES + 1) * views
    # Both versions answer with their own views, although the collection has those of both.
    for path in (before, after):
        search = QdrantSearch(collection, read_manifest(path))
        for descriptor in queries(path):
            assert search.most_similar(descriptor, 30).tolist() == exact(path, descriptor, 30)


def test_old_tiles_are_deleted_on_demand_only(
    before: Path, after: Path, fake: FakeQdrant, collection: Collection
) -> None:
    from qdrant_client import models

    views = read_manifest(before).tiles[0].counts.views
    index_maps([before], collection)
    size = read_manifest(before).counts.descriptor_size
    fake.client.upsert("town", models.Batch(ids=[7], vectors=[[1.0] * size], payloads=[{"of": "another program"}]))
    assert index_maps([before, after], collection, prune=True).deleted == 0
    assert index_maps([after], collection, prune=True).deleted == views
    assert fake.client.count("town").count == TILES * views + 1
    assert QdrantSearch(collection, read_manifest(after)).most_similar(queries(after)[0], 5).shape == (5,)
    old = read_manifest(before).tiles[3]
    with pytest.raises(SearchError, match=rf"has 0 of the {views} views of {old.folder} \(column 3, row 0\)"):
        QdrantSearch(collection, read_manifest(before)).require_complete()


def test_an_interrupted_upload_completes(
    before: Path, fake: FakeQdrant, collection: Collection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(qdrant_module, "BATCH", 20)  # a tile needs three requests
    stages = []

    def interrupt(stage: str, done: int, total: int) -> None:
        stages.append((stage, done, total))
        if len(stages) == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        index_maps([before], collection, report=interrupt)
    tile = read_manifest(before).tiles[0]
    total = TILES * tile.counts.views
    assert stages[0] == ("index (views)", 0, total)
    assert fake.client.count("town").count == 20 + 20 + 8 + 20 + 20
    with pytest.raises(SearchError, match="has 40 of the 48 views of tiles/"):
        QdrantSearch(collection, read_manifest(before)).require_complete()
    done = index_maps([before], collection, report=lambda *each: stages.append(each))
    assert (done.sent, done.kept) == (TILES - 1, 1)
    assert stages[-1] == ("index (views)", total, total)
    assert fake.client.count("town").count == total


def test_a_missing_tile_is_named_when_the_map_opens(before: Path, collection: Collection) -> None:
    with pytest.raises(SearchError, match=r"status 404\); is there such a collection\? run `streetfix map index"):
        TiledMap.open(before, open_search=opener(collection))
    index_maps([before], collection)
    lost = read_manifest(before).tiles[5]
    collection.prune([tile.version for tile in read_manifest(before).tiles if tile != lost])
    with pytest.raises(
        SearchError, match=rf"0 of the 48 views of {lost.folder} .*run `streetfix map index MAP --qdrant"
    ):
        TiledMap.open(before, open_search=opener(collection))


def test_a_tile_that_is_deleted_later_is_named_by_a_query_that_finds_too_few(
    before: Path, collection: Collection
) -> None:
    index_maps([before], collection)
    opened = TiledMap.open(before, open_search=opener(collection))
    collection.prune([tile.version for tile in opened.manifest.tiles[:-1]])
    with pytest.raises(SearchError, match=opened.manifest.tiles[-1].version):
        opened.searched(queries(before)[0])


@pytest.mark.parametrize("view", [48, -1, "0", None])
def test_a_view_that_the_map_does_not_have_is_refused(
    before: Path, fake: FakeQdrant, collection: Collection, view: Any
) -> None:
    from qdrant_client import models

    index_maps([before], collection)
    read = read_manifest(before)
    vector = queries(before)[0]
    point = models.PointStruct(id=1, vector=vector.tolist(), payload={"tile": read.tiles[0].version, "view": view})
    fake.client.upsert("town", [point])
    with pytest.raises(SearchError, match="returned a view that the map does not have"):
        QdrantSearch(collection, read).most_similar(vector, 3)


def test_a_collection_for_other_vectors_is_refused(before: Path, fake: FakeQdrant, collection: Collection) -> None:
    from qdrant_client import models

    fake.client.create_collection("town", vectors_config=models.VectorParams(size=3, distance=models.Distance.COSINE))
    with pytest.raises(SearchError, match="not for 16 numbers with the distance Cosine; choose another"):
        index_maps([before], collection)


def test_damaged_descriptors_are_not_sent(row: Row, fake: FakeQdrant, collection: Collection) -> None:
    path = row.map("damaged", {0: 9})
    file = path / read_manifest(path).tiles[0].folder / "descriptors.npy"
    content = file.read_bytes()
    file.unlink()  # it is a hard link
    file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(BundleError, match=r"descriptors.npy: the hash does not match"):
        index_maps([path], collection)
    assert fake.sent == 0


def test_a_map_of_one_bundle_is_refused(bundle_path: Path, collection: Collection) -> None:
    with pytest.raises(BundleError, match="not a tiled map"):
        index_maps([bundle_path], collection)


def slow(_: BaseHTTPRequestHandler) -> bool:
    time.sleep(1.0)
    return True


def dripping(request: BaseHTTPRequestHandler) -> bool:
    request.send_response(200)
    request.send_header("Content-Length", "1000")
    request.end_headers()
    with suppress(OSError):  # the client gives up
        for _ in range(100):
            request.wfile.write(b" ")
            time.sleep(0.05)
    return True


def answering(content: bytes, status: int = 200, **headers: str) -> Callable[[BaseHTTPRequestHandler], bool]:
    def answer(request: BaseHTTPRequestHandler) -> bool:
        request.send_response(status)
        for name, value in headers.items():
            request.send_header(name.replace("_", "-"), value)
        request.send_header("Content-Length", str(len(content)))
        request.end_headers()
        with suppress(OSError):  # the client has given up
            request.wfile.write(content)
        return True

    return answer


@pytest.mark.parametrize(
    ("behaviour", "message"),
    [
        (slow, "no answer in time"),
        (dripping, "no answer in time"),
        (answering(b"x" * (qdrant_module.MOST_BYTES + 1)), "no connection: ReadError"),
        (answering(b"{}", Content_Encoding="gzip"), "no connection: RemoteProtocolError"),
        (answering(b"<html>"), "JSONDecodeError"),
        (answering(b"[" * 100_000), "the search cannot answer"),
        (answering(b'{"result": null}'), "AssertionError"),
        (answering(b'{"result": {"points": [{"id": 1}]}}'), "ValidationError"),
        (answering(b"secret text", 500), r"status 500\); check the server"),
        (answering(b"", 403), r"status 403\); set STREETFIX_QDRANT_API_KEY"),
        (answering(b"", 429, Retry_After="1"), "ResourceExhaustedResponse"),
        (answering(b"", 307, Location="http://127.0.0.1:1/"), "status 307"),
    ],
)
def test_a_server_that_misbehaves_is_a_clear_error_in_time(
    before: Path, fake: FakeQdrant, behaviour: Callable[[BaseHTTPRequestHandler], bool], message: str
) -> None:
    fake.before = behaviour
    timeout_s = 0.3 if "in time" in message else 60.0
    search = QdrantSearch(Collection.open(fake.url, "town", api_key=SECRET, timeout_s=timeout_s), read_manifest(before))
    with pytest.raises(SearchError, match=message) as caught:
        search.most_similar(queries(before)[0], 5)
    for hidden in (SECRET, "127.0.0.1", "secret text"):
        assert hidden not in caught.value.message
    assert len(fake.requests) == 1


def test_what_the_server_says_about_an_upload_is_shown(before: Path, fake: FakeQdrant, collection: Collection) -> None:
    def refuse(request: BaseHTTPRequestHandler) -> bool:
        if request.command == "PUT" and "/points" in request.path:
            return answering(b'{"status": {"error": "disk full"}}' + b" " * 10_000, 507)(request)
        return False

    fake.before = refuse
    with pytest.raises(
        SearchError, match=r"views cannot be stored in collection town \(status 507: .*disk full"
    ) as caught:
        index_maps([before], collection)
    assert len(caught.value.message) < 500


def test_an_unreachable_server_is_named(before: Path) -> None:
    with socket.socket() as closed:  # bound, and nobody listens
        closed.bind(("127.0.0.1", 0))
        opened = Collection.open(f"http://127.0.0.1:{closed.getsockname()[1]}")
        with pytest.raises(SearchError, match=r"no connection: ConnectError\); check the server, and the settings"):
            QdrantSearch(opened, read_manifest(before)).require_complete()


def test_threads_share_a_collection(before: Path, collection: Collection) -> None:
    index_maps([before], collection)
    search, found = QdrantSearch(collection, read_manifest(before)), {}
    asked = queries(before)

    def ask(number: int) -> None:
        found[number] = search.most_similar(asked[number], 20).tolist()

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(len(asked))]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert found == {number: exact(before, asked[number], 20) for number in range(len(asked))}


@pytest.mark.parametrize(
    "url",
    ["file:///etc/passwd", "ftp://host", "host:6333", "", "http://", "http://user:word@host", "http://h?a=b", "http://h#f",
     "http://h:99999", "http://h:0", "http://[::1", "http://h\n/", "http://h h"],
)  # fmt: skip
def test_a_wrong_url_is_refused_and_not_repeated(url: str) -> None:
    with pytest.raises(RequestError, match="the URL of Qdrant is not valid; write http://HOST:PORT") as caught:
        checked_search_url(url)
    assert "word" not in caught.value.message


@pytest.mark.parametrize("name", ["", "..", "a/b", "a b", "a" * 201, "a\n"])
def test_a_wrong_name_is_refused(name: str) -> None:
    with pytest.raises(RequestError, match="letters, digits"):
        checked_name(name)


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "qdrant_client", None)
    with pytest.raises(ExtraMissingError, match=r"qdrant_client.*\.\[qdrant\]"):
        Collection.open("http://127.0.0.1:1")


def test_the_command_indexes_and_prunes(
    before: Path, after: Path, fake: FakeQdrant, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STREETFIX_QDRANT_API_KEY", SECRET)
    at = ["--qdrant", fake.url, "--collection", "town"]
    done = CliRunner().invoke(app, ["index", str(before), *at])
    assert done.exit_code == 0, done.output
    assert f"collection town: 384 views of {TILES} tiles sent, 0 tiles there already, 0 views deleted" in done.output
    assert set(fake.keys) == {SECRET}
    assert SECRET not in done.output
    done = CliRunner().invoke(app, ["index", str(after), *at, "--prune"])
    assert (
        f"collection town: 48 views of 1 tiles sent, {TILES - 1} tiles there already, 48 views deleted" in done.output
    )
    assert "streetfix map index " in CliRunner().invoke(app, ["index", "--help"]).output
