"""``simulate-training``, and ``train`` from what it writes, as a user calls them."""

from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from model_training.training import recipe
from model_training.training.city_archive import archive_name
from model_training.training.packs import PackPlan
from service.cli import main as command_line

PLANS = [PackPlan(seed=1002 + k, places=4, queries_a_place=1, lidar="vlp_16", size_m=(60.0, 60.0)) for k in range(2)]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run a command on tiny cities; return code, stdout and stderr."""
    points = [
        EntryPoint("simulate-training", "model_training.cli.simulate_training:command", command_line.GROUP),
        EntryPoint("train", "model_training.cli.train:command", command_line.GROUP),
    ]
    monkeypatch.setattr(command_line, "entry_points", lambda **_: points)
    monkeypatch.setitem(recipe.RECIPES, "stock", lambda cities: PLANS[:cities])

    def called(*arguments: str | Path) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as end:
            command_line.main([str(argument) for argument in arguments])
        told = capsys.readouterr()
        return int(end.value.code or 0), " ".join(told.out.split()), told.err

    return called


def test_a_training_on_simulated_files_learns_what_a_training_that_simulates_learns(run: Any, tmp_path: Path) -> None:
    torch = pytest.importorskip("torch", reason="needs the extra `training`")
    cities, packs = tmp_path / "cities", tmp_path / "packs"
    code, told, progress = run("simulate-training", "--out", cities, "--cities", "2", "--workers", "2")
    assert code == 0
    assert f"2 cities in {cities}; next: streetfix train --cities 2 --run RUN --cities-from {cities}" in told
    assert "training cities: 0 of 2 (0 %), started" in progress
    assert sorted(path.name for path in cities.iterdir()) == [archive_name(plan) for plan in PLANS]
    short = ("--cities", "2", "--steps", "2", "--pairs", "4", "--device", "cpu")
    code, _, progress = run("train", "--run", tmp_path / "one", "--packs", packs / "1", "--cities-from", cities, *short)
    assert code == 0
    assert "unpacking cities: 2 done" in progress
    assert run("train", "--run", tmp_path / "other", "--packs", packs / "2", "--workers", "2", *short)[0] == 0
    nets = [torch.load(tmp_path / name / "checkpoint.pt", weights_only=True)["net"] for name in ("one", "other")]
    assert all(torch.equal(weights, nets[1][name]) for name, weights in nets[0].items())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--recipe", "soup"), "recipe: 'soup' is not valid; choose one of: stock, streets"),
        (("--recipe", "paper", "--cities", "2"), "cities: the recipe 'paper' has fixed cities; omit --cities"),
    ],
)
def test_cities_that_do_not_exist_are_refused_before_the_work(
    run: Any, arguments: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    code, _, error = run("simulate-training", "--out", tmp_path / "cities", *arguments)
    assert code == 1
    assert message in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("option", "value"), [("--cities", "0"), ("--workers", "0"), ("--engine", "slurm")])
def test_a_value_out_of_bounds_is_refused_by_its_option(run: Any, option: str, value: str, tmp_path: Path) -> None:
    code, _, error = run("simulate-training", "--out", tmp_path / "cities", option, value)
    assert code == 2
    assert f"Invalid value for '{option}'" in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--workers", "2"), "workers: nothing is simulated with --cities-from; omit --workers"),
        ((), r"is missing, and 2 of 2 cities in all; simulate them there first (streetfix simulate-training)"),
    ],
)
def test_train_says_what_it_needs_of_the_files(
    run: Any, arguments: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    pytest.importorskip("torch", reason="needs the extra `training`")
    given = ("--run", tmp_path / "run", "--packs", tmp_path / "packs", "--cities", "2", "--device", "cpu")
    code, _, error = run("train", *given, "--cities-from", tmp_path / "none", *arguments)
    assert code == 1
    assert message in error


def test_the_default_view_grid_is_that_of_the_encoder() -> None:
    """``simulate-training`` does without torch, so it cannot read the shape of the encoder."""
    pytest.importorskip("torch", reason="needs the extra `training`")
    from model_training.training.loop import TrainingConfig
    from service.imaging.view_grid import ViewGrid

    shape = TrainingConfig().encoder
    assert ViewGrid(rows=shape.rows, columns=shape.columns) == ViewGrid()
