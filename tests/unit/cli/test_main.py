import re
import sys
import tomllib
import types
from collections.abc import Callable, Iterator
from importlib.machinery import ModuleSpec
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer

from service.cli import main as command_line
from service.cli.main import main
from service.errors import DatasetError


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    return int(end.value.code or 0)


@pytest.fixture
def mount(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Register commands under the entry-point group, as an installed package does."""

    def put(**functions: Callable[..., None] | None) -> None:
        module = types.ModuleType("fake_commands")
        module.__spec__ = ModuleSpec("fake_commands", None)
        for name, function in functions.items():
            if function is not None:
                setattr(module, name, function)
        monkeypatch.setitem(sys.modules, "fake_commands", module)
        points = [
            EntryPoint(name.replace("_", "-"), f"fake_commands:{name}", "streetfix.commands") for name in functions
        ]
        monkeypatch.setattr(command_line, "entry_points", lambda **_: points)

    return put


def test_help_lists_all_commands_with_a_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    out = capsys.readouterr().out
    for name in (
        "serve",
        "localize",
        "simulate",
        "import",
        "train",
        "export",
        "build-map",
        "evaluate",
        "demo",
        "calibrate",
    ):
        assert f"\n  {name} " in out


def test_no_arguments_show_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 2
    assert "Commands" in "".join(capsys.readouterr())


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("streetfix 0.")


@pytest.mark.parametrize("arguments", [["serve", "--prot", "1"], ["nothing"], ["localize"]])
def test_wrong_usage_is_two(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(*arguments) == 2
    assert "Error" in capsys.readouterr().err


def test_a_mounted_command_gets_its_arguments(mount: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    def build_map(source: Path, spacing_m: Annotated[float, typer.Option()] = 1.0) -> None:
        """Build."""
        typer.echo(f"{source.name} {spacing_m}")

    mount(build_map=build_map)
    assert run("build-map", "city", "--spacing-m", "2.5") == 0
    assert capsys.readouterr().out == "city 2.5\n"


def test_a_mounted_commands_own_help_is_shown(mount: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    def simulate() -> None:
        """Raise a city from its seed."""

    mount(simulate=simulate)
    assert run("simulate", "--help") == 0
    assert "Raise a city from its seed." in capsys.readouterr().out


@pytest.fixture
def care(mount: Callable[..., None]) -> None:
    """A command with subcommands."""
    app = typer.Typer(no_args_is_help=True, help="Look after maps.")

    @app.command()
    def info(bundle: Path) -> None:
        """Tell what is in it."""
        typer.echo(bundle.name)

    @app.command()
    def merge() -> None:
        """Need what is not there."""
        import a_package_that_is_not_there  # type: ignore[import-not-found]  # noqa: F401  # that is the point

    mount(map=app)


@pytest.mark.usefixtures("care")
def test_a_mounted_command_may_have_commands_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("map", "info", "maps/town") == 0
    assert capsys.readouterr().out == "town\n"
    assert run("map", "info") == 2
    assert run("map", "--help") == 0
    assert "Tell what is in it." in capsys.readouterr().out
    assert run("--help") == 0
    assert "\n  map " in capsys.readouterr().out


@pytest.mark.usefixtures("care")
def test_a_missing_package_of_a_commands_command_names_the_extra(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("map", "merge") == 1
    assert 'pip install ".[mapping]"' in capsys.readouterr().err


def test_only_the_called_command_is_imported(mount: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    # The function ``train`` is not there: loading it would fail.
    mount(simulate=lambda: None, train=None)
    assert run("simulate") == 0
    assert run("--help") == 0


@pytest.mark.parametrize(("name", "extra"), [("train", "training"), ("build_map", "mapping"), ("evaluate", "mapping")])
def test_a_missing_package_names_the_extra(
    mount: Callable[..., None], capsys: pytest.CaptureFixture[str], name: str, extra: str
) -> None:
    def needs_much() -> None:
        import a_package_that_is_not_there  # noqa: F401  # that is the point

    mount(**{name: needs_much})
    assert run(name.replace("_", "-")) == 1
    assert f'pip install ".[{extra}]"' in capsys.readouterr().err


def test_a_package_missing_at_import_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points = [EntryPoint("train", "service.a_module_that_is_not_there:command", "streetfix.commands")]
    monkeypatch.setattr(command_line, "entry_points", lambda **_: points)
    assert run("train", "anything", "--at", "all") == 1
    assert "a_module_that_is_not_there" in capsys.readouterr().err


def test_an_error_of_ours_is_a_message_without_a_traceback(
    mount: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def evaluate() -> None:
        raise DatasetError("queries/a: poses.txt is missing; give a set with truth")

    mount(evaluate=evaluate)
    assert run("evaluate") == 1
    assert capsys.readouterr().err == "streetfix: queries/a: poses.txt is missing; give a set with truth\n"


@pytest.mark.parametrize(
    "error", [FileNotFoundError(2, "No such file", "scans/7.bin"), OSError(28, "No space left on device")]
)
def test_a_system_error_is_a_line_without_traceback(
    error: OSError, mount: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    def evaluate() -> None:
        raise error

    mount(evaluate=evaluate)
    assert run("evaluate") == 1
    told = capsys.readouterr().err
    assert (
        told
        == f"streetfix: {error.filename or 'a file'}: {error.strerror}; check the file, its folder and the disk, and start again\n"
    )


def test_an_error_of_a_package_that_calls_itself_an_os_error_is_seen_whole(mount: Callable[..., None]) -> None:
    def evaluate() -> None:
        raise OSError("a defect")

    mount(evaluate=evaluate)
    with pytest.raises(OSError, match="a defect"):
        run("evaluate")


@pytest.fixture
def service_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """An installation without the package that builds maps, as in the container image."""
    monkeypatch.setattr(command_line, "find_spec", lambda name: None if name == "model_training" else object())


@pytest.mark.parametrize(("command", "extra"), [("simulate", "mapping"), ("train", "training"), ("map", "mapping")])
def test_a_command_beside_the_service_says_where_it_is_to_be_had(
    service_alone: None, capsys: pytest.CaptureFixture[str], command: str, extra: str
) -> None:
    assert run(command, "--help") == 1
    told = capsys.readouterr().err
    assert f"the command '{command}' is not part of this installation, which has only the service" in told
    assert f'pip install ".[{extra}]"' in told


def test_the_service_alone_lists_what_it_has(service_alone: None, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    out = capsys.readouterr().out
    assert all(f"\n  {name} " in out for name in ("serve", "localize", "keys", "health", "bridge"))
    assert not any(f"\n  {name} " in out for name in ("simulate", "train", "map", "demo", "evaluate"))


@pytest.mark.parametrize("package", sorted(command_line._NOT_EVERYWHERE))
def test_a_package_that_is_missing_on_some_platforms_is_reported(
    mount: Callable[..., None], capsys: pytest.CaptureFixture[str], package: str
) -> None:
    def simulate() -> None:
        raise ModuleNotFoundError(f"No module named {package!r}", name=package)

    mount(simulate=simulate)
    assert run("simulate") == 1
    told = capsys.readouterr().err
    assert re.search(rf"needs the package {package!r}: .*pip install.* \(the package is available only for ", told)


def test_packages_missing_on_some_platforms_are_those_with_a_marker() -> None:
    extras = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    marked = {
        re.split(r"[><=;]", each)[0].replace("-", "_") for extra in extras.values() for each in extra if ";" in each
    }
    assert marked == set(command_line._NOT_EVERYWHERE)


def names_of_commands(app: typer.Typer) -> Iterator[list[str]]:
    """Return the names of a command and all its subcommands."""

    def below(command: Any, words: list[str]) -> Iterator[list[str]]:
        yield words
        for name, child in getattr(command, "commands", {}).items():
            yield from below(child, [*words, name])

    return below(typer.main.get_command(app), [])


@pytest.mark.parametrize("called", [None, *sorted(point.name for point in entry_points(group="streetfix.commands"))])
def test_no_help_shows_a_path_of_this_installation(called: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    app = command_line.app_for([] if called is None else [called])
    own = [words for words in names_of_commands(app) if called is None or words[:1] == [called]]
    assert own
    for words in own:
        assert run(*words, "--help") == 0
        page = "".join(capsys.readouterr().out.split())  # a long path is broken into lines
        assert page.startswith("Usage:streetfix")
        assert str(Path(command_line.__file__).parents[2]) not in page, words


@pytest.mark.parametrize(
    ("called", "defaults"),
    [
        ("build-map", ["the stock encoder", "the calibration of the stock encoder"]),
        ("calibrate", ["the stock encoder", "beside the stock encoder"]),
        ("demo", ["the stock encoder"]),
    ],
)
def test_help_names_the_files_of_the_installation_in_words(
    called: str, defaults: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(called, "--help") == 0
    page = " ".join(capsys.readouterr().out.split())
    for default in defaults:
        assert f"[default: {default}]" in page
