from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from service.errors import BundleError, NotReadyError, UnknownMapError
from service.geometry.earth import Georeference
from service.localization.localizer import Localizer
from service.maps.content import BundleContent
from service.maps.reader import MapBundle
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
    with pytest.raises(UnknownMapError, match="map 'west' not found; mounted maps: north, south"):
        MapRegistry.open([two_maps]).get("west")


def test_with_several_maps_a_name_is_needed(two_maps: Path) -> None:
    with pytest.raises(UnknownMapError, match="names none; mounted maps: north, south"):
        MapRegistry.open([two_maps]).get(None)


@pytest.fixture
def on_the_earth(content_of: Callable[..., BundleContent], tmp_path: Path) -> MapRegistry:
    """Maps whose origins lie 0.1 degrees (11.1 km) of latitude apart, and a map that is not georeferenced. Their places lie within 60 m."""
    for name, georeference in (
        ("north", {"latitude_deg": 50.1, "longitude_deg": 8.0}),
        ("nowhere", None),
        ("south", {"latitude_deg": 50.0, "longitude_deg": 8.0}),
    ):
        write_bundle(tmp_path / "maps" / name, content_of(name=name, georeference=georeference))
    return MapRegistry.open([tmp_path / "maps"])


@pytest.mark.parametrize(
    ("near", "name"),
    [
        ((50.0, 8.0), "south"),
        ((50.049, 8.0), "south"),
        ((50.051, 8.0), "north"),
        ((60.0, 8.0), "north"),  # outside of all maps
        (
            (-50.04, -172.0),
            "north",
        ),  # the other side of the Earth: x and y alone are smaller in the frame of the southern map
    ],
)
def test_with_several_maps_the_nearest_one_to_a_position_on_the_earth_answers(
    on_the_earth: MapRegistry, near: tuple[float, float], name: str
) -> None:
    assert on_the_earth.get(None, near).bundle.name == name


def test_a_name_counts_before_a_position(on_the_earth: MapRegistry) -> None:
    assert on_the_earth.get("south", (50.1, 8.0)).bundle.name == "south"
    with pytest.raises(UnknownMapError, match="map 'west' not found"):
        on_the_earth.get("west", (50.1, 8.0))


