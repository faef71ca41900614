"""The views of tiled maps in Qdrant, a search server, for maps whose tiles change all day.

A view is a point of a collection. Its vector is the 8-bit descriptor, which Qdrant scales to length 1. Its payload is the version of its
tile and its number in the tile. The version is the hash of the tile's content, so a point never changes. A search filters on the versions
of the served map. So it never returns views of another version, even while a collection changes. Decision 0178 has the figures.
"""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import UUID, uuid5

import httpx
import numpy as np
from jaxtyping import Float32, Int64
from numpy.typing import NDArray

from service.errors import BundleError, SearchError, damaged_file, extra_missing
from service.maps import index
from service.maps.index import Rows, read_descriptors
from service.maps.manifest import FILE, Manifest, Tile, read_manifest
from service.maps.search_address import COLLECTION, checked_name, checked_search_url
from service.maps.writer import sha256_of

#: Time for one request that counts, writes or deletes points, s.
CARE_S = 60.0
#: Views in one request of an upload: less than 1 MB for descriptors of 256 numbers.
BATCH = 512
#: Largest answer that is read, bytes. An answer with 1,000 views has less than 300 kB.
MOST_BYTES = 8 * 2**20
_TILE, _VIEW = "tile", "view"
#: Namespace of the ids of points. It must never change, or a collection would hold views twice.
_NAMESPACE = UUID("6d5b3a52-3c1e-5d0b-9a55-0a3c5b1f2e77")
#: Qdrant closes idle connections after 5 s.
_IDLE_S = 4.0
#: Progress callback: stage, finished units, all units.
Report = Callable[[str, int, int], object]


