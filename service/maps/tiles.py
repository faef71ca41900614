"""A tiled map: a bundle for each square of the ground. A query opens the few tiles that it needs.

The search index of the whole map finds the tiles that resemble a query. A prior, or the poses that are registered, name tiles too.
Their parts together behave like a map of one bundle.
"""

import threading
import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from numpy.typing import NDArray

from service.errors import BundleError, damaged_file
from service.maps import content as parts
from service.maps import inverted_file, manifest, streets
from service.maps.ahead import Ahead
from service.maps.around import nearest_square, ranks_of_regions, tiles_around
from service.maps.calibration import read_calibration
from service.maps.checked_tiles import Checked, CheckedTiles, mark_of
from service.maps.files import map_array, read_file, require_files
from service.maps.index import Shortlister, ViewIndex
from service.maps.inverted_file import InvertedFile
from service.maps.joined_index import JoinedRows, JoinedShortlists
from service.maps.manifest import FileEntry, Manifest, Tile, read_manifest
from service.maps.map import Map
from service.maps.reader import MapBundle, read_streets
from service.maps.streets import Streets, StreetsFile
from service.registration.surfel_map import SurfelMap
from service.registration.surfel_tiles import JoinedSurfels, Surfels, SurfelTiles, lies_on_lattice

#: Largest number of tiles that are searched for one query. A map of more tiles needs a search index, which chooses them.
MOST_SEARCHED = 6
#: Largest number of tiles that the poses of a query may lie in: those searched for several frames, and those of predicted poses.
MOST_AROUND = 2 * MOST_SEARCHED
#: Views that the search index lists to choose the tiles.
LISTED = 1_000
#: Limit of the size of all open tiles, bytes. The system keeps only the parts in memory that queries read.
OPEN_BYTES = 4 * 2**30
#: Tiles so near to the position of a query are expected next, m. The path of a robot is followed twice as far.
EXPECT_M = 300.0
#: Largest number of tiles that one query expects.
MOST_EXPECTED = 8
#: A shorter step has no direction: the robot stands, m.
LEAST_STEP_M = 0.05
#: An expected tile is prepared again after this time, s. Until then it may have been closed, or deleted from a cache.
PREPARE_EVERY_S = 10.0
#: Largest number of regions that are kept, each put together from several tiles.
MOST_REGIONS = 16
#: Largest number of joined clouds that the cloud of the whole map keeps.
MOST_KEPT = 16
_NEEDED = (parts.ENCODER_FILE, parts.PLACES_FILE, parts.CALIBRATION_FILE)


@runtime_checkable
class TileSource(Protocol):
    """Where the tiles of a map come from."""

    @property
    def checked(self) -> CheckedTiles:
        """What this process has checked of the tiles. The sources of the versions of a map share it."""

    def folder(self, tile: Tile, *, ahead: bool = False) -> Path:
        """Return a local folder with the complete bundle of a tile. Several threads may ask at once.

        Args:
            tile: as the manifest of the map lists it.
            ahead: no request waits for it.

        Raises:
            BundleError: the tile is missing or damaged, or cannot be fetched.
        """

    def used(self, tile: Tile) -> None:
        """Take note that an open tile is in use. It is called for every query.

        Args:
            tile: as the manifest of the map lists it.
        """


@runtime_checkable
class PlaceSearch(Shortlister, Protocol):
    """Finds the views of a whole map that resemble a query: ``InvertedFile``, or a server that has the views."""

    def most_similar(self, descriptor: Float32[NDArray[np.float32], " D"], k: int) -> Int64[NDArray[np.int64], " n"]:
        """Return the indices of about the k most similar views, the most similar first.

        Args:
            descriptor: descriptor of the query view.
            k: length of the list, at most the number of views.

        Raises:
            SearchError: a server does not answer, or lacks views of the map.
        """


#: Opens the search of a map by its manifest.
OpenSearch = Callable[[Manifest], PlaceSearch]


@dataclass(frozen=True, slots=True)
class LocalTiles:
    """Tiles in the folder of the map.

    Attributes:
        path: folder of the map.
        checked: what this process has checked of the tiles.
    """

    path: Path
    checked: CheckedTiles = field(default_factory=CheckedTiles)

    def folder(self, tile: Tile, *, ahead: bool = False) -> Path:  # noqa: ARG002 - as of TileSource
        """Return the folder of a tile.

        Args:
            tile: as the manifest of the map lists it.
            ahead: no request waits for it.
        """
        return self.path / tile.folder

    def used(self, tile: Tile) -> None:
        """Do nothing, because no tile is deleted.

        Args:
            tile: a tile of the map.
        """


