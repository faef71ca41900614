"""``info``, ``verify`` and ``diff``, and ``streetfix map`` as a user calls it."""

import json
import re
import shutil
from dataclasses import replace
from importlib.metadata import EntryPoint

import cv2
import numpy as np
import pytest

from model_training.mapping.diff import diff_of, difference_png
from model_training.mapping.info import info_of
from model_training.mapping.stored_map import content_of
from model_training.mapping.verify import damage_of
from model_training.mapping.voxel_map import VOXEL, VoxelMap
from service.cli import main as command_line
from service.errors import BundleError
from service.maps.byte_planes import Columns
from service.maps.manifest import read_manifest
from service.maps.reader import MapBundle
from service.maps.writer import write_bundle
from service.registration.surfel_map import SurfelMap

#: Stretches a pose by less than opening a map refuses.
SKEWED = np.pad(np.full((3, 3), 1.0001), (0, 1), constant_values=1.0)


@pytest.fixture
def run(monkeypatch, capsys):
    """Run ``streetfix map``; return code, stdout and stderr."""
    point = EntryPoint("map", "model_training.cli.map_care:app", command_line.GROUP)
    monkeypatch.setattr(command_line, "entry_points", lambda **_: [point])

    def called(*arguments):
        with pytest.raises(SystemExit) as end:
            command_line.main(["map", *map(str, arguments)])
        told = capsys.readouterr()
        return int(end.value.code or 0), told.out, told.err

    return called


@pytest.fixture
def own(small_map, tmp_path):
    return shutil.copytree(small_map, tmp_path / "own")


def test_info_tells_what_the_bundle_holds(small_map):
    bundle, found = MapBundle.open(small_map), info_of(small_map)
    assert (found["name"], found["version"]) == ("small", bundle.manifest.version)
    assert found["counts"] == bundle.manifest.counts.model_dump()
    assert found["size_bytes"] == sum(path.stat().st_size for path in small_map.rglob("*") if path.is_file())
    assert bundle.streets is not None
    assert found["streets"] == sorted({street.street for street in bundle.streets.features})
    assert found["keeps_sums"] is True
    assert found["calibrated"] is False
    assert found["encoder"]["sha256"] == bundle.manifest.encoder_sha256
    assert found["extent_m"]["max"][0] == pytest.approx(bundle.T_map_place[:, 0, 3].max(), abs=0.01)
    json.dumps(found)


def test_info_for_a_user(run, small_map):
    code, out, _ = run("info", small_map)
    assert code == 0
    assert out.startswith("map small, version ")
    assert "voxel sums stored" in out
    code, out, _ = run("info", small_map, "--json")
    assert json.loads(out)["name"] == "small"


def test_info_of_what_is_no_bundle_is_refused(run, tmp_path):
    code, _, err = run("info", tmp_path)
    assert code == 1
    assert "not a map bundle: manifest.json is missing" in err


def test_a_whole_bundle_is_whole(run, small_map, bundle_path):
    assert damage_of(small_map) == []
    assert damage_of(bundle_path) == []
    code, out, _ = run("verify", small_map)
    assert (code, out) == (0, f"{small_map}: no defects\n")


def test_every_damaged_file_is_named(run, own):
    (own / "streets.geojson").unlink()
    (own / "views.npy").write_bytes((own / "views.npy").read_bytes()[:-1])
    surfels = bytearray((own / "cloud" / "surfels.npy").read_bytes())
    surfels[-1] ^= 1
    (own / "cloud" / "surfels.npy").write_bytes(surfels)
    code, out, _ = run("verify", own)
    assert code == 1
    assert out.splitlines() == [
        f"{own}/cloud/surfels.npy: the hash does not match the manifest",
        f"{own}/streets.geojson: missing, or outside the bundle",
        f"{own}/views.npy: {(own / 'views.npy').stat().st_size} bytes instead of {(own / 'views.npy').stat().st_size + 1}",
    ]


def test_a_folder_that_is_no_bundle_is_one_defect(run, tmp_path):
    code, out, _ = run("verify", tmp_path)
    assert code == 1
    assert "not a map bundle: manifest.json is missing" in out


