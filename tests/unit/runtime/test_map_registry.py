from collections.abc import Callable
from pathlib import Path

import pytest

from service.errors import BundleError, UnknownMapError
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.runtime.map_registry import MapRegistry


@pytest.fixture
def two_maps(content_of: Callable[..., BundleContent], tmp_path: Path) -> Path:
    for name in ("north", "south"):
        write_bundle(tmp_path / "maps" / name, content_of(name=name))
    return tmp_path / "maps"


def test_a_folder_of_bundles_mounts_them_all(two_maps: Path) -> None:
    assert [localizer.bundle.name for localizer in MapRegistry.open([two_maps])] == ["north", "south"]


def test_half_written_bundles_in_the_folder_are_passed_over(two_maps: Path) -> None:
    (two_maps / "south").rename(two_maps / ".south.x.partial")
    assert len(MapRegistry.open([two_maps])) == 1


def test_the_only_map_needs_no_name(bundle_path: Path) -> None:
    assert MapRegistry.open([bundle_path]).get(None).bundle.name == "tiny"


def test_an_unknown_map_is_refused_with_the_mounted_ones(two_maps: Path) -> None:
    with pytest.raises(UnknownMapError, match="no map 'west'; mounted: north, south"):
        MapRegistry.open([two_maps]).get("west")


def test_with_several_maps_a_name_is_needed(two_maps: Path) -> None:
    with pytest.raises(UnknownMapError, match="names none; mounted: north, south"):
        MapRegistry.open([two_maps]).get(None)


def test_two_maps_of_one_name_are_refused(bundle_path: Path, bundle_copy: Path) -> None:
    with pytest.raises(BundleError, match="both called 'tiny'"):
        MapRegistry.open([bundle_path, bundle_copy])


@pytest.mark.parametrize(("make", "message"), [(False, "no such folder"), (True, "no manifest.json in it")])
def test_a_path_without_a_bundle_is_refused(tmp_path: Path, make: bool, message: str) -> None:
    if make:
        (tmp_path / "x").mkdir()
    with pytest.raises(BundleError, match=message):
        MapRegistry.open([tmp_path / "x"])


def test_no_path_at_all_is_refused() -> None:
    with pytest.raises(BundleError, match="no map to serve"):
        MapRegistry.open([])


def test_an_encoder_that_is_none_stops_the_start(content_of: Callable[..., BundleContent], tmp_path: Path) -> None:
    from service.errors import EncoderError

    write_bundle(tmp_path / "m", content_of(encoder=b"not an encoder"))
    with pytest.raises(EncoderError):
        MapRegistry.open([tmp_path / "m"])
