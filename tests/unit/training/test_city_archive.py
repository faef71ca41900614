"""A city archive follows WebDataset, gives its pack back byte by byte, and is refused if it is damaged."""

import io
import json
import re
import tarfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from model_training.simulation.plan import CameraPlan
from model_training.simulation.stereo_pair import STEREOS
from model_training.training.archive_reader import unpack_archive
from model_training.training.city_archive import archive_name, write_archive
from model_training.training.matched_views import MatchedRig
from model_training.training.packs import PackPlan
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid

PLAN = PackPlan(seed=1002, places=3, queries_a_place=1)
STEM = PLAN.stem
RIG = MatchedRig(CameraPlan(width=160, height=96, horizontal_deg=70.0).pinhole(), (1.4, 1.6), STEREOS["sgbm"])
#: How the reader of WebDataset divides the name of an entry into key and extension.
KEY_AND_EXTENSION = re.compile(r"^((?:.*/|)[^.]+)[.]([^/]*)$")


def files_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def entries_of(archive: Path) -> list[tuple[str, bytes]]:
    with tarfile.open(archive) as tar:
        return [(entry.name, tar.extractfile(entry).read()) for entry in tar]  # type: ignore[union-attr]


def write(archive: Path, entries, *, kind: bytes = tarfile.REGTYPE) -> None:
    with tarfile.open(archive, "w") as tar:
        for name, content in entries:
            entry = tarfile.TarInfo(name)
            entry.size, entry.type = len(content), kind
            tar.addfile(entry, io.BytesIO(content))


def npy_of(array, **options) -> bytes:
    file = io.BytesIO()
    np.save(file, array, **options)
    return file.getvalue()


@pytest.fixture
def pack(pack_of, tmp_path):
    return pack_of(tmp_path / STEM, places=3)


@pytest.fixture
def archive(pack, grid, tmp_path):
    path = tmp_path / archive_name(PLAN)
    write_archive(pack, PLAN, grid, path)
    return path


@pytest.fixture
def refused(archive, grid, tmp_path):
    """Change the entries of the archive, and return the message of the error."""

    def message(change, *, kind=tarfile.REGTYPE) -> str:
        entries = dict(entries_of(archive))
        write(archive, change(entries) or entries.items(), kind=kind)
        with pytest.raises(DatasetError) as error:
            unpack_archive(archive, PLAN, grid, tmp_path / "unpacked")
        assert str(error.value).startswith(f"{archive}: ")
        assert "delete the file and make it again (streetfix simulate-training), or copy it again" in str(error.value)
        return str(error.value)

    return message


def with_array(entries, key: str, extension: str, content: bytes) -> None:
    """Replace an array, with the CRC-32 that fits."""
    told = json.loads(entries[f"{STEM}/{key}.json"])
    told["crc32"][extension] = zlib.crc32(content)
    entries[f"{STEM}/{key}.json"] = json.dumps(told).encode()
    entries[f"{STEM}/{key}.{extension}"] = content


def test_a_pack_comes_back_byte_by_byte(pack, archive, grid, tmp_path):
    unpack_archive(archive, PLAN, grid, tmp_path / "unpacked")
    assert files_of(tmp_path / "unpacked") == files_of(pack)


def test_a_pack_with_matched_depth_keeps_its_mask(pack_of, grid, tmp_path):
    plan = PackPlan(seed=1003, places=3, queries_a_place=1, rigs=(RIG,))
    pack = pack_of(tmp_path / plan.stem, places=3)
    np.save(pack / "seen.npy", np.random.default_rng(0).random((3, grid.rows, grid.columns)) < 0.5)
    write_archive(pack, plan, grid, tmp_path / "a.tar")
    unpack_archive(tmp_path / "a.tar", plan, grid, tmp_path / "unpacked")
    assert files_of(tmp_path / "unpacked") == files_of(pack)


def test_the_samples_are_named_and_ordered_as_webdataset_asks(archive):
    found: dict[str, list[str]] = {}
    for name, content in entries_of(archive):
        match = KEY_AND_EXTENSION.match(name)
        assert match is not None
        key, extension = match.groups()
        assert key not in found or key == list(found)[-1]  # the files of a sample lie one after another
        found.setdefault(key, []).append(extension)
        if extension == "json":
            json.loads(content)
        else:
            np.load(io.BytesIO(content), allow_pickle=False)
    place, query = ["json", "panorama.npy", "intensity.npy"], ["json", "ranges.npy", "rgb.npy"]
    assert found == {
        f"{STEM}/city": ["json"],
        **{f"{STEM}/place-00000{k}": place for k in range(3)},
        **{f"{STEM}/query-00000{k}": query for k in range(3)},
    }
    assert archive.read_bytes()[257:265] == b"ustar\x0000"  # a POSIX tar file without extensions


