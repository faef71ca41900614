"""A tiled map answers as the same map in one bundle, and opens only the tiles that a query needs."""

import json
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from model_training.mapping.build import describe
from model_training.mapping.calibration_file import renew_calibration
from model_training.mapping.join import of_places
from model_training.mapping.stored_map import content_of
from model_training.mapping.tile_area import Square, TileArea, cloud_of_tile
from model_training.stock import CALIBRATION
from service.errors import BundleError
from service.localization.localizer import Localizer
from service.maps import files, inverted_file
from service.maps import tiles as tiles_module
from service.maps.ahead import Ahead
from service.maps.around import nearest_square
from service.maps.calibration import Site, read_calibration
from service.maps.manifest import FileEntry, read_manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import joined_site, write_tiled
from service.maps.tiles import (
    LocalTiles,
    OpenTiles,
    TiledMap,
    expected_next,
    in_order,
    open_map,
    served_bytes,
)
from service.maps.writer import replace_calibration, write_bundle
from service.registration.surfel_map import SurfelMap
from service.retrieval.prior import Prior
from tests.unit.lattice import as_tile, on_lattice

TILE_M = 50.0


def split(whole: Path, folder: Path, tile_m: float = TILE_M) -> dict[tuple[int, int], Path]:
    """Return a bundle for each square, with the cloud that a built tile has."""
    opened = MapBundle.open(whole)
    content, cloud = content_of(opened), opened.cloud
    assert isinstance(cloud, SurfelMap)
    cells = np.floor(content.T_map_place[:, :2, 3] / tile_m).astype(int)
    squares = [(column, row) for column, row in np.unique(cells, axis=0).tolist()]
    made = {}
    for column, row in squares:
        out = made[column, row] = folder / f"{column}_{row}"
        own = cloud_of_tile(cloud, TileArea(Square(column, row, tile_m), set(squares), 0.3))
        write_bundle(out, replace(of_places(content, (cells == (column, row)).all(axis=1)), cloud=own))
    return made


@pytest.fixture(scope="module")
def squares(stock_map: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[int, int], Path]:
    return split(stock_map, tmp_path_factory.mktemp("squares"))