def open_map(
    path: Path,
    *,
    verify: bool = True,
    source: TileSource | None = None,
    open_bytes: int = OPEN_BYTES,
    open_search: OpenSearch | None = None,
) -> Map:
    """Open a map of one bundle or a tiled map.

    Args:
        path: folder of the map.
        verify: compare the hash of every file with the manifest. Those of a tile are compared when it is first opened, unless the source
            knows that this process has compared them.
        source: where the tiles of a tiled map come from; None takes them from ``path``.
        open_bytes: limit of the size of all open tiles of a tiled map, bytes.
        open_search: opens the search of a map of more than ``MOST_SEARCHED`` tiles; None takes the search index in ``path``.

    Raises:
        BundleError: the map is missing, damaged, of another format, or inconsistent.
        SearchError: the search cannot be opened.
    """
    if read_manifest(path).tiles:
        return TiledMap.open(path, verify=verify, source=source, open_bytes=open_bytes, open_search=open_search)
    return MapBundle.open(path, verify=verify)


class OpenTiles:
    """The tiles of a map that are open. The least recently used ones are closed. Several threads may share them.

    A tile that opens gets the street numbers and the nominal LiDAR height of the map.

    Args:
        path: folder of the map.
        of_map: manifest of the map.
        of_streets: streets of the map; None if it has none.
        source: where the tiles come from.
        verify: check the hash of every file of a tile, and every index in it, when the tile opens, unless ``source.checked`` has these
            files.
        open_bytes: limit of the size of all open tiles, bytes, without the files that the service does not read. At least one tile is
            open.

    Attributes:
        squares_m: x0, y0, x1, y1 of each tile, map frame, m.
        first_place: number of the first place of each tile, and the number of all places.
        opens_ahead: whether tiles that a moving camera may reach soon are fetched, checked and opened in the background. A service switches
            it on after the first query, which is a random one.
    """

    def __init__(
        self,
        path: Path,
        of_map: Manifest,
        of_streets: StreetsFile | None,
        source: TileSource,
        *,
        verify: bool,
        open_bytes: int,
    ) -> None:
        self._path, self._manifest, self._source, self._streets = path, of_map, source, of_streets
        self._street_number = street_numbers(None if of_streets is None else of_streets.streets)
        self._verify, self._limit = verify, open_bytes
        self.opens_ahead = False
        self._on_change: Callable[[], object] = lambda: None
        self._ahead = Ahead(self._prepare)
        self._prepared_s: dict[int, float] = {}
        self._opened: OrderedDict[int, MapBundle] = OrderedDict()
        self._regions: dict[tuple[int, ...], Map] = {}
        self._kept_of_map: dict[tuple[int, ...], Surfels] = {}
        self._changing = threading.Lock()
        self._opening: defaultdict[int, threading.Lock] = defaultdict(threading.Lock)
        corners = np.array(
            [[tile.column, tile.row, tile.column + 1, tile.row + 1] for tile in of_map.tiles], np.float64
        )
        self._tile_m = of_map.tile_m or 1.0
        self._number = {(tile.column, tile.row): number for number, tile in enumerate(of_map.tiles)}
        self.squares_m = corners * self._tile_m
        self.first_place = np.cumsum([0, *(tile.counts.places for tile in of_map.tiles)])

    def __len__(self) -> int:
        """Return the number of tiles of the map, open or not."""
        return len(self._manifest.tiles)

    @property
    def opened(self) -> tuple[int, ...]:
        """Numbers of the open tiles, the least recently used first."""
        with self._changing:
            return tuple(self._opened)

    def watch(self, callback: Callable[[], object]) -> None:
        """Report when tiles were opened or closed.

        Args:
            callback: called by the thread that opened them, afterwards.
        """
        self._on_change = callback

    def get(self, number: int) -> MapBundle:
        """Return a tile; open it if needed.

        Args:
            number: number of the tile in the manifest.

        Raises:
            BundleError: the tile is missing or damaged, or does not belong to this map.
        """
        if (known := self._known(number)) is not None:
            return known
        with self._changing:
            opening = self._opening[number]
        with opening:  # other threads that need this tile wait; those that need others do not
            if (known := self._known(number)) is not None:
                return known
            made = self._open(self._manifest.tiles[number])
            with self._changing:
                self._opened[number] = made
                self._close_some()
            self._on_change()
            return made

    def get_all(self, numbers: Sequence[int]) -> list[MapBundle]:
        """Return several tiles. Those that are closed are opened side by side: most of the time goes into reading or fetching their files.

        Args:
            numbers: numbers of the tiles in the manifest.

        Raises:
            BundleError: as ``get``.
        """
        closed = [number for number in numbers if self._known(number) is None]
        if len(closed) < 2:
            return [self.get(number) for number in numbers]
        with ThreadPoolExecutor(len(closed), thread_name_prefix="open-tile") as pool:
            opened = dict(zip(closed, pool.map(self.get, closed), strict=True))
        return [opened[number] if number in opened else self.get(number) for number in numbers]

    def at(self, xy_m: Float64[NDArray[np.float64], "n 2"]) -> Int64[NDArray[np.int64], " m"]:
        """Return the numbers of the tiles at some positions, each once, in the order of the positions.

        A position outside of all squares counts as one in the nearest square.

        Args:
            xy_m: x and y, map frame, m.
        """
        cells, first = np.unique(np.floor(xy_m / self._tile_m).astype(np.int64), axis=0, return_index=True)
        found = []
        for row in np.argsort(first):
            number = self._number.get((int(cells[row, 0]), int(cells[row, 1])))
            found.append(int(_away_m(self.squares_m, xy_m[first[row]]).argmin()) if number is None else number)
        return in_order(np.array(found, np.int64))

    def expect_around(
        self, xy_m: Float64[NDArray[np.float64], "2"], before_m: Float64[NDArray[np.float64], "2"] | None = None
    ) -> None:
        """Prepare closed tiles that a moving camera may reach soon, in the background. This does nothing unless ``opens_ahead``.

        A prepared tile is in the cache, and its files are checked. It stays open if it fits without closing another one. It is closed
        before all tiles that queries have used.

        Args:
            xy_m: x and y of the camera, map frame, m.
            before_m: x and y one step earlier, map frame, metres; None if unknown.
        """
        if not self.opens_ahead:
            return
        near, now_s = expected_next(self.squares_m, xy_m, before_m).tolist(), time.monotonic()
        with self._changing:
            closed = [
                number
                for number in near
                if number not in self._opened
                and now_s - self._prepared_s.get(number, -PREPARE_EVERY_S) >= PREPARE_EVERY_S
            ]
        if closed:
            self._ahead.expect(closed, is_ordered=before_m is not None)

    def region(self, numbers: tuple[int, ...], make: Callable[[tuple[int, ...]], Map]) -> Map:
        """Return the parts of some tiles together. They are kept as long as all of these tiles and those around them are open.

        Args:
            numbers: numbers of the tiles, ascending.
            make: puts the parts together.
        """
        with self._changing:
            known = self._regions.get(numbers)
            if known is not None:
                for number in (*_beside(known), *numbers):
                    self._opened.move_to_end(number)
                    self._source.used(self._manifest.tiles[number])
                return known
        made = make(numbers)
        with self._changing:
            if all(number in self._opened for number in numbers):
                self._regions[numbers] = made
                while len(self._regions) > MOST_REGIONS:
                    del self._regions[next(iter(self._regions))]
        return made

    def cloud(self, numbers: Sequence[int], opened: Sequence[MapBundle] | None = None) -> SurfelTiles | None:
        """Return the clouds of some tiles; None if the map has no cloud.

        Args:
            numbers: numbers of the tiles.
            opened: these tiles; None opens each one when it is needed.
        """
        if not self._manifest.counts.cloud_points:
            return None
        among = np.array(numbers, np.int64)
        squares_m = self.squares_m[among]
        middle_m = np.array([*(squares_m[:, :2] + squares_m[:, 2:]).mean(axis=0) / 2, 0.0])
        has_brightness = opened is not None and all(
            each.cloud is not None and each.cloud.has_brightness for each in opened
        )
        drawn = range(len(numbers)) if opened is not None or isinstance(self._source, LocalTiles) else None
        own = {} if opened is None else dict(zip(numbers, opened, strict=True))
        kept: dict[tuple[int, ...], Surfels] = {} if opened is not None else self._kept_of_map

        def tiles_near(xy_m: Float64[NDArray[np.float64], "n 2"]) -> list[tuple[int, ...]]:
            found = self.near(xy_m, among)
            if opened is not None:  # a query opens all its tiles side by side
                closed = sorted({number for around in found for number in around} - own.keys())
                own.update(zip(closed, self.get_all(closed), strict=True))
            return found

        def surfels_of(around: tuple[int, ...]) -> Surfels:
            if (known := kept.get(around)) is not None:
                return known
            made = self._joined(around, own)
            with self._changing:
                is_open = all(number in self._opened for number in around)
                if opened is not None:
                    kept[around] = made
                    if not is_open:  # the region ends with its query
                        self._regions.pop(tuple(sorted(numbers)), None)
                elif is_open:
                    kept[around] = made
                    while len(kept) > MOST_KEPT:
                        del kept[next(iter(kept))]
            return made

        return SurfelTiles(
            tiles_near,
            surfels_of,
            middle_m,
            has_brightness,
            lambda: self.opened if drawn is None else [numbers[row] for row in drawn],
            kept,
        )

    def near(
        self, xy_m: Float64[NDArray[np.float64], "n 2"], among: Int64[NDArray[np.int64], " m"]
    ) -> list[tuple[int, ...]]:
        """Return the tiles whose surfels a camera may see from each position, by their numbers.

        The tile at the position comes first. If it is not among the given ones, the nearest of these comes first. The others follow in the
        order of the map.

        Args:
            xy_m: positions, map frame, m.
            among: numbers of the tiles that a query uses.
        """
        first = among[nearest_square(self.squares_m[among], xy_m)]
        return tiles_around(self._number, self._tile_m, xy_m, first)

    def _joined(self, numbers: tuple[int, ...], own: Mapping[int, MapBundle]) -> Surfels:
        """Return the surfels of some tiles together. The first one gives the frame. ``own`` has tiles that need not be opened."""
        closed = [number for number in numbers if number not in own]
        opened = {**own, **dict(zip(closed, self.get_all(closed), strict=True))}
        clouds = {number: opened[number].cloud for number in numbers}
        known = {number: cloud for number, cloud in clouds.items() if isinstance(cloud, SurfelMap)}
        if not known:
            raise damaged_file(self._path / self._manifest.tiles[numbers[0]].folder, "the tile has no cloud")
        if len(known) == 1:
            return next(iter(known.values()))
        tiles, edge_m = self._manifest.tiles, self._tile_m
        return JoinedSurfels.of(
            list(known.values()), [ranks_of_regions(cloud, tiles[number], edge_m) for number, cloud in known.items()]
        )

    def _prepare(self, number: int) -> None:
        """Fetch and check a tile, and open it if there is room."""
        tile = self._manifest.tiles[number]
        with self._changing:
            opening = self._opening[number]
        try:
            with opening:
                with self._changing:
                    if number in self._opened:
                        return
                    has_room = self._has_room(tile.size)  # it counts all files, so there may be more room
                if not has_room and self._is_checked(tile, folder := self._source.folder(tile, ahead=True)):
                    size = served_bytes(read_manifest(folder).files)
                    with self._changing:
                        has_room = self._has_room(size)
                    if not has_room:
                        return
                made = self._open(tile, ahead=True)
                with self._changing:
                    if self._has_room(served_bytes(made.manifest.files)):
                        self._opened[number] = made
                        self._opened.move_to_end(number, last=False)  # no query has used it
                self._on_change()
        finally:
            self._prepared_s[number] = time.monotonic()

    def _has_room(self, size: int) -> bool:
        return self._open_bytes() + size <= self._limit

    def _open_bytes(self) -> int:
        """Return the size of the files that the open tiles map into memory, bytes."""
        return sum(served_bytes(bundle.manifest.files) for bundle in self._opened.values())

    def _is_checked(self, tile: Tile, folder: Path) -> bool:
        return not self._verify or self._source.checked.get(tile.version, mark_of(folder)) == Checked.ALL

    def _known(self, number: int) -> MapBundle | None:
        with self._changing:
            if number in self._opened:
                self._opened.move_to_end(number)
                self._source.used(self._manifest.tiles[number])
            return self._opened.get(number)

    def _close_some(self) -> None:
        while len(self._opened) > 1 and self._open_bytes() > self._limit:
            closed, _ = self._opened.popitem(last=False)
            for around in [around for around in self._kept_of_map if closed in around]:
                del self._kept_of_map[around]
            self._regions = {key: each for key, each in self._regions.items() if closed not in {*key, *_beside(each)}}

    def _open(self, tile: Tile, *, ahead: bool = False) -> MapBundle:
        """Open a tile. A request may do so, and its answer names no folder of the machine and no address."""
        named = f"map {self._manifest.name}, {tile.folder}"
        for is_last in (False, True):
            try:
                folder = self._source.folder(tile, ahead=ahead)
            except BundleError as error:
                what = f"{named}: the tile cannot be fetched; the log of the service says why"
                raise BundleError(what, field=error.field) from error
            try:
                return self._opened_from(folder, tile)
            except BundleError as error:
                if is_last or folder.exists():
                    raise BundleError(error.message.replace(str(folder), named), field=error.field) from error
                # A cache deleted it meanwhile.
        raise AssertionError  # the last turn returns or raises

    def _opened_from(self, folder: Path, tile: Tile) -> MapBundle:
        mark, checked = b"", Checked.ALL
        if self._verify:
            mark = mark_of(folder)
            checked = self._source.checked.get(tile.version, mark)
        bundle = MapBundle.open(
            folder,
            verify=checked < Checked.ALL,
            compare_hashes=checked < Checked.HASHES,
            known_streets=self._streets,  # most tiles have the file of the map
        )
        if bundle.manifest.version != tile.version:
            raise damaged_file(
                folder / manifest.FILE, f"version {bundle.manifest.version}, but the map lists {tile.version}"
            )
        if different := differences(bundle.manifest, self._manifest):
            raise damaged_file(folder / manifest.FILE, f"{different[0]} differs from the map")
        if bundle.manifest.counts != tile.counts:
            raise damaged_file(folder / manifest.FILE, "the counts are not those that the map lists")
        if len(self) > 1 and isinstance(bundle.cloud, SurfelMap) and not lies_on_lattice(bundle.cloud):
            what = "the grid does not fit to those of other tiles, as in a map of an earlier release"
            raise damaged_file(folder / parts.CLOUD_FOLDER / "grid_frame.npy", what)
        try:
            places = places_in_map(bundle, self._street_number, self._manifest.lidar_height_m)
        except KeyError as error:
            raise damaged_file(folder / streets.FILE, f"the map has no street {error.args[0]!r}") from error
        if self._verify:
            self._source.checked.add(tile.version, mark, Checked.ALL)
        return replace(bundle, places=places)