def test_one_pack_gives_one_sequence_of_bytes(pack, archive, grid, tmp_path):
    write_archive(pack, PLAN, grid, tmp_path / "again.tar")
    assert (tmp_path / "again.tar").read_bytes() == archive.read_bytes()


def test_other_programs_may_reorder_the_samples(pack, archive, grid, tmp_path):
    first, *others = entries_of(archive)
    samples = [others[k : k + 3] for k in range(0, len(others), 3)]
    write(archive, [first, *(entry for sample in samples[::-1] for entry in sample)])
    unpack_archive(archive, PLAN, grid, tmp_path / "unpacked")
    assert files_of(tmp_path / "unpacked") == files_of(pack)


@pytest.mark.parametrize("extension", ["panorama.npy", "intensity.npy"])
def test_a_flipped_bit_is_noticed(refused, extension):
    name = f"{STEM}/place-000001.{extension}"

    def flip(entries):
        entries[name] = entries[name][:-1] + bytes([entries[name][-1] ^ 1])

    assert f"entry place-000001.{extension}: it does not match the CRC-32 in place-000001.json" in refused(flip)


def test_a_changed_pose_is_noticed(refused):
    def move(entries):
        told = json.loads(entries[f"{STEM}/query-000002.json"])
        told["pose"][0] += 1
        entries[f"{STEM}/query-000002.json"] = json.dumps(told).encode()

    assert "entry query-000002.json: its pose does not match its CRC-32" in refused(move)


def test_a_truncated_archive_names_what_is_missing(archive, grid, tmp_path):
    whole = archive.read_bytes()
    with tarfile.open(archive) as tar:
        entry = tar.getmember(f"{STEM}/query-000001.rgb.npy")
    archive.write_bytes(whole[: entry.offset])
    with pytest.raises(DatasetError, match=r"entry query-000001\.rgb\.npy: it is missing"):
        unpack_archive(archive, PLAN, grid, tmp_path / "one")
    archive.write_bytes(whole[: entry.offset_data + 100])
    with pytest.raises(DatasetError, match=r"entry .*/query-000001\.rgb\.npy: it is damaged \(unexpected end"):
        unpack_archive(archive, PLAN, grid, tmp_path / "other")


@pytest.mark.parametrize("content", [b"", b"no tar file at all" * 1000])
def test_another_file_is_refused(archive, grid, tmp_path, content):
    archive.write_bytes(content)
    with pytest.raises(DatasetError, match="it is no tar file"):
        unpack_archive(archive, PLAN, grid, tmp_path / "unpacked")


def test_a_missing_archive_is_named(archive, grid, tmp_path):
    archive.unlink()
    with pytest.raises(DatasetError, match=r"pack3-city-1002.*\.tar: the file is missing"):
        unpack_archive(archive, PLAN, grid, tmp_path / "unpacked")


def test_a_missing_file_of_a_sample_is_named(refused):
    assert "entry place-000002.json: it is missing, or not beside" in refused(
        lambda entries: entries.pop(f"{STEM}/place-000002.json") and None
    )


def test_a_missing_sample_is_named(refused):
    def leave_out(entries):
        return [(name, content) for name, content in entries.items() if "place-000000" not in name]

    assert "entry place-000000.json: it is missing; missing samples: 1" in refused(leave_out)


def test_a_sample_that_is_there_twice_is_refused(refused):
    def twice(entries):
        return [*entries.items(), *((name, content) for name, content in entries.items() if "place-000000" in name)]

    assert "entry place-000000: this sample is there twice" in refused(twice)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("../passwd.json", "entry ../passwd.json: it does not belong to the city"),
        ("/etc/passwd.json", "entry /etc/passwd.json: it does not belong to the city"),
        (f"{STEM}/place-000000.pickle", "no sample of this city has a file of this kind"),
        (f"{STEM}/place-000000.seen.npy", "no sample of this city has a file of this kind"),
        (
            f"{STEM}/place-000003.json",
            "entry place-000003: this sample is there twice, or the city has no sample of this name",
        ),
    ],
)
def test_an_entry_that_does_not_belong_there_is_refused(refused, name, message):
    assert message in refused(lambda entries: entries.update({name: b"{}"}))


