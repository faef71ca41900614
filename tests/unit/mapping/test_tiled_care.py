"""``streetfix map info|verify|diff|merge`` of tiled maps."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from model_training.cli.map_care import app
from model_training.mapping.info import info_of
from model_training.mapping.join import of_places
from model_training.mapping.stored_map import content_of, read_statistics
from model_training.mapping.tiled_care import diff_of_tiles, merge_tiled, tiles_of
from model_training.mapping.verify import damage_of
from service.errors import BundleError
from service.localization.localizer import Localizer
from service.maps.byte_planes import Columns
from service.maps.calibration import RigCorrection
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.maps.tiled_writer import write_tiled
from service.maps.tiles import TiledMap
from service.maps.writer import replace_calibration, write_bundle
from tests.unit.lattice import on_lattice

TILE_M = 50.0


@pytest.fixture(scope="module")
def squares(small_map: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[int, int], Path]:
    """Three bundles with a third of the places each, and with the whole cloud. The squares only name them."""
    bundle, folder = MapBundle.open(small_map), tmp_path_factory.mktemp("squares")
    content = replace(
        content_of(bundle), cloud=on_lattice(bundle.cloud), statistics=Columns.of(read_statistics(bundle))
    )
    third = np.arange(len(bundle.places)) * 3 // len(bundle.places)
    made = {}
    for number in range(3):
        square = (10 * number, 0)  # too far from each other to share surfaces
        made[square] = folder / str(number)
        write_bundle(made[square], of_places(content, third == number))
    return made


@pytest.fixture(scope="module")
def halves(squares: dict[tuple[int, int], Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two tiled maps that share one square."""
    folder, numbers = tmp_path_factory.mktemp("halves"), sorted(squares)
    one, other = folder / "one", folder / "other"
    write_tiled(one, {square: squares[square] for square in numbers[:2]}, TILE_M, name="one")
    write_tiled(other, {square: squares[square] for square in numbers[1:]}, TILE_M, name="other")
    return one, other


def run(*arguments: object) -> tuple[int, str]:
    found = CliRunner().invoke(app, [str(each) for each in arguments])
    return found.exit_code, found.output


def test_merged_halves_are_the_whole_map(
    halves: tuple[Path, Path], squares: dict[tuple[int, int], Path], tmp_path: Path
) -> None:
    whole = write_tiled(tmp_path / "whole", squares, TILE_M, name="one")
    merged = merge_tiled(*halves, tmp_path / "merged")
    assert merged.version == whole.version
    assert sorted(each.name for each in tmp_path.iterdir()) == ["merged", "whole"]


def test_a_correction_for_a_rig_stays_if_both_maps_have_it(
    calibration_json: Any, small_map: Path, squares: dict[tuple[int, int], Path], tmp_path: Path
) -> None:
    rig = {
        "scale": 0.5,
        "offset": -1.0,
        "lower_only": False,
        "source": "drive",
        "measured_on": "a drive",
        **dict.fromkeys(("frames", "right", "outside", "accepted", "accepted_wrong", "outside_accepted"), 9),
        **dict.fromkeys(("error_before", "error_after", "wrong_share_upper", "outside_share_upper"), 0.1),
    }
    camera = {"width": 640, "height": 480, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 239.5}
    common = rig | {"name": "common", "made_for": camera}
    numbers, bundle = sorted(squares), MapBundle.open(squares[sorted(squares)[0]])
    for k, name in enumerate(("one", "other", "none")):
        bundle = MapBundle.open(squares[numbers[min(k, 1)]])
        content = replace(content_of(bundle), cloud=bundle.cloud, calibration=calibration_json())
        write_bundle(tmp_path / f"tile-{name}", content)
        write_tiled(tmp_path / name, {numbers[k]: tmp_path / f"tile-{name}"}, TILE_M, name=name)
        if name != "none":
            own = rig | {"name": name, "made_for": camera | {"baseline_m": 0.1 if name == "one" else 0.2}}
            replace_calibration(tmp_path / name, calibration_json(rig=rig, rigs=[common, own]))
    old, both = RigCorrection.model_validate(rig), (RigCorrection.model_validate(common),)
    for second, expected, rigs in (("other", old, both), ("none", None, ())):
        merge_tiled(tmp_path / "one", tmp_path / second, tmp_path / f"with-{second}")
        calibration = TiledMap.open(tmp_path / f"with-{second}").calibration
        assert calibration is not None
        assert (calibration.rig, calibration.rigs) == (expected, rigs)


