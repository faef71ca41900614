"""``simulate --rig``: the rigs of the calibration as a user simulates them."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_training.calibration.families import FAMILIES, Family, family_plan
from model_training.cli import rig_option
from model_training.cli import simulate as command
from model_training.cli.rig_option import BEAMS, rig_lines
from model_training.datasets.dataset import Dataset
from model_training.simulation.plan import SimulationPlan
from model_training.simulation.simulate import simulate
from service.cli.main import main
from service.errors import DatasetError

SMALL = ("--size", "60x60", "--spacing", "20", "--workers", "1", "--queries", "1")


def run(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return int(end.value.code or 0)


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch) -> list[tuple[SimulationPlan, tuple[float, ...]]]:
    """Return a list that receives the plan and the beams instead of the simulator."""
    found: list[tuple[SimulationPlan, tuple[float, ...]]] = []

    def keep(plan: SimulationPlan, out: Path, beams_deg: tuple[float, ...], **_: Any) -> None:
        found.append((plan.checked(), beams_deg))

    monkeypatch.setattr(command, "simulate_rig", keep)
    return found


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
def test_a_rig_has_the_sensors_of_its_family(
    family: Family, planned: list[tuple[SimulationPlan, tuple[float, ...]]], tmp_path: Path
) -> None:
    """City, light, traffic and the poses of the queries are those of the command."""
    assert run("simulate", "--rig", family.name, "--out", tmp_path / "a") == 0
    ((plan, beams),) = planned
    of_calibration = family_plan(family, 0)
    of_rig = {
        "lidar",
        "lidar_height_m",
        "spacing_m",
        "camera",
        "camera_height_m",
        "lidar_parameters",
        "survey_parameters",
    }
    assert plan.model_dump(include=of_rig) == of_calibration.model_dump(include=of_rig)
    of_query = {"depths", "depth_parameters", "stereo_parameters", "cameras"}
    (query,), other = plan.queries, of_calibration.queries[0]
    assert query.model_dump(include=of_query) == other.model_dump(include=of_query)
    assert beams == family.beams
    assert (plan.seed, plan.city, query.aside_m, query.rgb) == (0, "city", 2.0, None)


def test_other_options_replace_single_values_of_a_rig(
    planned: list[tuple[SimulationPlan, tuple[float, ...]]], tmp_path: Path
) -> None:
    given = ("--lidar", "hdl_32", "--spacing", "3", "--camera", "320x200", "--depth", "bm", "--no-survey-error")
    more = ("--set", "stereo.max_range_m=15", "--set", "survey.speed_m_s=3")
    assert run("simulate", "--rig", "zed2", "--out", tmp_path / "a", *given, *more) == 0
    ((plan, _),) = planned
    assert (plan.lidar, plan.spacing_m, plan.lidar_height_m) == ("hdl_32", 3.0, 1.6)
    assert plan.camera.model_dump() == {"width": 320, "height": 200, "horizontal_deg": 105.0}
    assert plan.survey_parameters.model_dump() == {"speed_m_s": 3.0}  # the rig's 1.5 m/s and its errors are replaced
    (query,) = plan.queries
    assert query.depths == ("bm",)
    assert query.stereo_parameters.model_dump() == pytest.approx(
        {"focal_baseline_px_m": 31.0, "offset_px": 0.22, "vertical_px": 0.16, "roll_px": 0.16, "max_range_m": 15.0}
    )


def test_without_a_rig_the_defaults_are_as_before(
    planned: list[tuple[SimulationPlan, tuple[float, ...]]], tmp_path: Path
) -> None:
    assert run("simulate", "--out", tmp_path / "a") == 0
    ((plan, beams),) = planned
    assert beams == ()
    defaults = SimulationPlan(name="a").model_dump(exclude={"queries"})
    assert plan.model_dump(exclude={"queries"}) == defaults
    assert (plan.lidar, plan.spacing_m, plan.queries[0].depths) == ("paper_32", 1.0, ("precise",))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--rig", "d436"), "rig: 'd436' is not a rig; choose one of: car, car_sparse, robot, "),
        (
            ("--rig", "car", "--depth", "precise"),
            "depth: 'precise' does not fit rig 'car'; choose one of: sgbm, sgbm3way, bm, or omit",
        ),
        (
            ("--rig", "d435", "--depth", "sgbm"),
            "depth: 'sgbm' does not fit rig 'd435'; choose one of: ideal, precise, stereo, or omit",
        ),
        (("--rig", "d435", "--depth", "none"), "depth: 'none' is not a valid preset"),
        (("--rig", "d435", "--set", "stereo.roll_px=1"), "stereo_parameters: this option has no effect"),
        (
            ("--rig", "d435", "--set", "depth.min_range_m=9.9", "--set", "depth.max_range_m=9"),
            "depth.max_range_m: 9 is not beyond",
        ),
    ],
)
def test_what_does_not_fit_a_rig_is_refused(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("simulate", "--out", tmp_path / "no", *arguments) == 1
    assert capsys.readouterr().err.lstrip().startswith(f"streetfix: {message}")
    assert not (tmp_path / "no").exists()


def test_help_has_a_line_for_each_rig(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("simulate", "--help") == 0
    page = capsys.readouterr().out.splitlines()
    for family, line in zip(FAMILIES, rig_lines(), strict=True):
        assert f"    {line}" in page, line  # click indents the text by two more columns
        assert len(line) <= 76
        assert re.match(rf"{family.name} +[^:]+: ", line)


def test_rings_keep_the_depth_on_their_beams(tmp_path: Path) -> None:
    """The camera is level to a few degrees, and a beam of the rig may be half a pixel off a pixel's middle."""
    out = tmp_path / "rings"
    assert run("simulate", "--rig", "rings", "--camera", "96x72", "--seed", "3", "--out", out, *SMALL) == 0
    assert not list(tmp_path.glob(".*"))
    (rings,) = (family for family in FAMILIES if family.name == "rings")
    dataset = Dataset(out)
    assert dataset.description.source[BEAMS] == list(rings.beams)
    dense = tmp_path / "dense"
    simulate(SimulationPlan.model_validate(dataset.description.source["plan"]), dense, workers=1)
    (kept,), (full,) = (list(each.queries("drive1_precise")) for each in (dataset, Dataset(dense)))
    camera = kept.camera.pinhole()
    rays = camera.rays_of_pixels()
    elevation_deg = np.rad2deg(np.arctan2(-rays[..., 1], np.hypot(rays[..., 0], rays[..., 2])))
    away_deg = np.abs(elevation_deg[..., None] - np.array(rings.beams)).min(axis=-1)
    on_beam = away_deg < np.rad2deg(0.5 / camera.fy)
    assert 0.1 < on_beam.mean() < 0.9
    np.testing.assert_array_equal(kept.depth_m(), np.where(on_beam, full.depth_m(), 0))
    np.testing.assert_array_equal(kept.rgb(), full.rgb())


