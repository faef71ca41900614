"""Every defect of a bundle is an error that names the file and the remedy."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from service.errors import BundleError
from service.maps import files, reader
from service.maps.manifest import Manifest
from service.maps.reader import MapBundle
from service.maps.writer import sha256_of

NEEDED = ["encoder.onnx", "descriptors.npy", "places.npy", "views.npy", "calibration.json"]
FILES = [*NEEDED, "streets.geojson", "cloud/surfels.npy"]
OUTSIDE = ["../outside.npy", "/etc/passwd", "cloud/../../outside.npy", "a//b", "manifest.json", ""]


def edit_manifest(bundle: Path, edit: Callable[[dict[str, Any]], object], *, stamp: bool = True) -> None:
    """Change the manifest. With ``stamp`` its version matches, as after deliberate forgery."""
    document = json.loads((bundle / "manifest.json").read_text())
    edit(document)
    (bundle / "manifest.json").write_text(json.dumps(document))
    if stamp:
        stamped = Manifest.model_validate_json((bundle / "manifest.json").read_text()).stamped()
        (bundle / "manifest.json").write_bytes(stamped.to_bytes())


def replace_file(bundle: Path, name: str, data: bytes) -> None:
    """Replace a file and adapt the manifest, so that only the check of the content can fail."""
    (bundle / name).write_bytes(data)
    entry = {"sha256": hashlib.sha256(data).hexdigest(), "size": len(data)}
    edit_manifest(bundle, lambda document: document["files"].update({name: entry}))


@pytest.mark.parametrize("name", FILES)
def test_a_truncated_file_is_refused(bundle_copy: Path, name: str) -> None:
    data = (bundle_copy / name).read_bytes()
    (bundle_copy / name).write_bytes(data[:-1])
    with pytest.raises(BundleError, match=f"{name}: {len(data) - 1} bytes instead of {len(data)}.*again"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize("name", FILES)
def test_a_flipped_bit_is_refused(bundle_copy: Path, name: str) -> None:
    data = bytearray((bundle_copy / name).read_bytes())
    data[len(data) // 2] ^= 1
    (bundle_copy / name).write_bytes(data)
    with pytest.raises(BundleError, match=f"{name}: the hash does not match the manifest"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_refused(bundle_copy: Path, name: str) -> None:
    (bundle_copy / name).unlink()
    with pytest.raises(BundleError, match=f"{name}: missing, or outside the bundle"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_vanishes_while_the_bundle_is_opened_is_refused(
    bundle_copy: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An operator may remove it: all files existed when they were listed."""

    def looked_at(*arguments: Any, **changed: Any) -> None:
        original(*arguments, **changed)
        (bundle_copy / name).unlink()

    original = files.require_files
    monkeypatch.setattr(reader, "require_files", looked_at)
    with pytest.raises(BundleError, match=name.rpartition("/")[2]):
        MapBundle.open(bundle_copy).encoder_bytes()


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_vanishes_while_it_is_compared_is_refused(
    bundle_copy: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compare(path: Path) -> str:
        if path == bundle_copy / name:
            path.unlink()
        return original(path)

    original = sha256_of
    monkeypatch.setattr(files, "sha256_of", compare)
    with pytest.raises(BundleError, match=f"{name}: cannot be read"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize("name", NEEDED)
def test_a_needed_file_must_be_listed(bundle_copy: Path, name: str) -> None:
    edit_manifest(bundle_copy, lambda document: document["files"].pop(name))
    with pytest.raises(BundleError, match=f"{name}: not listed in the manifest"):
        MapBundle.open(bundle_copy)


def test_a_folder_without_a_manifest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=r"not a map bundle: manifest\.json is missing"):
        MapBundle.open(tmp_path)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", "[" * 100_000])
def test_a_manifest_that_is_none_is_refused(bundle_copy: Path, text: str) -> None:
    (bundle_copy / "manifest.json").write_text(text)
    with pytest.raises(BundleError, match="not a valid manifest"):
        MapBundle.open(bundle_copy)


def test_another_format_version_is_refused_with_both_versions(bundle_copy: Path) -> None:
    edit_manifest(bundle_copy, lambda document: document.update(format=5), stamp=False)
    with pytest.raises(BundleError, match="format 5, but this release reads format 6; build the map with this release"):
        MapBundle.open(bundle_copy)


def test_an_unknown_field_is_refused(bundle_copy: Path) -> None:
    edit_manifest(bundle_copy, lambda document: document.update(more=1), stamp=False)
    with pytest.raises(BundleError, match="more: Extra inputs"):
        MapBundle.open(bundle_copy)


def test_an_edited_manifest_is_refused(bundle_copy: Path) -> None:
    edit_manifest(bundle_copy, lambda document: document.update(spacing_m=7.0), stamp=False)
    with pytest.raises(BundleError, match="does not match the content"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize("name", OUTSIDE)
def test_a_path_out_of_the_bundle_is_refused(bundle_copy: Path, name: str) -> None:
    entry = {"sha256": "0" * 64, "size": 3}
    edit_manifest(bundle_copy, lambda document: document["files"].update({name: entry}))
    with pytest.raises(BundleError, match="is outside the bundle"):
        MapBundle.open(bundle_copy)


def test_a_link_out_of_the_bundle_is_refused(bundle_copy: Path) -> None:
    outside = bundle_copy.parent / "outside.npy"
    (bundle_copy / "places.npy").rename(outside)
    (bundle_copy / "places.npy").symlink_to(outside)
    with pytest.raises(BundleError, match=r"places\.npy: missing, or outside the bundle"):
        MapBundle.open(bundle_copy)


def test_another_encoder_is_refused(bundle_copy: Path, encoder_of: Callable[..., bytes]) -> None:
    replace_file(bundle_copy, "encoder.onnx", encoder_of(seed=99))
    with pytest.raises(BundleError, match="not the encoder that computed the descriptors"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda document: document["counts"].update(places=13), "places.npy: 12 places instead of 13"),
        (lambda document: document["counts"].update(views=47), "views.npy: 48 views instead of 47"),
        (lambda document: document["counts"].update(descriptor_size=8), "descriptors of 16 numbers instead of 8"),
        (lambda document: document["counts"].update(cloud_points=6), "cloud: [0-9]+ points instead of 6"),
        (lambda document: document["counts"].update(streets=2), "streets.geojson: 3 streets instead of 2"),
        (lambda document: document.update(rows_seen=[True]), "rows_seen has 1 entries for 8 rows"),
        (lambda document: document.update(parameters={}), "parameters.lidar_height_m is missing"),
        (lambda document: document["grid"].update(min_range_m=50.0), "limits of the view grid are reversed"),
    ],
)
def test_counts_and_limits_must_agree(
    bundle_copy: Path, edit: Callable[[dict[str, Any]], object], message: str
) -> None:
    edit_manifest(bundle_copy, edit)
    with pytest.raises(BundleError, match=message):
        MapBundle.open(bundle_copy)


def npy_bytes(path: Path, array: np.ndarray, *, allow_pickle: bool = False) -> bytes:
    np.save(path, array, allow_pickle=allow_pickle)
    return path.read_bytes()


def test_an_array_of_another_type_is_refused(bundle_copy: Path, tmp_path: Path) -> None:
    replace_file(bundle_copy, "places.npy", npy_bytes(tmp_path / "a.npy", np.zeros(12)))
    with pytest.raises(BundleError, match=r"places\.npy: float64"):
        MapBundle.open(bundle_copy)


def test_a_pickled_array_is_never_loaded(bundle_copy: Path, tmp_path: Path) -> None:
    pickled = npy_bytes(tmp_path / "a.npy", np.array([{}], object), allow_pickle=True)
    replace_file(bundle_copy, "cloud/surfels.npy", pickled)
    with pytest.raises(BundleError, match=r"surfels\.npy: not a valid NPY array"):
        MapBundle.open(bundle_copy)


def test_a_grid_that_points_outside_the_surfels_is_refused(bundle_copy: Path, tmp_path: Path) -> None:
    cells = np.load(bundle_copy / "cloud" / "grid_cells.npy")
    cells[:] = 255
    replace_file(bundle_copy, "cloud/grid_cells.npy", npy_bytes(tmp_path / "a.npy", cells))
    with pytest.raises(
        BundleError, match=r"cloud/grid_cells\.npy: a number is outside the surfels of its block or region"
    ):
        MapBundle.open(bundle_copy)


def test_a_grid_of_another_type_is_refused(bundle_copy: Path, tmp_path: Path) -> None:
    replace_file(bundle_copy, "cloud/grid_slots.npy", npy_bytes(tmp_path / "a.npy", np.zeros(8)))
    with pytest.raises(BundleError, match=r"cloud/grid_slots\.npy: float64"):
        MapBundle.open(bundle_copy)


def test_a_view_of_a_place_that_is_not_there_is_refused(bundle_copy: Path, tmp_path: Path) -> None:
    views = np.load(bundle_copy / "views.npy")
    views["place"][0] = 12
    replace_file(bundle_copy, "views.npy", npy_bytes(tmp_path / "a.npy", views))
    with pytest.raises(BundleError, match=r"views\.npy: a view refers to a missing place"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize(
    ("at", "value"),
    [
        ((0, 0), 1.01),
        ((0, 0), 1e200),
        ((2, 2), -1.0),
        ((1, 3), -1.1e7),
        ((0, 3), np.nan),
        ((2, 0), np.inf),
        ((3, 0), 1e-3),
    ],
)
def test_a_place_whose_pose_is_no_rotation_and_translation_is_refused(
    bundle_copy: Path, tmp_path: Path, at: tuple[int, int], value: float
) -> None:
    places = np.load(bundle_copy / "places.npy")
    places["T_map_place"][5][at] = value
    replace_file(bundle_copy, "places.npy", npy_bytes(tmp_path / "a.npy", places))
    with pytest.raises(
        BundleError, match=r"places\.npy: a pose is not finite, scales, mirrors, or is more than 1e\+07 m"
    ):
        MapBundle.open(bundle_copy)


def test_a_view_whose_heading_is_not_finite_is_refused(bundle_copy: Path, tmp_path: Path) -> None:
    views = np.load(bundle_copy / "views.npy")
    views["heading_rad"][7] = np.nan
    replace_file(bundle_copy, "views.npy", npy_bytes(tmp_path / "a.npy", views))
    with pytest.raises(BundleError, match=r"views\.npy: a heading is not finite"):
        MapBundle.open(bundle_copy)


def test_views_that_do_not_lie_place_by_place_are_refused(bundle_copy: Path, tmp_path: Path) -> None:
    """Every place has four views, but the last view of one and the first of the next are swapped."""
    views = np.load(bundle_copy / "views.npy")
    views[[3, 4]] = views[[4, 3]]
    replace_file(bundle_copy, "views.npy", npy_bytes(tmp_path / "a.npy", views))
    with pytest.raises(
        BundleError, match=r"views\.npy: the views are not sorted by place, with all headings of each place"
    ):
        MapBundle.open(bundle_copy)


def test_a_fan_of_another_size_is_refused(bundle_copy: Path) -> None:
    edit_manifest(bundle_copy, lambda document: document.update(headings=3))
    with pytest.raises(
        BundleError, match=r"views\.npy: the views are not sorted by place, with all headings of each place"
    ):
        MapBundle.open(bundle_copy)


def test_without_verification_sizes_are_still_compared(bundle_copy: Path) -> None:
    (bundle_copy / "views.npy").write_bytes((bundle_copy / "views.npy").read_bytes()[:-8])
    with pytest.raises(BundleError, match="bytes instead of"):
        MapBundle.open(bundle_copy, verify=False)


@pytest.mark.parametrize(
    ("georeference", "what"),
    [
        ({"latitude_deg": 91, "longitude_deg": 0}, "latitude_deg: 91.0 is not between -90 and 90"),
        (
            {"latitude_deg": 0, "longitude_deg": -200, "height_m": 3},
            "longitude_deg: -200.0 is not between -180 and 180",
        ),
        ({"latitude_deg": 1}, "missing .*'longitude_deg'"),
        ({"latitude_deg": 1, "longitude_deg": 2, "epsg": 3}, "'epsg'"),
        ({}, "missing .*'latitude_deg'"),
    ],
)
def test_a_georeference_that_is_no_place_on_the_earth_is_refused(
    bundle_copy: Path, georeference: dict[str, float], what: str
) -> None:
    edit_manifest(bundle_copy, lambda document: document.update(georeference=georeference))
    with pytest.raises(BundleError, match=f"georeference: .*{what}.*; copy or build the bundle again"):
        MapBundle.open(bundle_copy)


def test_a_georeference_of_anything_but_numbers_is_refused(bundle_copy: Path) -> None:
    def edit(document: dict[str, Any]) -> None:
        document["georeference"] = {"latitude_deg": "north", "longitude_deg": 0}

    edit_manifest(bundle_copy, edit, stamp=False)
    with pytest.raises(BundleError, match=r"georeference\.latitude_deg"):
        MapBundle.open(bundle_copy)


@pytest.mark.parametrize("name", ["places.npy", "views.npy", "cloud/surfels.npy"])
@pytest.mark.parametrize("byte", [0, 123, 255])
def test_an_array_whose_header_is_no_text_is_refused(bundle_copy: Path, name: str, byte: int) -> None:
    """Found by fuzzing: NumPy's header reader raises errors of Python's tokenizer."""
    data = bytearray((bundle_copy / name).read_bytes())
    data[43] = byte
    replace_file(bundle_copy, name, bytes(data))
    with pytest.raises(BundleError, match=f"{name}"):
        MapBundle.open(bundle_copy)


def test_a_dataset_given_as_a_bundle_is_named(tmp_path: Path) -> None:
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(BundleError) as caught:
        MapBundle.open(tmp_path)
    assert caught.value.message == (
        f"{tmp_path}: a dataset, not a map bundle; run `streetfix build-map {tmp_path} --out BUNDLE`, and give BUNDLE"
    )