class Collection:
    """A collection of Qdrant. Threads may share it. A process must open its own one after ``fork``.

    Args:
        client: a ``qdrant_client.QdrantClient``.
        name: of the collection.

    Attributes:
        name: as given.
    """

    def __init__(self, client: Any, name: str) -> None:
        from qdrant_client import models

        self.name = name
        self._client, self._models = client, models

    @classmethod
    def open(
        cls, url: str, name: str = COLLECTION, *, api_key: str | None = None, timeout_s: float = CARE_S
    ) -> "Collection":
        """Prepare the connection. This sends nothing.

        Args:
            url: of the server.
            name: of the collection.
            api_key: of the server; None if it needs none.
            timeout_s: time for one request, s. An answer that arrives in pieces may take twice as long.

        Raises:
            RequestError: the URL or the name is not valid.
            ExtraMissingError: qdrant-client is not installed.
        """
        url, name = checked_search_url(url), checked_name(name)
        try:
            from qdrant_client import QdrantClient
        except ModuleNotFoundError as error:
            raise extra_missing("search with Qdrant", "qdrant", error) from error
        # As the parameter of its own, the client would warn of a key without TLS at each start.
        headers = {"Accept-Encoding": "identity"} | ({} if api_key is None else {"api-key": api_key})
        client = QdrantClient(
            url=url,
            headers=headers,
            transport=_Transport(timeout_s),
            timeout=int(timeout_s) + 1,
            check_compatibility=False,
        )
        return cls(client, name)

    def close(self) -> None:
        """Close the connections."""
        self._client.close()

    def prepare(self, dimension: int) -> None:
        """Create the collection, unless it is there.

        Vectors lie on the disk. Codes of one byte per number in memory make the search.

        Args:
            dimension: number of components of a descriptor.

        Raises:
            SearchError: the server does not answer, or the collection is for other vectors.
        """
        models = self._models
        with self._telling(f"collection {self.name} cannot be created"):
            if not self._client.collection_exists(self.name):
                codes = models.ScalarQuantizationConfig(type=models.ScalarType.INT8, always_ram=True)
                self._client.create_collection(
                    self.name,
                    vectors_config=models.VectorParams(size=dimension, distance=models.Distance.COSINE, on_disk=True),
                    quantization_config=models.ScalarQuantization(scalar=codes),
                )
            # Again if an earlier run was interrupted here. It does nothing if there is one.
            self._client.create_payload_index(self.name, _TILE, models.PayloadSchemaType.KEYWORD)
            has = self._client.get_collection(self.name).config.params.vectors
        if getattr(has, "size", None) != dimension or has.distance != models.Distance.COSINE:
            raise SearchError(
                f"collection {self.name} of Qdrant is not for {dimension} numbers with the distance Cosine; choose another --collection"
            )

    def views_of(self, versions: Sequence[str]) -> Mapping[str, int]:
        """Return the number of views of some tiles in the collection, by version; tiles without views are left out.

        Args:
            versions: of the tiles.

        Raises:
            SearchError: the server does not answer, or there is no such collection.
        """
        with self._telling(f"the views in collection {self.name} cannot be counted"):
            found = self._client.facet(
                self.name, _TILE, facet_filter=self.only(versions), limit=max(1, len(versions)), exact=True
            )
            return {str(hit.value): int(hit.count) for hit in found.hits}

    def put(self, version: str, first: int, numbers: NDArray[np.int8]) -> None:
        """Store some views of a tile. Views that are there stay one point each.

        Args:
            version: of the tile.
            first: number of the first view in the tile.
            numbers: 8-bit descriptors (n, D).

        Raises:
            SearchError: the server does not answer, or refuses them.
        """
        views = range(first, first + len(numbers))
        with self._telling(f"views cannot be stored in collection {self.name}", shown=True):
            self._client.upsert(
                self.name,
                self._models.Batch(
                    ids=[str(uuid5(_NAMESPACE, f"{version}/{view}")) for view in views],
                    vectors=numbers.tolist(),
                    payloads=[{_TILE: version, _VIEW: view} for view in views],
                ),
                wait=True,
            )

    def prune(self, keep: Sequence[str]) -> int:
        """Delete the views of all other tiles. Points without a tile stay.

        Args:
            keep: versions of the tiles that stay.

        Returns:
            Number of deleted views.

        Raises:
            SearchError: the server does not answer.
        """
        models = self._models
        no_view = models.IsEmptyCondition(is_empty=models.PayloadField(key=_TILE))
        others = models.Filter(must_not=[*self.only(keep).must, no_view])
        with self._telling(f"views cannot be deleted from collection {self.name}"):
            count = int(self._client.count(self.name, count_filter=others, exact=True).count)
            if count:
                self._client.delete(self.name, models.FilterSelector(filter=others), wait=True)
        return count

    def nearest(self, descriptor: Float32[NDArray[np.float32], " D"], only: Any, k: int) -> list[tuple[object, object]]:
        """Return version and number of the k most similar views, the most similar first.

        Args:
            descriptor: of the query.
            only: filter of the tiles, from ``only``.
            k: number of views.

        Raises:
            SearchError: the server does not answer.
        """
        with self._telling("the search cannot answer"):
            found = self._client.query_points(
                self.name, query=descriptor.tolist(), query_filter=only, limit=k, with_payload=[_TILE, _VIEW]
            ).points
        return [((each.payload or {}).get(_TILE), (each.payload or {}).get(_VIEW)) for each in found[:k]]

    def only(self, versions: Sequence[str]) -> Any:
        """Return the filter for the views of some tiles.

        Args:
            versions: of the tiles.
        """
        models = self._models
        return models.Filter(must=[models.FieldCondition(key=_TILE, match=models.MatchAny(any=list(versions)))])

    @contextmanager
    def _telling(self, what: str, *, shown: bool = False) -> Iterator[None]:
        """Turn errors of the client into errors without address and key.

        Args:
            what: what does not work.
            shown: whether to show what the server says, which the sender of a request must not see.
        """
        from qdrant_client.common.client_exceptions import QdrantException
        from qdrant_client.http.exceptions import ApiException

        try:
            yield
        except (
            ApiException,
            QdrantException,
            httpx.HTTPError,
            httpx.InvalidURL,
            OSError,
            AssertionError,
            ValueError,
        ) as error:
            raise SearchError(f"{what} ({_reason(error, shown=shown)}); {_remedy(error)}") from error
        except RecursionError as error:  # an answer of nested lists
            raise SearchError(f"{what} (the answer is not valid); is this address Qdrant's?") from error