def test_a_manifest_of_another_format_is_named(own):
    manifest = json.loads((own / "manifest.json").read_text())
    (own / "manifest.json").write_text(json.dumps(manifest | {"format": 3}))
    assert "format 3" in damage_of(own)[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: {"T_map_place": c.T_map_place * SKEWED}, r"places\.npy: 12 poses are not rigid transforms"),
        (
            lambda _: {"place_street": np.array([2] * 6 + [1, 1, 2, 2, 2, 2], np.int32)},
            r"places\.npy: 6 places are outside the streets that they name",
        ),
        (
            lambda _: {"statistics": Columns.of(np.zeros(3))},
            r"voxels\.zst: .*24 bytes is not a multiple of the record size, 60 bytes",
        ),
        (lambda _: {"statistics": Columns.of(np.zeros(3, VOXEL))}, r"voxels\.zst: a voxel has no points"),
    ],
)
def test_contradicting_contents_are_reported(content, tmp_path, change, message):
    write_bundle(tmp_path / "m", replace(content, **change(content)))
    assert re.search(message, "\n".join(damage_of(tmp_path / "m")))


def test_a_map_does_not_differ_from_itself(run, small_map):
    bundle = MapBundle.open(small_map)
    found = diff_of(bundle, bundle)
    count = bundle.manifest.counts
    assert found["places"] == {"kept": count.places, "moved": 0, "largest_move_m": 0.0, "added": [], "removed": []}
    assert found["cloud"] == {"appeared": 0, "vanished": 0, "kept": count.cloud_points, "areas": []}
    assert found["streets"] == {"added": [], "removed": [], "changed": []}
    assert found["parameters"] == {}
    assert found["encoder_changed"] is False
    code, out, _ = run("diff", small_map, small_map)
    assert code == 0
    assert "0 added, 0 removed" in out


def slab(corner, *, count=4):
    """Return points of ``count`` x ``count`` ground voxels of 0.3 m, nine in each."""
    steps = np.arange(count * 3) * 0.1 + 0.05
    x, y = np.meshgrid(steps, steps)
    return np.c_[x.ravel(), y.ravel(), np.full(x.size, 0.05)] + [*corner, 0.0]


def map_with(tmp_path, name, content, slabs, **changed):
    cloud = VoxelMap(0.3, np.zeros(3))
    for corner in slabs:
        cloud.add(slab(corner))
    prepared = SurfelMap.prepare(cloud.origin, *cloud.surfels())
    parameters = {**content.parameters, "voxel_m": 0.3, **changed.pop("parameters", {})}
    write_bundle(tmp_path / name, replace(content, cloud=prepared, parameters=parameters, **changed))
    return MapBundle.open(tmp_path / name)


@pytest.fixture
def changed(content, tmp_path):
    """Old: slabs at (0, 0) and (30, 0). New: at (0, 0) and (90, 0); one place moved by 1 m, two removed, a street renamed."""
    before = map_with(tmp_path, "before", content, [(0.0, 0.0), (30.0, 0.0)])
    moved = content.T_map_place[2:].copy()
    moved[0, 0, 3] += 1.0
    streets = json.loads(json.dumps(content.streets))
    streets["features"][0]["properties"]["name"] = "Another name"
    streets["features"][1]["properties"]["id"] = "new"
    after = map_with(
        tmp_path,
        "after",
        content,
        [(0.0, 0.0), (90.0, 0.0)],
        T_map_place=moved,
        place_street=content.place_street[2:],
        view_place=content.view_place[:-8],
        view_heading_rad=content.view_heading_rad[8:],
        descriptors=content.descriptors[8:],
        streets=streets,
        parameters={"survey_scans": 7.0},
    )
    return before, after


def test_differences_by_hand(changed):
    found = diff_of(*changed)
    assert found["places"] == {"kept": 10, "moved": 1, "largest_move_m": 1.0, "added": [], "removed": [0, 1]}
    assert (found["cloud"]["appeared"], found["cloud"]["vanished"], found["cloud"]["kept"]) == (16, 16, 16)
    assert found["cloud"]["areas"] == [
        {"x": 30.0, "y": 10.0, "appeared": 0, "vanished": 16},
        {"x": 90.0, "y": 10.0, "appeared": 16, "vanished": 0},
    ]
    assert found["streets"] == {"added": ["new"], "removed": ["s1"], "changed": ["s0"]}
    assert found["parameters"] == {"survey_scans": [None, 7.0]}
    json.dumps(found)