@pytest.fixture
def small_rings() -> SimulationPlan:
    """Return a plan of one image."""
    return SimulationPlan.model_validate(
        {
            "name": "a",
            "seed": 3,
            "size_m": (60.0, 60.0),
            "spacing_m": 20.0,
            "streets": ("1",),
            "camera": {"width": 96, "height": 72},
            "queries": ({"name": "drive1", "traversal": 1, "count": 1},),
        }
    )


def test_an_interrupted_simulation_on_beams_continues_and_a_finished_one_is_kept(
    small_rings: SimulationPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, beams = tmp_path / "a", (0.0, -10.0)

    def simulated() -> None:
        rig_option.simulate_rig(small_rings, out, beams, workers=1, report=lambda *_: None)

    with monkeypatch.context() as killed:
        killed.setattr(rig_option, "write_description", lambda *_: 1 / 0)  # the depth is cut already
        with pytest.raises(ZeroDivisionError):
            simulated()
    assert not out.exists()
    dense = tmp_path / ".a.dense"
    (depth,) = dense.glob("queries/*/depth/*.png")
    cut, (scan, *_) = depth.read_bytes(), dense.glob("survey/scans/*.bin")
    modified = scan.stat().st_mtime_ns
    simulated()
    assert not dense.exists()
    assert (out / depth.relative_to(dense)).read_bytes() == cut
    assert (out / scan.relative_to(dense)).stat().st_mtime_ns == modified
    before = (out / "dataset.json").stat().st_mtime_ns
    simulated()
    assert (out / "dataset.json").stat().st_mtime_ns == before


def test_a_dataset_of_another_depth_sensor_is_refused(
    small_rings: SimulationPlan, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The plans of a camera and of a LiDAR as depth sensor may be equal."""
    for folder, own, other in (("a", (0.0, -10.0), ()), ("b", (), (0.0, -10.0)), ("c", (0.0,), (1.0,))):
        out = tmp_path / folder
        rig_option.simulate_rig(small_rings, out, own, workers=1, report=lambda *_: None)
        with pytest.raises(DatasetError, match="rig with another depth sensor") as refused:
            rig_option.simulate_rig(small_rings, out, other, workers=1, report=lambda *_: None)
        assert refused.value.field == "out"
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "notes.txt").touch()
    with pytest.raises(DatasetError, match=r"d is not empty; choose another --out"):
        rig_option.simulate_rig(small_rings, tmp_path / "d", (0.0,), workers=1, report=lambda *_: None)


def test_a_damaged_depth_image_is_refused(
    small_rings: SimulationPlan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaging(plan: SimulationPlan, out: Path, **options: Any) -> None:
        simulate(plan, out, **options)
        for path in out.glob("queries/*/depth/*.png"):
            path.write_bytes(b"no image")

    monkeypatch.setattr(rig_option, "simulate", damaging)
    with pytest.raises(
        DatasetError, match=r"000000\.png: not an image; remove .*\.a\.dense, and run the command again"
    ):
        rig_option.simulate_rig(small_rings, tmp_path / "a", (0.0,), workers=1, report=lambda *_: None)


def test_four_cameras_write_four_images_for_each_query(tmp_path: Path) -> None:
    out = tmp_path / "ring"
    assert run("simulate", "--rig", "four_cameras", "--camera", "96x72", "--seed", "3", "--out", out, *SMALL) == 0
    frames = list(Dataset(out).queries("drive1_stereo"))
    poses = [each.T_map_camera for each in frames if each.T_map_camera is not None]
    headings = [np.rad2deg(np.arctan2(T[1, 2], T[0, 2])) for T in poses]
    assert len(poses) == 4
    assert np.abs((np.diff(headings) + 180) % 360 - 180) == pytest.approx(90.0, abs=5.0)
    plan = json.loads((out / "simulation.done.json").read_text())
    assert plan["queries"][0]["cameras"] == 4
