"""``streetfix map push`` and ``map pull``."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from model_training.cli.map_care import app
from service.cli import main as command_line
from service.maps.manifest import read_manifest


def test_a_map_is_pushed_and_pulled(bundle_path: Path, tmp_path: Path) -> None:
    url, version = f"file://{tmp_path}/store/tiny", read_manifest(bundle_path).version
    pushed = CliRunner().invoke(app, ["push", str(bundle_path), url])
    assert pushed.exit_code == 0, pushed.output
    assert f"map tiny, version {version}" in pushed.output
    assert url in pushed.output
    assert ", 0.0 MB copied" in CliRunner().invoke(app, ["push", str(bundle_path), url]).output
    pulled = CliRunner().invoke(app, ["pull", url, str(tmp_path / "back")])
    assert pulled.exit_code == 0, pulled.output
    assert read_manifest(tmp_path / "back") == read_manifest(bundle_path)


@pytest.mark.parametrize("command", ["push", "pull"])
def test_the_help_has_an_example(command: str) -> None:
    assert f"streetfix map {command} " in CliRunner().invoke(app, [command, "--help"]).output


def test_a_missing_map_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "store").mkdir()
    with pytest.raises(SystemExit) as ended:
        command_line.main(["map", "pull", f"file://{tmp_path}/store", str(tmp_path / "back")])
    assert ended.value.code == 1
    assert f"streetfix: file://{tmp_path}/store/manifest.json is missing in the store" in capsys.readouterr().err