def test_of_maps_that_reach_into_each_other_the_one_with_the_nearest_place_answers(
    content_of: Callable[..., BundleContent], tmp_path: Path
) -> None:
    """The second map has a gap of 1 km, in which the first one lies."""
    small, around = (
        content_of(name=name, georeference={"latitude_deg": 50.0, "longitude_deg": 8.0}) for name in ("small", "around")
    )
    x = around.T_map_place[:, 0, 3]
    x[: len(x) // 2] -= 500.0
    x[len(x) // 2 :] += 500.0
    for each in (small, around):
        write_bundle(tmp_path / each.name, each)
    registry, earth = MapRegistry.open([tmp_path / "small", tmp_path / "around"]), Georeference(50.0, 8.0)
    for x_m, name in ((20.0, "small"), (-480.0, "around"), (520.0, "around"), (-200.0, "small"), (900.0, "around")):
        assert registry.get(None, earth.to_earth(np.array([x_m, 0.0, 0.0]))[:2]).bundle.name == name


def test_a_position_does_not_choose_among_maps_that_are_not_georeferenced(two_maps: Path) -> None:
    with pytest.raises(UnknownMapError, match=r"prior\.wgs84 cannot choose one, because none of them is georeferenced"):
        MapRegistry.open([two_maps]).get(None, (50.0, 8.0))


def test_the_only_map_answers_also_if_it_is_not_georeferenced(bundle_path: Path) -> None:
    assert MapRegistry.open([bundle_path]).get(None, (50.0, 8.0)).bundle.name == "tiny"


def test_the_same_version_twice_is_refused(bundle_path: Path, bundle_copy: Path) -> None:
    with pytest.raises(BundleError, match=r"have the same version .* of 'tiny'"):
        MapRegistry.open([bundle_path, bundle_copy])


@pytest.fixture
def versions(content_of: Callable[..., BundleContent], tmp_path: Path) -> list[Localizer]:
    """Return four versions of one map, the oldest first."""
    found = []
    for seed in range(4):
        path = tmp_path / f"v{seed}"
        write_bundle(path, content_of(seed=seed))
        found.append(Localizer.open(MapBundle.open(path)))
    return found


def version_of(localizer: Localizer) -> str:
    return localizer.bundle.manifest.version


def test_the_newest_version_serves_and_others_can_be_named(versions: list[Localizer]) -> None:
    registry = MapRegistry([versions[1], versions[0], versions[2]])
    assert registry.get(None) is registry.get("tiny") is versions[2]
    assert list(registry) == [versions[2]]
    assert len(registry) == 1
    assert registry.versions("tiny") == (versions[2], versions[1], versions[0])
    for each in versions[:3]:
        assert registry.get(f"tiny@{version_of(each)}") is each
    for name in ("tiny@", "tiny@x", f"tiny@{version_of(versions[3])}", "@", "west@x"):
        if name == "tiny@":
            assert registry.get(name) is versions[2]
            continue
        with pytest.raises(UnknownMapError):
            registry.get(name)


def test_a_new_version_takes_over_and_the_oldest_is_dropped(versions: list[Localizer]) -> None:
    registry = MapRegistry(versions[:3])
    registry.mount(versions[3])
    assert registry.get("tiny") is versions[3]
    assert registry.versions("tiny") == (versions[3], versions[2], versions[1])


def test_rolling_back_holds_until_something_newer_comes(versions: list[Localizer]) -> None:
    registry = MapRegistry(versions[:3])
    assert registry.serve("tiny", version_of(versions[0])) is versions[0]
    assert registry.get("tiny") is versions[0]
    assert registry.versions("tiny") == (versions[2], versions[1], versions[0])
    registry.mount(versions[1])  # mounted again, it is no news
    assert registry.get("tiny") is versions[0]
    registry.mount(versions[3])
    assert registry.get("tiny") is versions[3]


def test_the_version_that_serves_is_never_dropped(versions: list[Localizer]) -> None:
    registry = MapRegistry(versions[1:])
    registry.serve("tiny", version_of(versions[1]))
    registry.mount(versions[0])  # older than all: nothing changes but that it is dropped at once
    assert registry.get("tiny") is versions[1]
    assert registry.versions("tiny") == (versions[3], versions[2], versions[1])


def test_the_same_version_from_another_folder_takes_its_place(versions: list[Localizer], tmp_path: Path) -> None:
    registry = MapRegistry(versions[:2])
    again = Localizer.open(MapBundle.open(tmp_path / "v1"))
    registry.mount(again)
    assert registry.get("tiny") is again
    assert registry.versions("tiny") == (again, versions[0])


@pytest.mark.parametrize(
    ("name", "version", "told"), [("west", "x", "mounted maps: tiny"), ("tiny", "x", "version 'x' of 'tiny' not found")]
)
def test_a_version_that_is_not_open_cannot_serve(versions: list[Localizer], name: str, version: str, told: str) -> None:
    registry = MapRegistry(versions[:1])
    with pytest.raises(UnknownMapError, match=told):
        registry.serve(name, version)
    assert registry.get("tiny") is versions[0]


def test_unmounting_lets_the_newest_of_the_others_serve(versions: list[Localizer]) -> None:
    registry = MapRegistry(versions[:3])
    registry.unmount("tiny", version_of(versions[2]))
    assert registry.get("tiny") is versions[1]
    registry.unmount("tiny", version_of(versions[0]))
    assert registry.versions("tiny") == (versions[1],)
    registry.unmount("west", "x")
    registry.unmount("tiny", version_of(versions[1]))
    assert len(registry) == 0
    for name in ("tiny", None):
        with pytest.raises(NotReadyError, match="no map is mounted"):
            registry.get(name)


@pytest.mark.parametrize(("make", "message"), [(False, "folder not found"), (True, "manifest.json is missing")])
def test_a_path_without_a_bundle_is_refused(tmp_path: Path, make: bool, message: str) -> None:
    if make:
        (tmp_path / "x").mkdir()
    with pytest.raises(BundleError, match=message):
        MapRegistry.open([tmp_path / "x"])


def test_no_path_at_all_is_refused() -> None:
    with pytest.raises(BundleError, match="no map bundle given"):
        MapRegistry.open([])


def test_an_encoder_that_is_none_stops_the_start(content_of: Callable[..., BundleContent], tmp_path: Path) -> None:
    from service.errors import EncoderError

    write_bundle(tmp_path / "m", content_of(encoder=b"not an encoder"))
    with pytest.raises(EncoderError):
        MapRegistry.open([tmp_path / "m"])


def test_a_dataset_given_as_a_bundle_is_named(tmp_path: Path) -> None:
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(BundleError, match="a dataset, not a map bundle; run `streetfix build-map"):
        MapRegistry.open([tmp_path])
