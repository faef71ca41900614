"""The console script, with and without the packages of the command line."""

import re
import sys
import tomllib
from importlib.abc import MetaPathFinder
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from service.cli import start
from service.cli.extras import EXTRA_OF_PACKAGE


class Hidden(MetaPathFinder):
    """Hides one package, as if it were not installed."""

    def __init__(self, package: str) -> None:
        self.package = package

    def find_spec(self, name: str, *_: object) -> None:
        if name == self.package:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def hide(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name == "service.cli.main" or name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [Hidden(package), *sys.meta_path])


def test_it_runs_the_command_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["streetfix", "--version"])
    with pytest.raises(SystemExit) as end:
        start.main()
    assert not end.value.code
    assert capsys.readouterr().out.startswith("streetfix ")


def test_without_the_packages_of_the_server_it_prints_one_line_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    hide("typer", monkeypatch)
    with pytest.raises(SystemExit) as end:
        start.main()
    assert str(end.value.code).startswith("streetfix: the command line needs the package 'typer'")
    assert str(end.value.code).endswith('pip install ".[server]"')


def test_a_defect_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXTRA_OF_PACKAGE, "typer", "")
    hide("typer", monkeypatch)
    with pytest.raises(ModuleNotFoundError, match="typer"):
        start.main()


def test_every_package_of_the_server_is_known() -> None:
    extras = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    needs = [each for extra in ("server", "grpc", "lz4") for each in extras[extra] if not each.startswith("streetfix[")]
    named = {re.split(r"[><=;\[]", each)[0].replace("_", "-") for each in needs}
    of_distribution: dict[str, set[str]] = {}
    for module, distributions in packages_distributions().items():
        for each in distributions:
            of_distribution.setdefault(each.lower().replace("_", "-"), set()).add(module)
    modules = {frozenset(of_distribution[name]) for name in named}
    known = {package for package, extra in EXTRA_OF_PACKAGE.items() if extra == "server"}
    assert [each for each in modules if not each & known] == []


@pytest.mark.parametrize("where", ["imports", "command"])
def test_ctrl_c_ends_it_without_a_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], where: str
) -> None:
    class Interrupted(MetaPathFinder):
        def find_spec(self, name: str, *_: object) -> None:
            if name == "service.cli.main":
                raise KeyboardInterrupt

    def stop() -> None:
        raise KeyboardInterrupt

    if where == "imports":
        monkeypatch.delitem(sys.modules, "service.cli.main", raising=False)
        monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    else:
        monkeypatch.setattr("service.cli.main.main", stop)
    with pytest.raises(SystemExit) as end:
        start.main()
    assert end.value.code == 130
    assert capsys.readouterr() == ("", "")
