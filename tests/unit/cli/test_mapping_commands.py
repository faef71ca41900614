"""``simulate``, ``import``, ``build-map``, ``train`` and ``export`` as a user calls them."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from model_training.datasets.dataset import Dataset
from service.cli.main import main
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder

SMALL = ("--size", "60x60", "--spacing", "20", "--camera", "96x72", "--workers", "1")


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


def plan_in(folder: Path) -> dict:
    return json.loads((folder / "simulation.done.json").read_text())


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("cli") / "little-town"
    drives = ("--queries", "2", "--drives", "2", "--depth", "precise", "--depth", "stereo", "--on-track", "1")
    assert run("simulate", "--out", out, "--seed", "3", *drives, *SMALL) == 0
    return out


def test_simulate_writes_the_drives_and_presets_asked_for(simulated: Path) -> None:
    sets = [f"{drive}_{depth}" for drive in ("drive1", "drive2", "survey_drive") for depth in ("precise", "stereo")]
    dataset = Dataset(simulated)
    assert dataset.query_sets(with_truth=True) == sets
    assert [len(list(dataset.queries(name))) for name in sets] == [2, 2, 2, 2, 1, 1]


def test_simulate_names_the_dataset_after_its_folder(simulated: Path) -> None:
    assert Dataset(simulated).name == "little-town"


def test_simulate_drives_have_their_own_occupants_and_the_track_the_surveys(simulated: Path) -> None:
    assert [query["traversal"] for query in plan_in(simulated)["queries"]] == [1, 2, 0]


def test_simulate_passes_every_option_on(tmp_path: Path) -> None:
    options = {
        "--condition": ("fog", "condition"),
        "--parked-changed": (0.25, "parked_changed"),
        "--aside": (1.0, "aside_m"),
        "--heading": (5.0, "heading_deg"),
        "--turn": (10.0, "turn_deg"),
        "--pitch": (2.0, "pitch_deg"),
        "--blocked": (0.2, "blocked"),
        "--max-depth": (9.0, "max_depth_m"),
    }
    given = [str(part) for name, (value, _) in options.items() for part in (name, value)]
    more = ("--lidar", "vlp_16", "--survey-condition", "rain", "--no-survey-error", "--hfov", "70", "--queries", "1")
    assert run("simulate", "--out", tmp_path / "all", *given, *more, *SMALL) == 0
    plan = plan_in(tmp_path / "all")
    query = plan["queries"][0]
    assert {field: query[field] for _, field in options.values()} == {field: value for value, field in options.values()}
    assert (plan["lidar"], plan["survey_condition"], plan["survey_error"]) == ("vlp_16", "rain", False)
    assert plan["camera"]["horizontal_deg"] == 70.0


def test_simulate_takes_weather_and_mounting_on_the_track_too(tmp_path: Path) -> None:
    shared = {"condition": "night", "blocked": 0.2, "turn_deg": 10.0, "pitch_deg": 2.0, "max_depth_m": 9.0}
    given = ("--condition", "night", "--blocked", "0.2", "--turn", "10", "--pitch", "2", "--max-depth", "9")
    more = ("--queries", "1", "--on-track", "1", "--aside", "1", "--heading", "5", "--parked-changed", "0.2")
    assert run("simulate", "--out", tmp_path / "both", *given, *more, *SMALL) == 0
    drive, track = plan_in(tmp_path / "both")["queries"]
    assert {field: track[field] for field in shared} == {field: drive[field] for field in shared} == shared
    assert [(q["aside_m"], q["heading_deg"], q["parked_changed"]) for q in (drive, track)] == [
        (1, 5, 0.2),
        (2, 15, 0.5),
    ]


def test_simulate_replaces_single_numbers_of_the_sensors(tmp_path: Path) -> None:
    given = ("--set", "lidar.channels=16", "--set", "lidar.max_range_m=25", "--set", "depth.noise_px=0.3")
    more = ("--rgb", "small", "--set", "rgb.noise=2", "--sun-elevation", "20")
    assert run("simulate", "--out", tmp_path / "set", *given, *more, "--queries", "1", "--on-track", "1", *SMALL) == 0
    plan = plan_in(tmp_path / "set")
    assert plan["lidar_parameters"] == {"channels": 16, "max_range_m": 25.0}
    assert [query["rgb_parameters"] for query in plan["queries"]] == [{"noise": 2.0}] * 2
    assert [(query["rgb"], query["sun_elevation_deg"]) for query in plan["queries"]] == [("small", 20.0)] * 2
    assert [query["depth_parameters"] for query in plan["queries"]] == [{"noise_px": 0.3}] * 2


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["radar.power=1"], "radar.power: unknown sensor 'radar'; choose one of: lidar, rgb, depth"),
        (["lidar.beams=64"], "lidar.beams: lidar has no parameter 'beams'; it has: channels, columns"),
        (["depth.noise_px"], "set: 'depth.noise_px' is not SENSOR.NUMBER=VALUE"),
        (["channels=64"], "set: 'channels=64' is not SENSOR.NUMBER=VALUE"),
        (["lidar.channels=8"], "lidar.channels: Input should be greater than or equal to 16 (given: '8')"),
        (["depth.noise_px=much"], "depth.noise_px: Input should be a valid number"),
        (["depth.bleeding=nan"], "depth.bleeding: "),
        (["lidar.channels=16", "lidar.channels=32"], "lidar.channels: set twice"),
        (["lidar.top_deg=-20"], "lidar.top_deg: -20 is not above lidar.bottom_deg, -15"),
        (["depth.min_range_m=5", "depth.max_range_m=4"], "depth.max_range_m: 4 is not beyond depth.min_range_m, 5"),
    ],
)
def test_simulate_refuses_a_number_that_no_sensor_can_take(
    texts: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [part for text in texts for part in ("--set", text)]
    assert run("simulate", "--out", tmp_path / "no", *given) == 1
    assert capsys.readouterr().err.lstrip().startswith(f"streetfix: {message}")
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--city", "paris"), "'paris' is not valid; choose paper, city or mixed"),
        (("--size", "300"), "size: '300' is not two numbers"),
        (("--camera", "axb"), "camera: 'axb' is not two numbers"),
        (("--camera", "nanx480"), "camera: nan in 'nanx480' is not between 48 and 4096"),
        (("--size", "0x400"), "size: 0 in '0x400' is not between 30 and 10000"),
        (("--size", "300xinf"), "size: inf in '300xinf' is not between"),
        (("--lidar", "none"), "lidar: 'none' is not a valid preset"),
        (("--queries", "0", "--rgb", "small"), "rgb: this option has no effect without queries"),
        (("--queries", "0", "--sun-azimuth", "0"), "sun-azimuth: this option has no effect without queries"),
        (("--rgb", "none"), "rgb: 'none' is not a valid preset; choose one of: automatic, small, fixed"),
        (
            ("--condition", "fog", "--sun-azimuth", "90"),
            "sun_azimuth_deg: 90 has no effect with 'drive1', whose condition",
        ),
        (("--table1",), "--city paper"),
        (("--city", "paper", "--size", "300x400"), "size: the paper's city has a fixed size"),
        (("--queries", "0", "--on-track", "5", "--aside", "1"), "aside_m: 1 has no effect with 'survey_drive'"),
        (
            ("--queries", "0", "--set", "depth.noise_px=1"),
            "without queries only parameters of lidar and survey have an effect",
        ),
    ],
)
def test_simulate_says_what_is_wrong_and_writes_nothing(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("simulate", "--out", tmp_path / "no", *arguments) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "no").exists()


OUT_OF_BOUNDS = {
    "simulate": [
        ("--seed", "-1"),
        ("--spacing", "0"),
        ("--queries", "-1"),
        ("--drives", "0"),
        ("--on-track", "-1"),
        ("--parked-changed", "2"),
        ("--aside", "-1"),
        ("--heading", "181"),
        ("--turn", "200"),
        ("--pitch", "90"),
        ("--blocked", "1"),
        ("--max-depth", "0"),
        ("--hfov", "5"),
        ("--workers", "-1"),
    ],
    "build-map": [("--spacing", "-1"), ("--headings", "0"), ("--voxel", "0"), ("--lidar-height", "0")],
    "evaluate": [("--workers", "0")],
    "train": [
        ("--cities", "0"),
        ("--steps", "0"),
        ("--pairs", "1"),
        ("--rate", "0"),
        ("--seed", "-1"),
        ("--workers", "0"),
    ],
    "demo": [("--queries", "0"), ("--seed", "-1"), ("--port", "70000")],
}


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [(command, *given) for command, options in OUT_OF_BOUNDS.items() for given in options],
)
def test_a_number_out_of_bounds_is_refused_by_its_option(
    command: str, option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if command == "train":
        pytest.importorskip("torch", reason="needs the extra `training`")
    wanted = {
        "simulate": ("--out", tmp_path / "out"),
        "build-map": (tmp_path / "in", "--out", tmp_path / "out"),
        "evaluate": (tmp_path / "map", tmp_path / "in"),
        "train": ("--run", tmp_path / "out"),
        "demo": ("--out", tmp_path / "out"),
    }[command]
    assert run(command, *wanted, option, value) == 2
    assert f"Invalid value for '{option}'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (("--max-depth", "inf"), "max_depth_m: "),
        (("--camera", "640.5x480"), "width: "),
        (("--camera", "50x480"), "width: "),
    ],
)
def test_an_invalid_number_for_the_simulation_is_one_line(
    given: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("simulate", "--out", tmp_path / "no", *given) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"streetfix: {message}")
    assert err.count("\n") == 1
    assert not (tmp_path / "no").exists()


def test_build_map_makes_a_bundle_that_opens(
    simulated: Path, encoder_file: Path, calibration_file_of: Callable[..., Path], tmp_path: Path
) -> None:
    calibration = calibration_file_of(Encoder.open(encoder_file).sha256)
    arguments = (
        "--encoder",
        encoder_file,
        "--calibration",
        calibration,
        "--spacing",
        "20",
        "--headings",
        "4",
        "--name",
        "town",
        "--licence",
        "CC0-1.0",
    )
    assert run("build-map", simulated, "--out", tmp_path / "map", *arguments) == 0
    bundle = MapBundle.open(tmp_path / "map")
    assert bundle.calibration is not None
    manifest = bundle.manifest
    assert (manifest.name, manifest.headings, manifest.spacing_m, manifest.licence) == ("town", 4, 20.0, "CC0-1.0")


def test_build_map_reads_a_survey_in_object_storage(simulated: Path, encoder_file: Path, tmp_path: Path) -> None:
    url, out = f"file://{shutil.copytree(simulated, tmp_path / 'store')}", tmp_path / "map"
    arguments = ("--encoder", encoder_file, "--spacing", "20", "--headings", "4", "--name", "town")
    assert run("build-map", simulated, "--out", tmp_path / "local", *arguments) == 0
    assert run("build-map", url, "--out", out, *arguments) == 0
    one, other = (MapBundle.open(path) for path in (out, tmp_path / "local"))
    assert one.manifest.version == other.manifest.version
    assert not list(tmp_path.glob(".map.*"))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (("--calibration", "no.json"), "no.json cannot be read"),
        (("--encoder", "no.onnx"), "no.onnx"),
        (("--name", "a b"), "name: 'a b' cannot name a map"),
        (("--tile-m", "3"), "tile_m"),
        ((), "already exists"),
    ],
)
def test_build_map_refuses_before_it_fetches(
    simulated: Path, encoder_file: Path, tmp_path: Path, wrong: tuple[str, ...], message: str, capsys: Any
) -> None:
    if not wrong:
        (tmp_path / "map").mkdir()
    before = sorted(tmp_path.iterdir())
    arguments = ("--encoder", str(encoder_file), "--spacing", "20", "--headings", "4", *wrong)
    assert run("build-map", f"file://{simulated}", "--out", tmp_path / "map", *arguments) != 0
    assert message in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_build_map_with_a_calibration_that_is_missing_says_what_makes_one(
    simulated: Path, encoder_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ("--encoder", encoder_file, "--calibration", tmp_path / "no.json", "--spacing", "20", "--headings", "2")
    assert run("build-map", simulated, "--out", tmp_path / "map", *given) == 1
    assert (
        "no.json cannot be read (No such file or directory); create it with streetfix calibrate"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "map").exists()


def test_build_map_of_no_dataset_says_what_makes_one(
    encoder_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("build-map", tmp_path, "--out", tmp_path / "map", "--encoder", encoder_file) == 1
    assert "streetfix simulate" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("ros", "x"), "kind: 'ros' is not a known format"),
        (("kitti-object", "x", "--depth", "radar"), "depth: 'radar' is not valid; choose one of"),
    ],
)
def test_import_says_what_there_is(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("import", *arguments, "--out", tmp_path / "out") == 1
    assert message in capsys.readouterr().err


def test_train_refuses_a_recipe_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch", reason="needs the extra `training`")
    assert run("train", "--run", tmp_path / "run", "--recipe", "soup") == 1
    assert "'soup'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "value"),
    [("--device", "foo"), ("--optimiser", "lion"), ("--precision", "int4"), ("--negatives", "hard")],
)
def test_train_refuses_what_it_does_not_know_before_it_simulates(
    option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch", reason="needs the extra `training`")
    assert run("train", "--run", tmp_path / "run", "--packs", tmp_path / "packs", option, value) == 1
    assert f"{option[2:]}: '{value}'" in capsys.readouterr().err
    assert not (tmp_path / "packs").exists()


def test_export_of_no_run_says_what_makes_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("torch", reason="needs the extra `training`")
    assert run("export", tmp_path, "--out", tmp_path / "encoder.onnx") == 1
    assert "streetfix train" in capsys.readouterr().err
    assert not (tmp_path / "encoder.onnx").exists()