def test_a_square_of_both_maps_is_merged(
    halves: tuple[Path, Path], squares: dict[tuple[int, int], Path], small_dataset: Any, tmp_path: Path
) -> None:
    """The second map has fewer places in the shared square; the merged tile has those of the first."""
    numbers = sorted(squares)
    bundle = MapBundle.open(squares[numbers[1]])
    fewer = of_places(replace(content_of(bundle), cloud=bundle.cloud), np.arange(len(bundle.places)) > 0)
    write_bundle(tmp_path / "fewer", fewer)
    write_tiled(tmp_path / "second", {numbers[1]: tmp_path / "fewer"}, TILE_M, name="second")
    merged = merge_tiled(halves[0], tmp_path / "second", tmp_path / "merged", name="both")
    assert merged.name == "both"
    assert merged.counts.places == read_manifest(halves[0]).counts.places
    old, new = tiles_of(read_manifest(halves[0])), tiles_of(merged)
    assert old[numbers[0]].version == new[numbers[0]].version
    assert old[numbers[1]].version != new[numbers[1]].version
    opened = TiledMap.open(tmp_path / "merged")
    frame = next(iter(small_dataset.queries("drive1_precise")))
    assert Localizer.open(opened).localize(frame.query(opened.grid)).candidates


def test_maps_that_do_not_fit_together_are_not_merged(
    halves: tuple[Path, Path], small_map: Path, squares: dict[tuple[int, int], Path], tmp_path: Path
) -> None:
    with pytest.raises(BundleError, match="a map of one bundle, but the other map is tiled"):
        merge_tiled(halves[0], small_map, tmp_path / "out")
    write_tiled(tmp_path / "large", {(0, 0): squares[sorted(squares)[0]]}, 2 * TILE_M, name="large")
    with pytest.raises(BundleError, match=r"has 50 m, .* has 100 m"):
        merge_tiled(halves[0], tmp_path / "large", tmp_path / "out")
    with pytest.raises(BundleError, match="already exists"):
        merge_tiled(*halves, halves[0])
    assert not (tmp_path / "out").exists()


def test_differences_of_tiled_maps(halves: tuple[Path, Path], squares: dict[tuple[int, int], Path]) -> None:
    found, numbers = diff_of_tiles(*halves), sorted(squares)
    assert (found["added"], found["removed"]) == (numbers[2:], numbers[:1])
    assert (found["kept"], found["changed"]) == (1, [])
    code, out = run("diff", *halves)
    assert code == 0
    assert f"tiles:       {len(numbers) - 2} added, 1 removed, 0 changed, 1 kept" in out
    code, out = run("diff", *halves, "--json")
    assert json.loads(out)["kept"] == 1


def test_a_picture_of_two_tiled_maps_is_refused_and_the_proposed_command_draws_that_of_a_tile(
    halves: tuple[Path, Path], tmp_path: Path
) -> None:
    code, told = run("diff", *halves, "--picture", "x.png")
    assert code == 2
    before, after = halves
    text = " ".join(told.replace("│", " ").split())
    assert f"streetfix map diff {before}/tiles/VERSION {after}/tiles/VERSION --picture FILE" in text
    assert "streetfix map info --json" in text
    listed = [json.loads(run("info", each, "--json")[1])["tiles"] for each in halves]
    versions = [{(tile["column"], tile["row"]): tile["version"] for tile in tiles} for tiles in listed]
    square = next(iter(versions[0].keys() & versions[1].keys()))
    folders = [half / "tiles" / of[square] for half, of in zip(halves, versions, strict=True)]
    assert run("diff", *folders, "--picture", tmp_path / "tile.png")[0] == 0
    assert (tmp_path / "tile.png").read_bytes().startswith(b"\x89PNG")


def test_info_of_a_tiled_map(halves: tuple[Path, Path]) -> None:
    found = info_of(halves[0])
    assert found["tile_m"] == TILE_M
    assert len(found["tiles"]) == 2
    assert found["keeps_sums"]
    assert found["size_bytes"] == sum(each.stat().st_size for each in halves[0].rglob("*") if each.is_file())
    code, out = run("info", halves[0])
    assert code == 0
    assert "tiles:       2, 50 m wide" in out


def test_verify_names_the_damaged_file_of_a_tile(halves: tuple[Path, Path], tmp_path: Path) -> None:
    assert damage_of(halves[0]) == []
    copy = tmp_path / "copy"
    shutil.copytree(halves[0], copy)
    tile = copy / read_manifest(copy).tiles[1].folder
    views = (tile / "views.npy").read_bytes()
    (tile / "views.npy").unlink()
    (tile / "views.npy").write_bytes(views[:-1])
    shutil.rmtree(copy / read_manifest(copy).tiles[0].folder)
    found = damage_of(copy)
    assert len(found) == 2
    assert "manifest.json is missing" in found[0]
    assert f"{tile / 'views.npy'}: {len(views) - 1} bytes instead of {len(views)}" in found[1]
    code, _ = run("verify", copy)
    assert code == 1