def test_the_picture_shows_green_and_red(run, changed, tmp_path):
    before, after = changed
    picture = cv2.imdecode(np.frombuffer(difference_png(before, after, longest_px=400), np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    assert max(picture.shape) <= 402
    blue, green, red = (picture[..., k].astype(int) for k in range(3))
    assert ((green > red + 50) & (green > blue + 50)).sum() > 5
    assert ((red > green + 100) & (red > blue + 100)).sum() > 5
    code, out, _ = run("diff", before.path, after.path, "--picture", tmp_path / "d.png", "--json")
    assert code == 0
    assert json.loads(out)["places"]["removed"] == [0, 1]
    assert cv2.imread(str(tmp_path / "d.png")) is not None
    code, _, err = run("diff", before.path, after.path, "--picture", tmp_path / "none" / "d.png")
    assert code == 1
    assert "cannot be written" in err


def test_another_encoder_is_reported(changed, content, encoder_of, tmp_path):
    other = map_with(tmp_path, "other", content, [(0.0, 0.0)], encoder=encoder_of(seed=9))
    assert diff_of(changed[0], other)["encoder_changed"] is True


def test_merge_and_update_as_a_person_calls_them(run, half_maps, small_dataset, tmp_path):
    code, out, err = run("merge", *half_maps, "--out", tmp_path / "merged", "--name", "town")
    assert (code, out.startswith("map town, version ")) == (0, True), err
    code, out, err = run("update", half_maps[0], small_dataset.folder, "--out", tmp_path / "updated", "--replace")
    assert (code, out.startswith("map small, version ")) == (0, True), err
    assert damage_of(tmp_path / "merged") == damage_of(tmp_path / "updated") == []
    code, _, err = run("merge", *half_maps, "--out", tmp_path / "merged")
    assert (code, "already" in err) == (1, True)
    assert run("merge", *half_maps, "--out", tmp_path / "merged", "--overwrite")[0] == 0


def test_a_map_of_one_bundle_takes_a_survey_in_object_storage(run, half_maps, small_dataset, survey_url, tmp_path):
    for place, out in ((survey_url, "stored"), (small_dataset.folder, "local")):
        code, _, err = run("update", half_maps[0], place, "--out", tmp_path / out)
        assert code == 0, err
    stored, local = (read_manifest(tmp_path / out) for out in ("stored", "local"))
    assert stored.version == local.version
    assert sorted(path.name for path in tmp_path.iterdir()) == ["local", "stored"]


def test_both_ways_to_replace_at_once_are_wrong_usage(run, half_maps, small_dataset, tmp_path):
    area = ("--replace", "--replace-area", tmp_path / "area.geojson")
    code, _, err = run("update", half_maps[0], small_dataset.folder, "--out", tmp_path / "m", *area)
    assert (code, "not both" in err) == (2, True)


def test_without_a_command_the_help_is_shown(run):
    code, out, err = run()
    assert code == 2
    for name in ("info", "verify", "diff", "merge", "update"):
        assert name in out + err


def test_content_survives_the_disk(content, bundle_path):
    found = content_of(MapBundle.open(bundle_path))
    for name in ("T_map_place", "place_street", "view_place", "view_heading_rad", "rows_seen"):
        np.testing.assert_array_equal(getattr(found, name), getattr(content, name))
    np.testing.assert_allclose(found.descriptors, content.descriptors, atol=0.01)  # a component takes a byte
    assert (found.streets, found.encoder, found.parameters) == (content.streets, content.encoder, content.parameters)


def test_a_map_without_a_voxel_size_is_refused(content, tmp_path):
    from model_training.mapping.stored_map import voxels_of

    write_bundle(tmp_path / "m", replace(content, parameters={"lidar_height_m": 1.8}))
    with pytest.raises(BundleError, match="its parameters have no voxel_m"):
        voxels_of(MapBundle.open(tmp_path / "m"))