def require_shared_cloud(path: Path, read: Manifest) -> None:
    """Refuse a tiled map of an earlier release, whose tiles repeat the surfaces around them.

    Args:
        path: folder of the map.
        read: its manifest.

    Raises:
        BundleError: the map is of an earlier release.
    """
    if "tile_margin_m" in read.parameters:
        what = "its tiles overlap as in an earlier release; build the map again with this release"
        raise BundleError(f"{path}: {what}", field=manifest.FILE)


def differences(tile: Manifest, of_map: Manifest) -> list[str]:
    """Return what a tile does not share with its map, or with another tile; empty if it fits.

    Args:
        tile: manifest of the tile.
        of_map: manifest of the map, or of another tile.
    """
    shared = ("encoder_sha256", "grid", "headings", "spacing_m", "rows_seen", "georeference")
    found = [name for name in shared if getattr(tile, name) != getattr(of_map, name)]
    if tile.counts.descriptor_size != of_map.counts.descriptor_size:
        found.append("counts.descriptor_size")
    return found


def needs_search(of_map: Manifest) -> bool:
    """Return whether a map has so many tiles that a search of the whole map chooses those of a query.

    Args:
        of_map: manifest of the map.
    """
    return len(of_map.tiles) > MOST_SEARCHED


def files_unread(of_map: Manifest, *, is_searched_elsewhere: bool) -> frozenset[str]:
    """Return the files of a map, outside of its tiles, that a service does not read.

    Args:
        of_map: manifest of the map.
        is_searched_elsewhere: whether a server chooses the tiles of maps with many tiles, and not their search indices.
    """
    is_unread = is_searched_elsewhere and needs_search(of_map)
    return parts.NOT_SERVED | ({inverted_file.FILE} if is_unread else frozenset())