def test_links_are_refused(refused):
    assert "it is no normal file" in refused(lambda _: [(f"{STEM}/city.json", b"")], kind=tarfile.SYMTYPE)


def test_an_entry_that_is_too_large_is_refused_before_it_is_read(refused, grid, monkeypatch):
    large = npy_of(np.zeros((grid.rows, grid.around * 2), np.uint8))
    read = []
    extract = tarfile.TarFile.extractfile

    def note(tar, entry):
        read.append(entry.name)
        return extract(tar, entry)

    def change(entries):
        with_array(entries, "place-000001", "intensity.npy", large)
        monkeypatch.setattr(tarfile.TarFile, "extractfile", note)

    assert f"place-000001.intensity.npy: it has {len(large):,} bytes, more than" in refused(change)
    assert read[-1] == f"{STEM}/place-000001.panorama.npy"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (npy_of(np.zeros((16, 200), np.uint8)), "holds 3,200 bytes of uint8 with the shape (16, 200)"),
        (npy_of(np.zeros((16, 64), np.float16)), "holds 2,048 bytes of float16 with the shape (16, 64)"),
        (npy_of(np.zeros((256, 16), np.uint8).T), "in C order are expected"),
        (npy_of(np.zeros((16, 256), np.uint8))[:-1], "holds 4,095 bytes"),
        (npy_of(np.array([{}]), allow_pickle=True), "of object with the shape (1,)"),
        (npy_of(np.zeros((16, 256), np.uint8)).replace(b"(16, 256)", b"(9**9,  )"), "has no header of NPY 1.0"),
        (npy_of(np.zeros((16, 256), np.uint8)).replace(b"(16, 256)", b"(999999,)"), "uint8 with the shape (999999,)"),
        (b"\x93NUMPY\x02\x00" + b"\0" * 90, "has no header of NPY 1.0"),
        (b"", "has no header of NPY 1.0"),
    ],
)
def test_an_array_of_another_shape_or_type_is_refused(refused, content, message):
    told = refused(lambda entries: with_array(entries, "place-000001", "intensity.npy", content))
    assert "entry place-000001.intensity.npy: " in told
    assert message in told


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("format", 2, "format is 2, but this release reads 1"),
        ("pack", "another", f"pack is 'another' instead of '{STEM}'"),
        (
            "places",
            10**12,
            "places is 1000000000000 and queries is 3, but the city has up to 3 places with 1 queries each",
        ),
        ("places", "3", "places: Input should be a valid integer"),
        ("queries", 2, "places is 3 and queries is 2"),
        ("rows_seen", [True], "grid and rows_seen do not belong to ViewGrid(rows=16"),
        ("grid", {"rows": 32.0}, "grid and rows_seen do not belong to ViewGrid(rows=16"),
    ],
)
def test_a_city_file_that_does_not_fit_is_refused(refused, field, value, message):
    def change(entries):
        city = json.loads(entries[f"{STEM}/city.json"])
        entries[f"{STEM}/city.json"] = json.dumps(city | {field: value}).encode()

    told = refused(change)
    assert "entry city.json: " in told
    assert message in told


def test_the_city_file_comes_first(refused):
    assert "entry city.json: it is not the first entry" in refused(lambda entries: list(entries.items())[1:])


def test_an_archive_of_another_view_grid_is_refused(archive, tmp_path):
    with pytest.raises(DatasetError, match=r"entry city\.json: grid and rows_seen do not belong to"):
        unpack_archive(archive, PLAN, ViewGrid(), tmp_path / "unpacked")


def test_a_file_that_is_larger_than_any_archive_of_the_city_is_not_opened(archive, grid, tmp_path):
    with archive.open("ab") as file:
        file.truncate(10**9)
    with pytest.raises(DatasetError, match="it has 1,000,000,000 bytes, but an archive of this city has at most"):
        unpack_archive(archive, PLAN, grid, tmp_path / "unpacked")
    assert not (tmp_path / "unpacked").exists()


def test_a_damaged_pack_is_not_written(pack, grid, tmp_path):
    (pack / "rgb.npy").write_bytes(b"half")
    with pytest.raises(DatasetError, match=r"rgb\.npy: the file is damaged"):
        write_archive(pack, PLAN, grid, tmp_path / "no.tar")
    assert not (tmp_path / "no.tar").exists()
