"""URLs where a command reads or writes the folder of a map."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli.main import app_for

URL = "s3://key:secret@bucket/maps/town"
PULL = "streetfix map pull URL FOLDER"
PUSH = "streetfix map push FOLDER URL"


@pytest.mark.parametrize(
    ("arguments", "name", "remedy"),
    [
        (["map", "info", URL], "bundle", PULL),
        (["map", "verify", URL], "bundle", PULL),
        (["map", "diff", URL, "maps/town"], "before", PULL),
        (["map", "diff", "maps/town", URL], "after", PULL),
        (["map", "merge", URL, "maps/south", "--out", "maps/new"], "first", PULL),
        (["map", "merge", "maps/north", URL, "--out", "maps/new"], "second", PULL),
        (["map", "merge", "maps/north", "maps/south", "--out", URL], "--out", PUSH),
        (["map", "update", URL, "data/may", "--out", "maps/new"], "bundle", PULL),
        (["map", "update", "maps/town", "s3://bucket/may", "--out", URL], "--out", PUSH),
        (["map", "push", URL, "s3://bucket/maps/town"], "map", PULL),
        (["map", "pull", "s3://bucket/maps/town", URL], "out", PUSH),
        (["map", "index", "maps/town", URL, "--qdrant", "http://127.0.0.1:6333"], "map...", PULL),
        (["build-map", "data/town", "--out", URL], "--out", PUSH),
        (["build-map", "data/town", "--out", "maps/town", "--frame", URL], "--frame", PULL),
        (["evaluate", URL, "data/town"], "bundle", PULL),
        (["calibrate", "--map", URL, "--drive", "data/drive"], "--map", PULL),
        (["doctor", "--map", URL], "--map", PULL),
        (["bridge", "ros2", "--map", URL], "--map", PULL),
    ],
)
def test_a_url_where_a_folder_is_meant_is_refused_with_the_option_and_the_remedy(
    arguments: list[str], name: str, remedy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = CliRunner().invoke(app_for(arguments), arguments, env={"COLUMNS": "400"})
    assert ended.exit_code == 2, ended.output
    assert f"invalid value for '{name}':" in ended.output.lower().translate({ord("{"): None, ord("}"): None})
    assert "s3://..." in ended.output
    assert remedy in ended.output
    assert "secret" not in ended.output
    assert list(tmp_path.iterdir()) == []


def test_a_path_of_windows_and_a_name_with_a_colon_are_folders() -> None:
    """A drive has one letter in front of the colon, and is no scheme; `town:may` has no slash behind the colon."""
    for folder in ("C:/maps/town", "maps/town:may", "town:may"):
        arguments = ["map", "info", folder]
        ended = CliRunner().invoke(app_for(arguments), arguments)
        assert ended.exit_code == 1
        assert "is a URL" not in ended.output
        assert "manifest.json is missing" in str(ended.exception)