def served_bytes(files: Mapping[str, FileEntry]) -> int:
    """Return the size of the files of a bundle that the service reads, bytes.

    Args:
        files: files of the bundle by name, as its manifest lists them.
    """
    return sum(entry.size for name, entry in files.items() if name not in parts.NOT_SERVED)


def street_numbers(of_streets: Streets | None) -> dict[str, int]:
    """Return the number of each street of a map by its id.

    Args:
        of_streets: streets of the map; None if it has none.
    """
    return {} if of_streets is None else {street.id: number for number, street in enumerate(of_streets.features)}


def places_in_map(bundle: MapBundle, street_number: Mapping[str, int], lidar_height_m: float) -> NDArray[Any]:
    """Return the places of a tile, with the street numbers and the nominal LiDAR height of its map.

    Args:
        bundle: the tile.
        street_number: number of each street of the map by its id.
        lidar_height_m: height of the places of the map above the ground, m.

    Returns:
        (P,) of ``PLACE``. The array of the tile itself if nothing differs.

    Raises:
        KeyError: the map has no street of that id.
    """
    features = () if bundle.streets is None else bundle.streets.features
    numbers = np.array([*(street_number[street.id] for street in features), -1], np.int32)  # number -1 takes the last
    higher_m = lidar_height_m - bundle.manifest.lidar_height_m
    if not higher_m and np.array_equal(numbers[:-1], np.arange(len(features))):
        return bundle.places
    places = np.array(bundle.places)
    places["street"] = numbers[places["street"]]
    places["T_map_place"][:, :3, 3] += higher_m * places["T_map_place"][:, :3, 2]
    return places


