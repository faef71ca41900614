import errno
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from service.errors import BundleError
from service.maps import writer
from service.maps.content import BundleContent
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle, read_streets
from service.maps.streets import Streets, StreetsFile
from service.maps.writer import write_bundle


def test_the_written_bundle_is_opened_unchanged(content: BundleContent, bundle_path: Path) -> None:
    bundle = MapBundle.open(bundle_path)
    np.testing.assert_array_equal(bundle.T_map_place, content.T_map_place)
    np.testing.assert_array_equal(bundle.place_street, content.place_street)
    np.testing.assert_array_equal(bundle.view_place, content.view_place)
    np.testing.assert_array_equal(bundle.view_heading_rad, content.view_heading_rad)
    assert content.cloud is not None
    assert bundle.cloud is not None
    written = content.cloud.arrays()
    assert bundle.cloud.arrays().keys() == written.keys()
    for name, array in bundle.cloud.arrays().items():
        np.testing.assert_array_equal(array, written[name])
    assert bundle.grid == content.grid
    assert bundle.encoder_bytes() == content.encoder
    assert bundle.streets is not None
    assert [street.name for street in bundle.streets.features][-1] == "End of street 2"
    assert bundle.manifest.counts.model_dump() == {
        "places": 12,
        "views": 48,
        "descriptor_size": 16,
        "cloud_points": len(content.cloud.surfels),
        "streets": 3,
    }


def test_arrays_are_mapped_and_read_only(bundle_path: Path) -> None:
    bundle = MapBundle.open(bundle_path)
    cloud = bundle.cloud
    assert isinstance(bundle.places, np.memmap)
    assert cloud is not None
    with pytest.raises(ValueError, match="read-only"):
        cloud.surfels["xyz"][0] = 1


def test_a_map_may_have_no_streets(content_of: Callable[..., BundleContent], tmp_path: Path) -> None:
    write_bundle(tmp_path / "m", content_of(streets=None, place_street=np.full(12, -1, np.int32)))
    bundle = MapBundle.open(tmp_path / "m")
    assert bundle.streets is None
    assert b'"features": []' in bundle.streets_geojson()


def test_known_streets_are_taken_only_for_the_same_file(bundle_path: Path) -> None:
    document = (bundle_path / "streets.geojson").read_bytes()
    known = read_streets(bundle_path, read_manifest(bundle_path))
    assert known is not None
    assert known.document == document
    assert MapBundle.open(bundle_path, known_streets=known).streets is known.streets
    other = MapBundle.open(bundle_path, known_streets=StreetsFile("0" * 64, b"{}", Streets(())))
    assert other.streets_document == document
    assert other.streets is not None
    assert len(other.streets) == 3


def test_the_same_content_has_the_same_version_whenever_it_is_written(content: BundleContent, tmp_path: Path) -> None:
    first, second = write_bundle(tmp_path / "a", content), write_bundle(tmp_path / "b", content)
    assert first.version == second.version
    assert first.made_at != second.made_at


def test_tool_versions_are_no_content(content_of: Callable[..., BundleContent], tmp_path: Path) -> None:
    versions = {write_bundle(tmp_path / tool, content_of(tool_versions={"faiss": tool})).version for tool in ("1", "2")}
    assert len(versions) == 1


def test_other_content_has_another_version(content_of: Callable[..., BundleContent], tmp_path: Path) -> None:
    versions = {write_bundle(tmp_path / str(spacing), content_of(spacing_m=spacing)).version for spacing in (1.0, 2.0)}
    assert len(versions) == 2


def test_an_existing_path_is_refused(content: BundleContent, bundle_copy: Path) -> None:
    with pytest.raises(BundleError, match="already exists; choose another --out or pass --overwrite"):
        write_bundle(bundle_copy, content)


def test_overwriting_puts_the_new_bundle_in_place_and_leaves_nothing_else(
    content_of: Callable[..., BundleContent], bundle_copy: Path
) -> None:
    write_bundle(bundle_copy, content_of(name="newer"), overwrite=True)
    assert MapBundle.open(bundle_copy).name == "newer"
    assert list(bundle_copy.parent.iterdir()) == [bundle_copy]


def test_a_failed_overwrite_brings_the_old_bundle_back(
    content_of: Callable[..., BundleContent], bundle_copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rename = Path.rename

    def fail_on_the_new_one(self: Path, target: Path) -> Path:
        if self.name.endswith(".partial"):
            raise OSError(errno.EIO, "Input/output error")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail_on_the_new_one)
    with pytest.raises(BundleError, match="Input/output error"):
        write_bundle(bundle_copy, content_of(name="newer"), overwrite=True)
    assert MapBundle.open(bundle_copy).name == "tiny"
    assert list(bundle_copy.parent.iterdir()) == [bundle_copy]


def test_a_full_disk_leaves_nothing_behind(
    content: BundleContent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer, "sync", full)
    with pytest.raises(BundleError, match="No space left on device"):
        write_bundle(tmp_path / "m", content)
    assert list(tmp_path.iterdir()) == []


def test_a_killed_writer_leaves_nothing_under_the_final_name(tmp_path: Path) -> None:
    program = textwrap.dedent(
        """
        import os, signal, sys
        from pathlib import Path
        import numpy as np
        from service.imaging.view_grid import ViewGrid
        from service.maps import writer
        from service.maps.content import BundleContent

        writer._put_in_place = lambda partial, out: os.kill(os.getpid(), signal.SIGKILL)
        grid = ViewGrid(rows=2, columns=2)
        writer.write_bundle(Path(sys.argv[1]), BundleContent(
            name="m", grid=grid, headings=1, spacing_m=1.0, rows_seen=np.ones(2, bool), T_map_place=np.eye(4)[None],
            place_street=np.array([-1], np.int32), view_place=np.array([0], np.int32), view_heading_rad=np.zeros(1),
            descriptors=np.full((1, 4), 0.5, np.float32), encoder=b"x", parameters={"lidar_height_m": 1.8}))
        """
    )
    done = subprocess.run([sys.executable, "-c", program, str(tmp_path / "m")], check=False)
    assert done.returncode == -9
    assert not (tmp_path / "m").exists()
    assert all(child.name.endswith(".partial") for child in tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"rows_seen": np.ones(3, np.bool_)}, "rows_seen has 3 entries for 8 rows"),
        ({"view_place": np.full(48, 12, np.int32)}, "a view refers to a missing place"),
        ({"place_street": np.full(12, 3, np.int32)}, "not among the 3"),
        ({"descriptors": np.full((48, 16), np.nan, np.float32)}, "not finite"),
        ({"descriptors": np.full((48, 16), 0.5, np.float32)}, "a descriptor is not a unit vector"),
        ({"T_map_place": np.tile(2.0 * np.eye(4), (12, 1, 1))}, "a pose is not finite, scales"),
        ({"parameters": {}}, "lidar_height_m"),
        ({"name": "a/b"}, "name"),
        ({"name": ""}, "name"),
    ],
)
def test_contradictory_content_is_refused_before_it_is_written(
    content_of: Callable[..., BundleContent], tmp_path: Path, changed: dict[str, object], message: str
) -> None:
    with pytest.raises(BundleError, match=message):
        write_bundle(tmp_path / "m", content_of(**changed))
    assert list(tmp_path.iterdir()) == []