class QdrantSearch:
    """Finds the views of a map that are similar to a query, as ``InvertedFile`` does. Threads may share it.

    Args:
        collection: with all views of the map.
        of_map: manifest of the map.
    """

    def __init__(self, collection: Collection, of_map: Manifest) -> None:
        self._collection, self._manifest = collection, of_map
        before = np.cumsum([0, *(tile.counts.views for tile in of_map.tiles)]).tolist()
        self._views = {tile.version: (before[k], tile.counts.views) for k, tile in enumerate(of_map.tiles)}
        self._only = collection.only([*self._views])

    def require_complete(self, counting: Collection | None = None) -> None:
        """Check that the collection has every view of the map.

        Args:
            counting: the same collection with more time for a request; None takes that of the searches.

        Raises:
            SearchError: views of a tile are missing, or the server does not answer.
        """
        name = self._collection.name
        has = (counting or self._collection).views_of([*self._views])
        for tile in self._manifest.tiles:
            if (count := has.get(tile.version, 0)) != tile.counts.views:
                raise SearchError(
                    f"map {self._manifest.name}: collection {name} of Qdrant has {count} of the {tile.counts.views} views of "
                    f"{tile.folder} (column {tile.column}, row {tile.row}); run `streetfix map index MAP --qdrant URL --collection {name}`"
                )

    def shortlist(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the indices of about the k most similar views.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list, at most the number of views.

        Raises:
            SearchError: as ``most_similar``.
        """
        return self.most_similar(descriptor, k)

    def most_similar(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the indices of about the k most similar views, the most similar first.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list, at most the number of views.

        Raises:
            SearchError: the server does not answer in time, or the collection lacks views of the map.
        """
        found = self._collection.nearest(descriptor, self._only, k)
        if len(found) < k:  # somebody has deleted views, or the graph of the server does not lead to all of them
            self.require_complete()
        return np.array([self._index(*each) for each in found], np.int64)

    def _index(self, version: object, view: object) -> int:
        first, count = self._views.get(version, (0, 0)) if isinstance(version, str) else (0, 0)
        if not isinstance(view, int) or not 0 <= view < count:
            raise SearchError(
                f"map {self._manifest.name}: collection {self._collection.name} of Qdrant returned a view that the map does not have; "
                "index the map into another collection"
            )
        return first + view


@dataclass(frozen=True, slots=True)
class Indexed:
    """What ``index_maps`` did.

    Attributes:
        sent: tiles whose views were sent.
        kept: tiles whose views were there already.
        views: views that were sent.
        deleted: views that were deleted.
    """

    sent: int
    kept: int
    views: int
    deleted: int


def index_maps(
    folders: Sequence[Path], collection: Collection, *, prune: bool = False, report: Report = lambda *_: None
) -> Indexed:
    """Bring a collection in line with tiled maps. If it was interrupted, call it again.

    Tiles whose views are all there are not sent again.

    Args:
        folders: of the maps. All have descriptors of one size.
        collection: the collection; created if it is missing.
        prune: delete the views of all tiles that none of these maps has.
        report: called with the number of views.

    Raises:
        BundleError: a map is damaged, or not tiled, or has descriptors of another size.
        SearchError: the server does not answer, or refuses the views.
    """
    maps = [(folder, read_manifest(folder)) for folder in folders]
    size = maps[0][1].counts.descriptor_size
    for folder, read in maps:
        if not read.tiles:
            raise BundleError(f"{folder}: a map of one bundle, not a tiled map; it needs no Qdrant", field=FILE)
        if read.counts.descriptor_size != size:
            raise BundleError(
                f"{folder}: descriptors of {read.counts.descriptor_size} numbers, but {folders[0]} has {size}; index them "
                "into different collections",
                field=index.FILE,
            )
    tiles = {tile.version: (folder, tile) for folder, read in maps for tile in read.tiles}
    collection.prepare(size)
    has = collection.views_of([*tiles])
    missing = {version: each for version, each in tiles.items() if has.get(version, 0) != each[1].counts.views}
    total = sum(tile.counts.views for _, tile in tiles.values())
    views = sum(tile.counts.views for _, tile in missing.values())
    done = total - views
    report("index (views)", done, total)
    for folder, tile in missing.values():
        numbers = _descriptors_of(folder, tile)
        for first in range(0, len(numbers), BATCH):
            some = numbers[first : first + BATCH]
            collection.put(tile.version, first, some)
            done += len(some)
            report("index (views)", done, total)
    deleted = collection.prune([*tiles]) if prune else 0
    for _, read in maps:
        QdrantSearch(collection, read).require_complete()
    return Indexed(len(missing), len(tiles) - len(missing), views, deleted)


def _descriptors_of(folder: Path, tile: Tile) -> Rows:
    """Return the descriptors of a tile, after a comparison of their hash."""
    place = folder / tile.folder
    read, path = read_manifest(place), place / index.FILE
    if read.version != tile.version:
        raise damaged_file(place / FILE, f"version {read.version}, but the map lists {tile.version}")
    numbers = read_descriptors(path)
    if index.FILE not in read.files or sha256_of(path) != read.files[index.FILE].sha256:
        raise damaged_file(path, "the hash does not match the manifest")
    if numbers.shape != (tile.counts.views, tile.counts.descriptor_size):
        raise damaged_file(
            path, f"shape {numbers.shape} instead of ({tile.counts.views}, {tile.counts.descriptor_size})"
        )
    return numbers


class _Transport(httpx.HTTPTransport):
    """Bounds time and size of every answer. Proxies of the environment are not used.

    Args:
        timeout_s: time for a connection, for each piece of an answer, and until the last piece begins, s.
    """

    def __init__(self, timeout_s: float) -> None:
        super().__init__(limits=httpx.Limits(keepalive_expiry=_IDLE_S))
        self._timeout_s = timeout_s

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        until_s = time.monotonic() + self._timeout_s
        request.extensions = {**request.extensions, "timeout": httpx.Timeout(self._timeout_s).as_dict()}
        response = super().handle_request(request)
        if "content-encoding" in response.headers:
            response.close()
            raise httpx.RemoteProtocolError("a compressed answer, although none was asked for")
        response.stream = _Bounded(response.stream, until_s)
        return response


class _Bounded(httpx.SyncByteStream):
    """The body of an answer, up to a size and a time.

    Args:
        stream: the body.
        until_s: time of ``time.monotonic``.
    """

    def __init__(self, stream: Any, until_s: float) -> None:
        self._stream, self._until_s = stream, until_s

    def __iter__(self) -> Iterator[bytes]:
        size = 0
        for chunk in self._stream:
            size += len(chunk)
            if size > MOST_BYTES:
                raise httpx.ReadError(f"an answer of more than {MOST_BYTES} bytes")
            if time.monotonic() > self._until_s:
                raise httpx.ReadTimeout("the answer takes too long")
            yield chunk

    def close(self) -> None:
        self._stream.close()


def _reason(error: Exception, *, shown: bool) -> str:
    """Return why a request failed, without address and key. What the server says is returned only if ``shown``."""
    source = getattr(error, "source", error)
    if (status := getattr(error, "status_code", None)) is not None:
        content = getattr(error, "content", b"")[:300].decode(errors="replace") if shown else ""
        return f"status {status}{': ' if content else ''}{content}"
    if isinstance(source, httpx.TimeoutException):
        return "no answer in time"
    if isinstance(source, httpx.TransportError | OSError):
        return f"no connection: {type(source).__name__}"
    return f"{type(source).__name__}: {str(source)[:300]}" if shown else type(source).__name__


def _remedy(error: Exception) -> str:
    status = getattr(error, "status_code", None)
    if status in (401, 403):
        return "set STREETFIX_QDRANT_API_KEY to a key of the server"
    if status == 404:
        return "is there such a collection? run `streetfix map index MAP --qdrant URL`"
    return "check the server, and the settings STREETFIX_QDRANT_*"