@dataclass(frozen=True, slots=True, eq=False)
class Region(Map):
    """Some tiles of a map together. It behaves like a map of one bundle.

    Attributes:
        place_number: number of each place in the whole map.
    """

    place_number: Int32[NDArray[np.int32], " P"]

    def numbers_of(self, places: Int32[NDArray[np.int32], " n"]) -> Int32[NDArray[np.int32], " n"]:
        """Return the numbers of some places in the whole map.

        Args:
            places: indices of places in ``places``.
        """
        return self.place_number[places]


@dataclass(frozen=True, slots=True, eq=False)
class TiledMap(Map):
    """An open tiled map. Its tiles open when they are needed. Several threads may share it.

    ``places`` has the places of all tiles, and ``view_index`` the descriptors. ``views`` is empty, because the views lie in the tiles.
    ``searched`` and ``around`` return parts of the map that are complete.

    Attributes:
        tiles: opens the tiles.
        search: of the whole map; None if the map has few tiles.
    """

    tiles: OpenTiles
    search: PlaceSearch | None

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        verify: bool = True,
        source: TileSource | None = None,
        open_bytes: int = OPEN_BYTES,
        open_search: OpenSearch | None = None,
    ) -> "TiledMap":
        """Open a tiled map. This opens none of its tiles.

        Args:
            path: folder with the manifest and the shared files.
            verify: compare the hash of every file with the manifest. Those of a tile are compared when it is first opened, unless the
                source knows that this process has compared them.
            source: where the tiles come from; None takes them from ``path``.
            open_bytes: limit of the size of all open tiles, bytes. At least one tile is open.
            open_search: opens the search of a map of more than ``MOST_SEARCHED`` tiles; None takes the search index in ``path``.

        Raises:
            BundleError: the map is missing, damaged, of another format, or inconsistent.
            SearchError: the search cannot be opened.
        """
        read = read_manifest(path)
        if not read.tiles:
            raise BundleError(
                f"{path}: a map of one bundle, not a tiled map; open it with open_map", field=manifest.FILE
            )
        require_shared_cloud(path, read)
        unread = files_unread(read, is_searched_elsewhere=open_search is not None)
        require_files(path, read, _NEEDED, unread=unread, verify=verify)
        named = read_streets(path, read)
        tiles = OpenTiles(path, read, named, source or LocalTiles(path), verify=verify, open_bytes=open_bytes)
        search = _search(path, read, open_search, verify=verify)
        every, sizes = range(len(tiles)), [tile.counts.views for tile in read.tiles]
        rows = JoinedRows(sizes, read.counts.descriptor_size, lambda k: tiles.get(k).view_index.rows)
        opened = cls(
            path=path,
            manifest=read,
            grid=read.view_grid,
            rows_seen=np.array(read.rows_seen, np.bool_),
            places=map_array(path / parts.PLACES_FILE, expected=parts.PLACE),
            views=np.empty(0, parts.VIEW),
            view_index=ViewIndex(rows, search or JoinedShortlists(sizes, lambda k: tiles.get(k).view_index)),
            streets=None if named is None else named.streets,
            streets_document=None if named is None else named.document,
            calibration=read_calibration(
                read_file(path / parts.CALIBRATION_FILE), path=str(path / parts.CALIBRATION_FILE)
            ),
            cloud=tiles.cloud(every),
            tiles=tiles,
            search=search,
        )
        _require_consistent(opened)
        return opened

    @property
    def open_tiles(self) -> int:
        """Number of open tiles."""
        return len(self.tiles.opened)

    def searched(
        self,
        descriptor: Float32[NDArray[np.float32], " D"],
        near: tuple[Float64[NDArray[np.float64], "2"], float] | None = None,
    ) -> Map:
        """Return the tiles to search for a query, as a map: those near the camera, or those with the most similar views.

        Args:
            descriptor: descriptor of the query.
            near: x and y (m, map frame) and radius (m) of the area where the camera is; None if unknown. If no tile is there, all count.
        """
        chosen = np.arange(len(self.tiles))
        if near is not None:
            self.tiles.expect_around(near[0])
        if near is not None and ((away_m := _away_m(self.tiles.squares_m, near[0])) <= near[1]).any():
            chosen = np.argsort(away_m, kind="stable")
            chosen = chosen[away_m[chosen] <= near[1]]  # the nearest first
        if len(chosen) > MOST_SEARCHED and self.search is not None:
            first_view = self.tiles.first_place * self.manifest.headings
            similar = chosen_tiles(self.search, descriptor, chosen, first_view)
            nearest = chosen[:1] if near is not None else chosen[:0]  # the tile at the prior is always searched
            chosen = in_order(np.concatenate([nearest, similar]))[:MOST_SEARCHED]
        return self._region(chosen)

    def around(self, positions_of: Callable[[], Float64[NDArray[np.float64], "n 3"]]) -> Map:
        """Return the tiles around some positions, as a map.

        Args:
            positions_of: returns the positions, map frame, m, the most important first. They lie in few tiles. A position in a tile beyond
                ``MOST_AROUND`` counts as one at the edge of the nearest of the others.
        """
        positions_m = positions_of()
        self.tiles.expect_around(positions_m[0, :2])
        return self._region(self.tiles.at(positions_m[:, :2])[:MOST_AROUND])

    def expect_next(self, xy_m: Float64[NDArray[np.float64], "2"], before_m: Float64[NDArray[np.float64], "2"]) -> None:
        """Prepare the tiles that a moving camera will probably reach, in the background.

        Args:
            xy_m: x and y of the camera, map frame, m.
            before_m: x and y one step earlier, map frame, metres.
        """
        self.tiles.expect_around(xy_m, before_m)

    def _region(self, numbers: Int64[NDArray[np.int64], " n"]) -> Map:
        return self.tiles.region(tuple(sorted(numbers.tolist())), self._made)

    def _made(self, numbers: tuple[int, ...]) -> Region:
        """Put the parts of some tiles together."""
        opened = self.tiles.get_all(numbers)
        places, views, view_index = opened[0].places, opened[0].views, opened[0].view_index
        if len(opened) > 1:
            before = np.cumsum([0, *(len(each.places) for each in opened)])
            places = np.concatenate([each.places for each in opened])
            views = np.concatenate([each.views for each in opened])
            views["place"] += np.repeat(before[:-1], [len(each.views) for each in opened]).astype(np.int32)
            indices = [each.view_index for each in opened]
            sizes = [len(each) for each in indices]
            rows = JoinedRows(sizes, view_index.dimension, lambda k: indices[k].rows)
            view_index = ViewIndex(rows, JoinedShortlists(sizes, indices.__getitem__))
        first = self.tiles.first_place
        number = np.concatenate([np.arange(first[tile], first[tile + 1], dtype=np.int32) for tile in numbers])
        return Region(
            path=self.path,
            manifest=self.manifest,
            grid=self.grid,
            rows_seen=self.rows_seen,
            places=places,
            views=views,
            view_index=view_index,
            streets=self.streets,
            streets_document=self.streets_document,
            calibration=self.calibration,
            cloud=self.tiles.cloud(numbers, opened),
            place_number=number,
        )