@pytest.fixture(scope="module")
def tiled_path(squares: dict[tuple[int, int], Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out: Path = tmp_path_factory.mktemp("tiled") / "stock"
    write_tiled(out, squares, TILE_M, name="stock")
    return out


@pytest.fixture(scope="module")
def whole_path(stock_map: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map in one bundle. The lookup grid of its cloud begins where those of tiles begin, so its surfels are rounded alike."""
    bundle, out = MapBundle.open(stock_map), tmp_path_factory.mktemp("whole") / "stock"
    write_bundle(out, replace(content_of(bundle), cloud=on_lattice(bundle.cloud)))
    return out


@pytest.fixture
def tiled(tiled_path: Path) -> TiledMap:
    return TiledMap.open(tiled_path)


@pytest.fixture
def tiled_copy(tiled_path: Path, tmp_path: Path) -> Path:
    shutil.copytree(tiled_path, tmp_path / "copy")
    return tmp_path / "copy"


def queries_of(dataset: Any, bundle: Any) -> list[Any]:
    return [frame.query(bundle.grid) for frame in dataset.queries("drive1_precise")]


def test_no_tile_is_open_before_a_query(tiled: TiledMap, stock_map: Path) -> None:
    whole = MapBundle.open(stock_map)
    assert len(tiled.tiles) > 1
    assert tiled.tiles.opened == ()
    assert tiled.manifest.counts.places == len(tiled.places) == len(whole.places)
    assert isinstance(open_map(stock_map), MapBundle)


def test_a_tiled_map_answers_as_the_same_map_in_one_bundle(
    tiled: TiledMap, whole_path: Path, small_dataset: Any
) -> None:
    """Although each tile has only its own part of the cloud."""
    one, other = Localizer.open(MapBundle.open(whole_path)), Localizer.open(tiled)
    for query in queries_of(small_dataset, tiled):
        expected, found = one.localize(query), other.localize(query)
        assert found.status == expected.status
        assert found.confidence == pytest.approx(expected.confidence, abs=1e-4)
        assert found.T_map_camera_guess == pytest.approx(expected.T_map_camera_guess, abs=1e-4)
        assert found.covariance == pytest.approx(expected.covariance, rel=1e-2, abs=1e-6)
        assert [each.position_m.tolist() for each in found.neighbours] == [
            each.position_m.tolist() for each in expected.neighbours
        ]


def test_frames_of_several_tiles_are_answered_together(tiled: TiledMap, whole_path: Path, small_dataset: Any) -> None:
    frames = list(small_dataset.queries("drive1_precise"))[:3]
    poses = [frame.T_map_camera for frame in frames]
    relative = tuple(np.linalg.inv(poses[0]) @ T for T in poses)
    asked = tuple(frame.query(tiled.grid) for frame in frames)
    expected = Localizer.open(MapBundle.open(whole_path)).localize_frames(asked, relative)
    found = Localizer.open(tiled).localize_frames(asked, relative)
    assert found.T_map_camera_guess == pytest.approx(expected.T_map_camera_guess, abs=1e-4)


def test_places_of_an_answer_are_numbers_of_the_whole_map(tiled: TiledMap, small_dataset: Any) -> None:
    answer = Localizer.open(tiled).localize(queries_of(small_dataset, tiled)[0])
    for each in answer.neighbours:
        assert tiled.T_map_place[each.place, :3, 3].tolist() == each.position_m.tolist()
        assert tiled.place_street[each.place] == each.street


def test_a_prior_searches_only_its_own_tile(tiled: TiledMap, small_dataset: Any) -> None:
    frame = next(iter(small_dataset.queries("drive1_precise")))
    corner = tiled.tiles.squares_m[0, :2]
    query = replace(frame.query(tiled.grid), prior=Prior(position_m=corner - 40.0, position_std_m=1.0))
    Localizer.open(tiled).localize(query)
    far = (
        np.hypot(40.0, 40.0) > 4.0 + 50.0
    )  # sqrt(2) * 40 m are more than the radius, so no tile is near and all are searched
    assert far
    assert len(tiled.tiles.opened) == len(tiled.tiles)
    again = TiledMap.open(tiled.path)
    query = replace(query, prior=Prior(position_m=corner - 30.0, position_std_m=1.0))
    Localizer.open(again).localize(query)
    searched = again.searched(np.zeros(again.manifest.counts.descriptor_size, np.float32), (corner - 30.0, 54.0))
    assert len(searched.places) == again.manifest.tiles[0].counts.places
    around = again.tiles.near(searched.T_map_place[:, :2, 3], np.array([0]))  # their surfels are seen from its places
    assert {0} < set(again.tiles.opened) <= set().union(*around)


def test_a_query_opens_each_tile_once_although_only_one_fits(tiled_path: Path) -> None:
    """The tiles beside that of the camera stay with the query, and no later query finds them open."""
    tight = TiledMap.open(tiled_path, open_bytes=1)
    opened, open_tile = list[int](), tight.tiles._opened_from

    def counted(folder: Path, tile: Any) -> MapBundle:
        opened.append(tile.version)
        return open_tile(folder, tile)

    tight.tiles._opened_from = counted  # type: ignore[method-assign]
    at = tight.T_map_place[:, :3, 3]
    for _ in range(2):
        opened.clear()
        region = tight.around(lambda: at[:1])
        assert region.cloud is not None
        for position_m in at:
            region.cloud.at(position_m)
        assert len(opened) == len(set(opened)) > 1
        assert len(tight.tiles.opened) == 1
        assert not tight.tiles._regions


def test_the_cloud_of_the_whole_map_keeps_what_it_joined_while_the_tiles_are_open(tiled: TiledMap) -> None:
    assert tiled.cloud is not None
    at = tiled.T_map_place[0, :3, 3]
    first = tiled.cloud.at(at)
    assert tiled.cloud.at(at) is first
    assert len(first.pieces) > 1
    tight = TiledMap.open(tiled.path, open_bytes=1)
    assert tight.cloud is not None
    assert tight.cloud.at(at) is not tight.cloud.at(at)


def test_a_tiled_map_of_an_earlier_release_is_refused(tiled_copy: Path) -> None:
    old = read_manifest(tiled_copy)
    old = old.model_copy(update={"parameters": {**old.parameters, "tile_margin_m": 50.0}}).stamped()
    (tiled_copy / "manifest.json").write_bytes(old.to_bytes())
    with pytest.raises(BundleError, match="its tiles overlap as in an earlier release; build the map again"):
        TiledMap.open(tiled_copy)


#: Nine squares of 500 m: columns -1 to 1, each with rows -1 to 1. Number 4 is the middle, 7 lies east of it and 5 north of it.
NINE_M = np.array([[x, y, x + 500.0, y + 500.0] for x in (-500.0, 0.0, 500.0) for y in (-500.0, 0.0, 500.0)])


@pytest.mark.parametrize(
    ("xy_m", "before_m", "numbers"),
    [
        ((250.0, 250.0), None, [1, 3, 5, 7]),  # the corners are 354 m away
        ((400.0, 250.0), None, [7, 3, 5, 6, 8]),  # 100, 250, 250, 269 and 269 m; the west is 400 m away
        ((250.0, 250.0), (249.0, 250.0), [7, 3, 5, 1]),  # east, the sides, and what lies behind
        ((250.0, 250.0), (251.0, 250.0), [1, 3, 5, 7]),
        ((250.0, 250.0), (250.0, 247.0), [5, 1, 7, 3]),
        ((300.0, 250.0), (299.0, 249.0), [7, 8, 5, 3, 1]),  # the path crosses 7 after 283 m and 8 after 354 m
        ((250.0, 250.0), (250.01, 250.0), [1, 3, 5, 7]),  # it stands
        ((-250.0, 250.0), (-251.0, 250.0), [4, 0, 2]),  # the path ends at 350 m, before square 7
        ((50.0, 250.0), (49.0, 250.0), [7, 3, 5, 1, 0, 2]),  # it enters square 7 after 450 m
        ((3000.0, 250.0), None, []),
        ((3000.0, 250.0), (2999.0, 250.0), []),
        ((1300.0, 250.0), (1301.0, 250.0), [7]),  # from outside
    ],
)
def test_the_tiles_that_a_camera_reaches_next(
    xy_m: tuple[float, float], before_m: tuple[float, float] | None, numbers: list[int]
) -> None:
    before = None if before_m is None else np.array(before_m)
    assert expected_next(NINE_M, np.array(xy_m), before).tolist() == numbers


def test_most_tiles_that_are_expected() -> None:
    squares_m = np.array([[50.0 * x, 50.0 * y, 50.0 * x + 50, 50.0 * y + 50] for x in range(20) for y in range(20)])
    for before_m in (None, np.array([510.0, 524.0])):
        assert len(expected_next(squares_m, np.array([510.0, 525.0]), before_m)) == tiles_module.MOST_EXPECTED
    north = expected_next(squares_m, np.array([510.0, 525.0]), np.array([510.0, 524.0]))
    assert north.tolist() == [20 * 10 + row for row in range(11, 19)]  # along the path, not around the camera


class Asked:
    """Instead of ``Ahead``: what was expected."""

    def __init__(self) -> None:
        self.calls: list[tuple[list[int], bool]] = []

    def expect(self, items: Any, *, is_ordered: bool) -> None:
        self.calls.append((list(items), is_ordered))


def test_only_closed_tiles_are_expected_and_only_in_a_service(tiled: TiledMap, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, middle = Asked(), tiled.tiles.squares_m[0].reshape(2, 2).mean(axis=0)
    monkeypatch.setattr(tiled.tiles, "_ahead", asked)
    tiled.tiles.expect_around(middle)
    assert asked.calls == []
    tiled.tiles.opens_ahead = True
    tiled.tiles.expect_around(middle)
    others = [number for number in range(len(tiled.tiles)) if number != 0]  # that of the camera is opened anyway
    assert [(sorted(numbers), ordered) for numbers, ordered in asked.calls] == [(others, False)]
    tiled.expect_next(middle, middle - 1.0)
    assert [(sorted(numbers), ordered) for numbers, ordered in asked.calls[1:]] == [(others, True)]
    for number in others:
        tiled.tiles.get(number)
    tiled.tiles.expect_around(middle)
    tiled.tiles.expect_around(middle + 1e6)
    assert len(asked.calls) == 2


class Prepared:
    """Counts the tiles that the background has prepared."""

    def __init__(self, opened: TiledMap) -> None:
        self._prepare, self._done = opened.tiles._prepare, threading.Semaphore(0)
        opened.tiles._ahead = Ahead(self._counted)
        opened.tiles.opens_ahead = True

    def _counted(self, number: int) -> None:
        try:
            self._prepare(number)
        finally:
            self._done.release()

    def wait(self, tiles: int) -> None:
        for _ in range(tiles):
            assert self._done.acquire(timeout=60)


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Files that were hashed."""
    found: list[Path] = []
    hash_of = files._hash_of
    monkeypatch.setattr(files, "_hash_of", lambda file: found.append(file) or hash_of(file))
    return found


def test_expected_tiles_are_checked_and_opened_in_the_background(tiled: TiledMap, hashed: list[Path]) -> None:
    prepared, others = Prepared(tiled), len(tiled.tiles) - 1
    tiled.tiles.get(0)
    hashed.clear()
    tiled.tiles.expect_around(tiled.tiles.squares_m[0].reshape(2, 2).mean(axis=0))
    prepared.wait(others)
    assert set(tiled.tiles.opened) == set(range(len(tiled.tiles)))
    assert tiled.tiles.opened[-1] == 0  # the tile that a query has used is closed last
    assert len({file.parent for file in hashed if file.parent.parent.name == "tiles"}) == others
    hashed.clear()
    for number in range(len(tiled.tiles)):
        tiled.tiles.get(number)
    assert hashed == []


def test_no_tile_is_closed_for_an_expected_one(tiled_path: Path, hashed: list[Path]) -> None:
    tiled = TiledMap.open(tiled_path, open_bytes=read_manifest(tiled_path).tiles[0].size)
    prepared, others = Prepared(tiled), len(tiled.tiles) - 1
    tiled.tiles.get(0)
    tiled.tiles.expect_around(tiled.tiles.squares_m[0].reshape(2, 2).mean(axis=0))
    prepared.wait(others)
    assert tiled.tiles.opened == (0,)
    hashed.clear()
    tiled.tiles.get(1)  # it was checked ahead
    assert hashed == []
    assert tiled.tiles.opened == (1,)


def test_a_tile_that_was_opened_ahead_is_closed_first(
    content_of: Callable[..., Any], encoder_of: Callable[..., bytes], tmp_path: Path
) -> None:
    encoder = encoder_of()
    made = {(column, 0): tmp_path / str(column) for column in range(3)}
    for (column, _), path in made.items():
        write_bundle(path, as_tile(content_of(seed=column, encoder=encoder)))
    tiles = write_tiled(tmp_path / "three", made, TILE_M, name="three").tiles
    tiled = TiledMap.open(tmp_path / "three", open_bytes=sum(tile.size for tile in tiles) - 1)
    prepared = Prepared(tiled)
    tiled.tiles.get(0)
    tiled.tiles._ahead.expect([1], is_ordered=True)
    prepared.wait(1)
    assert tiled.tiles.opened == (1, 0)
    tiled.tiles.get(2)
    assert tiled.tiles.opened == (0, 2)


def test_a_prepared_tile_is_not_prepared_again_at_once(tiled_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiled = TiledMap.open(tiled_path, open_bytes=1)  # no tile is opened ahead
    prepared, others = Prepared(tiled), len(tiled.tiles) - 1
    middle = tiled.tiles.squares_m[0].reshape(2, 2).mean(axis=0)
    tiled.tiles.expect_around(middle)
    prepared.wait(others)
    asked = Asked()
    monkeypatch.setattr(tiled.tiles, "_ahead", asked)
    tiled.tiles.expect_around(middle)
    assert asked.calls == []
    monkeypatch.setattr(tiles_module, "PREPARE_EVERY_S", 0.0)
    tiled.tiles.expect_around(middle)
    assert [len(numbers) for numbers, _ in asked.calls] == [others]


def test_tiles_that_open_ahead_change_no_answer(tiled_path: Path, small_dataset: Any) -> None:
    plain, ahead = (Localizer.open(TiledMap.open(tiled_path)) for _ in range(2))
    assert isinstance(ahead.bundle, TiledMap)
    ahead.bundle.tiles.opens_ahead = True
    for query in queries_of(small_dataset, plain.bundle)[:3]:
        expected, found = plain.localize(query), ahead.localize(query)
        assert found.T_map_camera_guess.tobytes() == expected.T_map_camera_guess.tobytes()
        assert found.confidence == expected.confidence


def test_tiles_are_closed_beyond_the_limit(tiled_path: Path, small_dataset: Any) -> None:
    small, large = TiledMap.open(tiled_path, open_bytes=1), TiledMap.open(tiled_path)
    for query in queries_of(small_dataset, large):
        found, expected = (Localizer.open(each).localize(query) for each in (small, large))
        assert found.T_map_camera_guess == pytest.approx(expected.T_map_camera_guess, abs=1e-9)
        assert len(small.tiles.opened) == 1
    assert len(large.tiles.opened) == len(large.tiles)


@pytest.fixture
def with_unread_files(
    content_of: Callable[..., Any], encoder_of: Callable[..., bytes], tmp_path: Path
) -> tuple[Path, int]:
    """Make a map of two tiles, each with 1,000 bytes that the service does not read; return it with the size of its other files."""
    made, encoder = {(column, 0): tmp_path / str(column) for column in range(2)}, encoder_of()
    for (column, _), path in made.items():
        write_bundle(path, as_tile(content_of(seed=column, encoder=encoder, preview_webp=bytes(1000))))
    tiles = write_tiled(tmp_path / "two", made, TILE_M, name="two").tiles
    return tmp_path / "two", sum(tile.size for tile in tiles) - 2 * 1000


def test_files_that_the_service_does_not_read_do_not_count_as_open(with_unread_files: tuple[Path, int]) -> None:
    """In a town the statistics of the voxels are half of a tile. With them, a service closed tiles that fit."""
    path, read = with_unread_files
    for open_bytes, opened in ((read, (0, 1)), (read - 1, (1,))):
        tiled = TiledMap.open(path, open_bytes=open_bytes)
        tiled.tiles.get(0)
        tiled.tiles.get(1)
        assert tiled.tiles.opened == opened


def test_a_checked_tile_whose_files_fit_is_opened_ahead(with_unread_files: tuple[Path, int]) -> None:
    """Its files that the service does not read would not fit."""
    path, read = with_unread_files
    for open_bytes, opened in ((read, (1, 0)), (read - 1, (0,))):
        tiled = TiledMap.open(path, open_bytes=open_bytes)
        for number in (1, 0):
            tiled.tiles.get(number)
        tiled.tiles._opened.pop(1, None)
        tiled.tiles._prepare(1)
        assert tiled.tiles.opened == opened


def test_the_size_of_the_files_that_the_service_reads() -> None:
    sizes = {"places.npy": 3, "cloud/surfels.npy": 11, "voxels.zst": 100, "preview.webp": 1000}
    assert served_bytes({name: FileEntry(sha256="0" * 64, size=size) for name, size in sizes.items()}) == 14


def test_tiles_with_the_streets_of_their_map_share_them(tiled_path: Path) -> None:
    tiled = TiledMap.open(tiled_path)
    of_map = tiled.manifest.files["streets.geojson"]
    for number, tile in enumerate(tiled.manifest.tiles):
        opened = tiled.tiles.get(number)
        assert opened.manifest.files["streets.geojson"] == of_map
        assert opened.streets is tiled.streets
        assert opened.streets_document == (tiled_path / tile.folder / "streets.geojson").read_bytes()


def test_regions_are_kept_while_their_tiles_are_open(tiled: TiledMap) -> None:
    positions = tiled.tiles.squares_m[:2].reshape(2, 2, 2).mean(axis=1)
    both = np.column_stack([positions, np.zeros(2)])
    region = tiled.around(lambda: both)
    assert tiled.around(lambda: both[::-1]) is region
    assert len(region.places) == sum(tile.counts.places for tile in tiled.manifest.tiles[:2])
    assert region.views["place"].tolist() == sorted(region.views["place"].tolist())


def test_threads_open_a_tile_once(tiled: TiledMap, monkeypatch: pytest.MonkeyPatch) -> None:
    opened, opening = [], MapBundle.open
    monkeypatch.setattr(MapBundle, "open", lambda folder, **how: opened.append(folder) or opening(folder, **how))
    threads = [threading.Thread(target=tiled.tiles.get, args=(0,)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(opened) == 1


def test_closed_tiles_of_a_query_are_opened_side_by_side(tiled: TiledMap, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each opening waits until the other one has begun, and fails after ten seconds otherwise."""
    both_began, open_one = threading.Barrier(2, timeout=10), OpenTiles._open

    def opened(tiles: OpenTiles, tile: Any, **options: Any) -> MapBundle:
        both_began.wait()
        return open_one(tiles, tile, **options)

    monkeypatch.setattr(OpenTiles, "_open", opened)
    found = tiled.tiles.get_all([1, 0])
    assert found[0] is tiled.tiles.get(1)
    assert found[1] is tiled.tiles.get(0)


def test_a_tile_that_cannot_be_opened_beside_others_is_reported(tiled_copy: Path) -> None:
    opened = TiledMap.open(tiled_copy)
    shutil.rmtree(tiled_copy / opened.manifest.tiles[1].folder)
    with pytest.raises(BundleError, match="tile"):
        opened.tiles.get_all([0, 1])
    assert opened.tiles.opened == (0,)


def test_the_search_index_chooses_the_tiles_of_a_large_map(
    content_of: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nine tiles in a row, each with places that resemble no other tile."""
    rng = np.random.default_rng(0)
    made, vectors = {}, []
    for column in range(9):
        content = content_of(name="row", cloud=None)
        content.T_map_place[:, 0, 3] = column * TILE_M + 10.0
        content.T_map_place[:, 1, 3] = 10.0
        random = rng.normal(size=content.descriptors.shape)
        content.descriptors[:] = random / np.linalg.norm(random, axis=1, keepdims=True)
        vectors.append(content.descriptors[0].copy())
        write_bundle(tmp_path / str(column), content)
        made[column, 0] = tmp_path / str(column)
    manifest = write_tiled(tmp_path / "row", made, TILE_M, name="row")
    assert "search.faiss" in manifest.files
    assert manifest.parameters[inverted_file.FINDS_TILE] == 1.0  # random descriptors resemble only their own view
    told = f"recall@10 of {manifest.parameters[inverted_file.RECALL]:.3f} against exact search and the right tile among"
    assert f"{told} those that it chooses for 1.000 of the queries, tiles of 50 m: 9" in describe(manifest)
    opened = TiledMap.open(tmp_path / "row")
    for column in (0, 4, 8):
        part = opened.searched(vectors[column])
        assert set(part.numbers_of(np.arange(len(part.places), dtype=np.int32)) // 12) >= {column}
        assert len(part.places) == 12 * tiles_module.MOST_SEARCHED
    wide = opened.searched(vectors[8], (np.array([210.0, 10.0]), 1000.0))
    assert {12 * 4, 12 * 8} <= set(
        wide.numbers_of(np.arange(len(wide.places), dtype=np.int32)).tolist()
    )  # at the prior; most similar
    beside = opened.searched(vectors[8], (np.array([60.0, 10.0]), 20.0))
    assert beside.T_map_place[:, 0, 3].tolist() == [10.0] * 12 + [60.0] * 12


@pytest.mark.parametrize("name", ["descriptors.npy", "cloud/surfels.npy", "streets.geojson"])
def test_a_damaged_tile_is_refused_when_it_opens(tiled_copy: Path, name: str) -> None:
    opened = TiledMap.open(tiled_copy)
    tile = tiled_copy / opened.manifest.tiles[0].folder / name
    content = tile.read_bytes()
    tile.unlink()  # it is a hard link
    tile.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(BundleError, match=rf"map stock, tiles/\w+/{name}: .*hash does not match"):
        opened.tiles.get(0)
    opened.tiles.get(1)


def test_another_bundle_in_the_folder_of_a_tile_is_refused(tiled_copy: Path) -> None:
    opened = TiledMap.open(tiled_copy)
    one, other = (tiled_copy / tile.folder for tile in opened.manifest.tiles[:2])
    shutil.rmtree(one)
    shutil.copytree(other, one)
    with pytest.raises(BundleError, match=f"version {other.name}, but the map lists {one.name}"):
        opened.tiles.get(0)


def test_a_missing_tile_is_refused_when_it_opens(tiled_copy: Path) -> None:
    opened = TiledMap.open(tiled_copy)
    shutil.rmtree(tiled_copy / opened.manifest.tiles[1].folder)
    with pytest.raises(BundleError, match=r"not a map bundle: manifest.json is missing"):
        opened.tiles.get(1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda document: document["tiles"].reverse(), "the order is wrong"),
        (lambda document: document["tiles"].append(document["tiles"][0]), "occurs twice"),
        (lambda document: document["tiles"][0]["counts"].update(places=7), "the tiles have"),
        (lambda document: document.pop("tile_m"), "tile_m and tiles"),
        (lambda document: document.update(tile_m=1.0), "tile_m"),
        (lambda document: document["tiles"][0].update(column=2_000_000), "column"),
        (lambda document: document["tiles"][0].update(version="../../etc"), "version"),
    ],
)
def test_a_manifest_with_wrong_tiles_is_refused(tiled_copy: Path, change: Any, message: str) -> None:
    from service.maps.manifest import Manifest

    path = tiled_copy / "manifest.json"
    document = json.loads(path.read_text())
    change(document)
    try:
        content = Manifest.model_validate(document).stamped().to_bytes()
    except ValueError:
        content = json.dumps(document).encode()
    path.unlink()
    path.write_bytes(content)
    with pytest.raises(BundleError, match=message):
        TiledMap.open(tiled_copy)


def test_places_of_another_map_are_refused(tiled_copy: Path) -> None:
    path = tiled_copy / "places.npy"
    places = np.load(path)[:-1]
    path.unlink()
    np.save(path, places)
    with pytest.raises(BundleError, match=r"places.npy: \d+ bytes instead of"):
        TiledMap.open(tiled_copy)


def test_commands_for_one_bundle_say_that_the_map_is_tiled(tiled_path: Path) -> None:
    with pytest.raises(BundleError, match="a tiled map, and this command needs a map of one bundle"):
        MapBundle.open(tiled_path)
    with pytest.raises(BundleError, match="not a tiled map"):
        TiledMap.open(tiled_path / read_manifest(tiled_path).tiles[0].folder)


def test_the_same_tiles_give_the_same_version(
    squares: dict[tuple[int, int], Path], tiled_path: Path, tmp_path: Path
) -> None:
    again = write_tiled(tmp_path / "again", dict(reversed(squares.items())), TILE_M, name="stock")
    assert again.version == read_manifest(tiled_path).version
    fewer = write_tiled(tmp_path / "fewer", dict(list(squares.items())[1:]), TILE_M, name="stock")
    assert fewer.version != again.version


def test_equal_files_of_tiles_are_one_file(squares: dict[tuple[int, int], Path], tiled_path: Path) -> None:
    """Each tile brings its own copy of the encoder and of the calibration. In the map they are links."""
    read = read_manifest(tiled_path)
    folders = [tiled_path / tile.folder for tile in read.tiles]
    assert len({(path / "encoder.onnx").stat().st_ino for path in squares.values()}) == len(squares) > 1
    for name in ("encoder.onnx", "calibration.json"):
        found = {(folder / name).stat().st_ino for folder in folders}
        assert len(found) == len({read_manifest(folder).files[name].sha256 for folder in folders})
    assert (tiled_path / "encoder.onnx").stat().st_ino == (folders[0] / "encoder.onnx").stat().st_ino
    assert len({(folder / "descriptors.npy").stat().st_ino for folder in folders}) == len(folders)
    for square, folder in zip(sorted(squares), folders, strict=True):
        for file in (file for file in folder.rglob("*") if file.is_file()):
            assert file.read_bytes() == (squares[square] / file.relative_to(folder)).read_bytes()


def test_an_intact_file_is_no_link_to_a_damaged_one(squares: dict[tuple[int, int], Path], tmp_path: Path) -> None:
    """The encoder of the first tile is damaged, and its size is right. The other tiles keep theirs, which are links to one file."""
    copies = {square: Path(shutil.copytree(path, tmp_path / path.name)) for square, path in squares.items()}
    first, second, *_ = sorted(copies)
    content = (copies[first] / "encoder.onnx").read_bytes()
    (copies[first] / "encoder.onnx").write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    tiles = write_tiled(tmp_path / "out", copies, TILE_M, name="stock").tiles
    folder_of = {(tile.column, tile.row): tmp_path / "out" / tile.folder for tile in tiles}
    assert (folder_of[first] / "encoder.onnx").read_bytes() != content
    for square in sorted(copies)[1:]:
        assert (folder_of[square] / "encoder.onnx").read_bytes() == content
        assert (folder_of[square] / "encoder.onnx").samefile(folder_of[second] / "encoder.onnx")


def test_tiles_that_do_not_fit_together_are_refused(
    squares: dict[tuple[int, int], Path], small_map: Path, tmp_path: Path
) -> None:
    with pytest.raises(BundleError, match=r"small: encoder_sha256 differs from"):
        write_tiled(tmp_path / "out", {**squares, (7, 7): small_map}, TILE_M, name="stock")
    with pytest.raises(BundleError, match="no tile"):
        write_tiled(tmp_path / "out", {}, TILE_M, name="stock")
    first = next(iter(squares.values()))
    with pytest.raises(BundleError, match="same content"):
        write_tiled(tmp_path / "out", {**squares, (7, 7): first}, TILE_M, name="stock")
    assert not (tmp_path / "out").exists()
    assert list(tmp_path.iterdir()) == []


def test_an_existing_map_is_replaced_only_on_request(squares: dict[tuple[int, int], Path], tmp_path: Path) -> None:
    out = tmp_path / "stock"
    write_tiled(out, squares, TILE_M, name="stock")
    with pytest.raises(BundleError, match="already exists"):
        write_tiled(out, squares, TILE_M, name="stock")
    write_tiled(out, squares, TILE_M, name="other", overwrite=True)
    assert read_manifest(out).name == "other"


def test_the_site_check_of_a_map_is_the_mean_over_the_queries_of_its_tiles() -> None:
    one = Site(offset=-1.0, queries=30, right=20, expected_calibration_error=0.1)
    other = Site(offset=0.0, queries=10, right=10, expected_calibration_error=0.3)
    found = joined_site([one, other])
    assert found is not None
    assert (found.offset, found.queries, found.right) == (-0.75, 40, 30)
    assert found.expected_calibration_error == pytest.approx(0.15)
    assert joined_site([]) is None


def test_numbers_in_the_order_of_their_first_occurrence() -> None:
    assert in_order(np.array([3, 1, 3, 0, 1])).tolist() == [3, 1, 0]


def listing(*lists: list[int]) -> Any:
    """A search that returns these views, one list after the other."""
    given = iter(lists)
    return SimpleNamespace(shortlist=lambda *_: None, most_similar=lambda _descriptor, k: np.array(next(given))[:k])


def test_the_tiles_of_the_most_similar_views_are_chosen_first() -> None:
    """Ten tiles of ten views. The index lists views of tiles 7, 2 and 9. Tile 9 is not among the candidates, and others fill the rest."""
    among = np.array([4, 2, 7, 0, 1, 3, 5])
    search = listing([71, 20, 79, 99, 25])
    chosen = tiles_module.chosen_tiles(search, np.zeros(3, np.float32), among, 10 * np.arange(11))
    assert chosen.tolist() == [7, 2, 4, 0, 1, 3]


def test_the_tile_of_a_query_is_found_if_it_is_one_of_the_first_six() -> None:
    """Tiles of ten views. The first query has its tile 7 as the sixth of its list, the second as the seventh. The list of the third names
    tile 9 only, so tiles 0 to 4 are searched too, and its own is 4."""
    search = listing([0, 1, 10, 20, 30, 31, 40, 75], [0, 10, 20, 30, 40, 50, 75], [90])
    own = np.array([71, 71, 49])
    found = tiles_module.finds_tile(search, np.ones((3, 4), np.float32), own, 10 * np.arange(11))
    assert found.tolist() == [True, False, True]


def test_tiles_at_positions(tiled: TiledMap) -> None:
    squares_m = tiled.tiles.squares_m
    middles = squares_m.reshape(-1, 2, 2).mean(axis=1)
    assert tiled.tiles.at(middles[::-1]).tolist() == list(range(len(squares_m)))[::-1]
    assert tiled.tiles.at(np.concatenate([middles[1:2], middles[:1], middles[1:2]])).tolist() == [1, 0]
    low = squares_m[0, :2] - 1e4
    assert tiled.tiles.at(low[None]).tolist() == nearest_square(squares_m, low[None]).tolist()


def test_local_tiles_lie_in_the_folder_of_the_map(tiled: TiledMap) -> None:
    tile = tiled.manifest.tiles[0]
    assert LocalTiles(tiled.path).folder(tile) == tiled.path / "tiles" / tile.version


def test_a_renewed_tiled_map_keeps_its_tiles_and_opens(tiled_copy: Path) -> None:
    """The stock calibration replaces one of other features, without a new build."""
    before = read_manifest(tiled_copy)
    old = json.loads((tiled_copy / "calibration.json").read_bytes())
    replace_calibration(tiled_copy, old | {"features": [{"name": "of_old", "mean": 0.0, "std": 1.0}]})
    with pytest.raises(BundleError, match="renew the calibration"):
        Localizer.open(TiledMap.open(tiled_copy))
    made, had_rig = renew_calibration(tiled_copy, CALIBRATION)
    opened = TiledMap.open(tiled_copy)
    Localizer.open(opened)
    assert not had_rig
    assert made.tiles == before.tiles
    expected = read_calibration(CALIBRATION.read_bytes(), path=str(CALIBRATION))
    assert opened.calibration is not None
    assert expected is not None
    assert opened.calibration.right == expected.right
    assert opened.calibration.names == expected.names
