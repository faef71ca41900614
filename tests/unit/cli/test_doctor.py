import json
import socket

import pytest

from service.cli.main import main
from service.doctor import machine
from service.geometry.camera import PinholeCamera


def run(*arguments):
    with pytest.raises(SystemExit) as end:
        main(["doctor", *arguments])
    return int(end.value.code or 0)


@pytest.fixture
def free(monkeypatch):
    """Return free ports that the system chooses, so no test depends on other programs."""
    monkeypatch.setenv("STREETFIX_PORT", "0")


@pytest.fixture
def files(tmp_path, parts_of):
    parts = parts_of()
    for name, part in parts.items():
        (tmp_path / name).write_bytes(part)
    return {"camera": tmp_path / "request", "rgb": tmp_path / "rgb", "depth": tmp_path / "depth"}


def options_of(files):
    return [word for name, path in files.items() for word in (f"--{name}", str(path))]


def checks_of(out):
    return [line[9:].partition(":")[0] for line in out.splitlines()[:-1]]


MACHINE = ["platform", "cores", "instruction set", "shared memory", "compiled code", "settings", "port", "grpc port"]
MAP = ["map", "encoder", "calibration", "cloud", "streets"]
CAMERA = ["camera file", "principal point", "field of view", "focal lengths", "distortion"]
PAIR = ["images", "depth unit", "depth share", "depth on colour", "camera height"]


@pytest.mark.usefixtures("free")
def test_without_arguments_only_the_machine_is_checked(capsys):
    assert run() == 0
    out = capsys.readouterr().out
    assert checks_of(out) == MACHINE
    assert out.splitlines()[-1].startswith("problems: 0, warnings: ")


@pytest.mark.usefixtures("free")
def test_all_checks_run_where_all_is_given(capsys, files, bundle_path):
    assert run("--map", str(bundle_path), *options_of(files)) == 0
    out = capsys.readouterr().out
    assert checks_of(out) == [*MACHINE, *MAP, *CAMERA, *PAIR, "same heights", "answer"]
    assert "ok       answer: LOCALIZED (no confidence)" in out
    assert "warning  calibration: the map is not calibrated" in out


@pytest.mark.usefixtures("free")
def test_images_of_a_lens_get_all_checks_and_an_answer(capsys, files, bundle_path, pictures_through, png_and_npy):
    lens = PinholeCamera(128, 96, 80.0, 80.0, 63.5, 47.5, (0.01, 0.0, 0.0, 0.0), "kannala_brandt")
    for name, part in png_and_npy(*pictures_through(lens)).items():
        files[name].write_bytes(part)
    camera = {name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion_model")}
    document = {"camera": camera | {"distortion": list(lens.distortion)}, "depth": {"scale_m": 1}}
    files["camera"].write_text(json.dumps(document))
    assert run("--map", str(bundle_path), *options_of(files)) == 0
    out = capsys.readouterr().out
    assert checks_of(out) == [*MACHINE, *MAP, *CAMERA, *PAIR, "same heights", "answer"]
    assert "ok       distortion: kannala_brandt [0.01, 0.0, 0.0, 0.0]: the service rectifies both images" in out
    assert "ok       answer: LOCALIZED (no confidence)" in out


@pytest.mark.usefixtures("free")
def test_json_says_the_same(capsys, files):
    assert run("--json", *options_of(files)) == 0
    told = json.loads(capsys.readouterr().out)
    assert [each["check"] for each in told["findings"]] == [*MACHINE, *CAMERA, *PAIR]
    assert told["problems"] == 0
    assert told["warnings"] == sum(each["level"] == "warning" for each in told["findings"])
    assert set(told["findings"][0]) == {"check", "level", "text", "remedy"}


@pytest.mark.usefixtures("free")
def test_a_problem_ends_with_one_and_the_other_checks_still_run(capsys, files, tmp_path):
    assert run("--map", str(tmp_path / "none"), *options_of(files)) == 1
    out = capsys.readouterr().out
    assert checks_of(out) == [*MACHINE, "map", *CAMERA, *PAIR]
    assert out.splitlines()[-1].startswith("problems: 1, ")


@pytest.mark.usefixtures("free")
def test_a_camera_file_that_is_none_ends_the_checks_that_need_it(capsys, files):
    files["camera"].write_text("{}")
    assert run(*options_of(files)) == 1
    assert checks_of(capsys.readouterr().out) == [*MACHINE, "camera file"]


@pytest.mark.usefixtures("free")
def test_a_missing_image_is_a_problem(capsys, files):
    files["depth"].unlink()
    assert run(*options_of(files)) == 1
    assert f"problem  images: {files['depth']}: cannot be read (No such file or directory)" in capsys.readouterr().out


@pytest.mark.parametrize("names", [("rgb",), ("depth", "camera"), ("rgb", "depth")])
def test_a_pair_needs_both_images_and_the_camera(capsys, files, names):
    assert run(*options_of({name: files[name] for name in names})) == 2
    assert "Error" in capsys.readouterr().err


def test_a_port_that_was_named_and_is_taken_is_a_problem(capsys):
    with socket.create_server(("127.0.0.1", 0)) as other:
        assert run("--port", str(other.getsockname()[1])) == 1
    assert "problem  port: cannot listen on 127.0.0.1:" in capsys.readouterr().out


@pytest.mark.usefixtures("free")
def test_a_setting_that_makes_no_sense_is_a_problem(capsys, monkeypatch):
    monkeypatch.setenv("STREETFIX_THREADS", "0")
    assert run() == 1
    out = capsys.readouterr().out
    assert checks_of(out) == MACHINE[:6]
    assert "problem  settings: setting threads" in out


@pytest.mark.usefixtures("free")
def test_a_library_that_fails_to_load_is_reported_and_the_checks_continue(capsys, monkeypatch):
    def refuse():
        raise OSError("wrong ELF class")

    monkeypatch.setattr(machine, "LIBRARIES", {"x": refuse})
    assert run() == 1
    assert "problem  compiled code: x does not load (wrong ELF class)" in capsys.readouterr().out