def chosen_tiles(
    search: PlaceSearch,
    descriptor: Float32[NDArray[np.float32], " D"],
    among: Int64[NDArray[np.int64], " n"],
    first_view: Int64[NDArray[np.int64], " T"],
) -> Int64[NDArray[np.int64], " m"]:
    """Return the tiles to search for a query, at most ``MOST_SEARCHED``: those of the most similar views, then others in the given order.

    Args:
        search: of the whole map.
        descriptor: descriptor of the query.
        among: numbers of the tiles to choose from.
        first_view: number of the first view of each tile, and the number of all views.
    """
    views = search.most_similar(descriptor, min(LISTED, int(first_view[-1])))
    similar = in_order(np.searchsorted(first_view, views, side="right") - 1)
    return in_order(np.concatenate([similar[np.isin(similar, among)], among]))[:MOST_SEARCHED]


def finds_tile(
    search: PlaceSearch,
    descriptors: Float32[NDArray[np.float32], "q D"],
    own_view: Int64[NDArray[np.int64], " q"],
    first_view: Int64[NDArray[np.int64], " T"],
) -> Bool[NDArray[np.bool_], " q"]:
    """Return for each query without a prior whether the tile of its own view is searched.

    Args:
        search: of the whole map.
        descriptors: descriptors of the queries.
        own_view: number of the view in the map that shows what the query shows.
        first_view: number of the first view of each tile, and the number of all views.
    """
    every, found = np.arange(len(first_view) - 1), np.zeros(len(descriptors), np.bool_)
    owner = np.searchsorted(first_view, own_view, side="right") - 1
    for number, descriptor in enumerate(descriptors):
        found[number] = owner[number] in chosen_tiles(search, descriptor, every, first_view)
    return found


def expected_next(
    squares_m: Float64[NDArray[np.float64], "T 4"],
    xy_m: Float64[NDArray[np.float64], "2"],
    before_m: Float64[NDArray[np.float64], "2"] | None = None,
) -> Int64[NDArray[np.int64], " n"]:
    """Return the tiles that a moving camera may reach soon, the most probable first, at most ``MOST_EXPECTED``. Its own is not one of them.

    Without a motion these are the tiles within ``EXPECT_M``, the nearest first. With a motion, the tiles on its straight continuation come
    first, in their order. The path is followed twice as far as ``EXPECT_M``, because the duration of a step is unknown and only its
    direction counts. The other tiles follow by their distance from the point ``EXPECT_M`` ahead, so those behind the camera are last.

    Args:
        squares_m: x0, y0, x1, y1 of each tile, map frame, m.
        xy_m: x and y of the camera, map frame, m.
        before_m: x and y one step earlier, map frame, metres; None if unknown.
    """
    away_m = _away_m(squares_m, xy_m)
    step_m = np.zeros(2) if before_m is None else xy_m - before_m
    length_m = float(np.linalg.norm(step_m))
    if not LEAST_STEP_M <= length_m < np.inf:
        near = np.argsort(away_m, kind="stable")[: MOST_EXPECTED + 1]
        return near[(away_m[near] > 0) & (away_m[near] <= EXPECT_M)][:MOST_EXPECTED]
    reach_m, direction = 2 * EXPECT_M, step_m / length_m
    rows = np.flatnonzero((away_m > 0) & (away_m <= reach_m))
    # Distance along the path where it enters and leaves each square. A path along an axis is turned a little, so nothing is divided by 0.
    edges_m = (squares_m[rows].reshape(-1, 2, 2) - xy_m) / np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    enters_m, leaves_m = edges_m.min(axis=1).max(axis=1), edges_m.max(axis=1).min(axis=1)
    is_crossed = (enters_m <= leaves_m) & (leaves_m >= 0) & (enters_m <= reach_m)
    beside_m = _away_m(squares_m[rows], xy_m + EXPECT_M * direction)
    order = np.lexsort((np.where(is_crossed, enters_m, beside_m), ~is_crossed))
    wanted = is_crossed | (away_m[rows] <= EXPECT_M)
    expected: NDArray[np.int64] = rows[order[wanted[order]]][:MOST_EXPECTED]
    return expected


def _beside(region: Map) -> set[int]:
    """Return the numbers of the tiles whose surfels a region has joined so far."""
    return (
        {number for around in region.cloud.kept for number in around}
        if isinstance(region.cloud, SurfelTiles)
        else set()
    )


def in_order(numbers: Int64[NDArray[np.int64], " n"]) -> Int64[NDArray[np.int64], " m"]:
    """Return each number once, in the order of its first occurrence.

    Args:
        numbers: some numbers.
    """
    _, first = np.unique(numbers, return_index=True)
    return numbers[np.sort(first)]


def _away_m(
    squares_m: Float64[NDArray[np.float64], "T 4"], xy_m: Float64[NDArray[np.float64], "2"]
) -> Float64[NDArray[np.float64], " T"]:
    """Return the distance of a point from each square, m; 0 inside."""
    outside = np.maximum(np.maximum(squares_m[:, :2] - xy_m, xy_m - squares_m[:, 2:]), 0.0)
    away: Float64[NDArray[np.float64], " T"] = np.linalg.norm(outside, axis=1)
    return away


def _search(path: Path, read: Manifest, open_search: OpenSearch | None, *, verify: bool) -> PlaceSearch | None:
    if open_search is not None and needs_search(read):
        return open_search(read)
    if inverted_file.FILE in read.files:
        return InvertedFile.open(
            path / inverted_file.FILE,
            views=read.counts.views,
            dimension=read.counts.descriptor_size,
            headings=read.headings,
            verify=verify,
        )
    if needs_search(read):
        raise damaged_file(path / inverted_file.FILE, f"missing, but a map of more than {MOST_SEARCHED} tiles needs it")
    return None


def _require_consistent(opened: TiledMap) -> None:
    counts, path = opened.manifest.counts, opened.path
    named = 0 if opened.streets is None else len(opened.streets)
    if len(opened.places) != counts.places:
        raise damaged_file(path / parts.PLACES_FILE, f"{len(opened.places)} places instead of {counts.places}")
    if named != counts.streets:
        raise damaged_file(path / streets.FILE, f"{named} streets instead of {counts.streets}")
    if not parts.are_poses(opened.T_map_place):
        raise damaged_file(path / parts.PLACES_FILE, parts.NO_POSE)
    if opened.place_street.min() < -1 or opened.place_street.max() >= named:
        raise damaged_file(path / parts.PLACES_FILE, "a place refers to a missing street")
    if counts.views != counts.places * opened.manifest.headings:
        raise damaged_file(path / manifest.FILE, "the number of views differs from places times headings")
