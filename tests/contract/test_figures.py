"""Figures that documents, help texts and contracts tell are those of the code and of the reports."""

import re
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from benchmarks import figures
from benchmarks.figures import CODE, documents, figure, with_figures, without_figures
from service.cli.main import app_for
from service.option_limits import FALSE_ACCEPT_RATE
from service.runtime.settings import Settings

ROOT = Path(__file__).parents[2]
#: All texts that may tell such a figure beside the documents; the decision log and the changelog tell what was.
OTHERS = [
    ROOT / "openapi" / "openapi.json",
    *sorted((ROOT / "proto").rglob("*.proto")),
    *(
        path
        for path in sorted((ROOT / "deploy").rglob("*"))
        if path.suffix in (".yaml", ".yml", ".md", ".txt", ".toml")
    ),
]
PAGES = documents()
NUMBER = r"(?:\d[\d.,]*|two|three|four|five|six|ten)"
#: What a document must not type: how fast the service is, and how often it errs by default.
TYPED = {
    "throughput": rf"{NUMBER} (?:full )?(?:answers|requests|queries) (?:a|per) second(?! that)|{NUMBER} a second with (?:one|two)",
    "false-accept rate": rf"{NUMBER} in (?:a|one|\d+) ?hundred|{NUMBER} % by default|{NUMBER} in 100\b",
    "what LOCALIZED promises": r"as likely right as not|right in (?:one|two|three) of",
}


@pytest.mark.parametrize("page", documents(), ids=lambda page: page.name)
def test_marked_figures_are_up_to_date(page: Path) -> None:
    text = page.read_text()
    assert with_figures(text) == text, "run `make reports`"
    assert text.count("<!-- figure: ") == text.count("<!-- /figure -->") == len(figures._FIGURE.findall(text))


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: page.name)
def test_no_such_figure_is_typed(page: Path) -> None:
    text = " ".join(without_figures(page.read_text()).split())
    for what, pattern in TYPED.items():
        found = re.search(pattern, text)
        assert found is None, f"{what}: take it from a report or the code (benchmarks/figures.py): {found}"


def test_no_help_text_tells_another_default_than_the_settings_have() -> None:
    checked = 0
    commands: Any = get_command(app_for(["serve"]))  # a group of commands
    for option in commands.commands["serve"].params:
        told = re.search(r"\[default: ([^\]]+)\]", getattr(option, "help", None) or "")
        default = Settings.model_fields[option.name].default if option.name in Settings.model_fields else None
        if told and default is not None:
            assert type(default)(told[1]) == default, option.name
            checked += 1
    assert checked >= 5


@pytest.mark.parametrize("page", [*PAGES, *OTHERS], ids=lambda page: page.name)
def test_a_default_false_accept_rate_is_the_codes(page: Path) -> None:
    text = " ".join(page.read_text().split())
    for found in re.findall(r"(?i)false.accept.rate\W{1,20}default\W{1,4}(?:is |of )?(0?\.\d+)", text):
        assert float(found) == FALSE_ACCEPT_RATE


def test_what_is_typed_is_found() -> None:
    """Texts that once stood in the documents."""
    for text in (
        "no more than three in a hundred queries taken outside the map",
        "The default lets 2 in 100 strangers through",
        "2 % by default",
        "One core answers about 29 full requests a second",
        "25 requests per second",
        "36 a second with two threads",
        "an answer is about as likely right as not",
        "is right in one of six cases",
    ):
        assert any(re.search(pattern, text) for pattern in TYPED.values()), text


def test_figures_take_their_value_from_reports_and_code(tmp_path, monkeypatch) -> None:
    (tmp_path / "speed.json").write_text(
        '{"rows": [{"id": "a.b", "value": 40.6, "n": 7}, {"id": "none", "value": null}]}'
    )
    monkeypatch.setattr(figures, "REPORTS", tmp_path)
    monkeypatch.setitem(CODE, "rate", lambda: 0.025)
    text = "x <!-- figure: speed a.b .0f -->?<!-- /figure --> y <!-- figure: code rate .1% -->0<!-- /figure -->"
    assert with_figures(text) == (
        "x <!-- figure: speed a.b .0f -->41<!-- /figure --> y <!-- figure: code rate .1% -->2.5 %<!-- /figure -->"
    )
    assert without_figures(text) == "x  y "
    assert figure("speed", "a.b#n", ".0f") == "7"
    for source, name in (("speed", "c"), ("speed", "none"), ("speed", "none#n"), ("slow", "a.b"), ("code", "c")):
        with pytest.raises(ValueError, match="figure: "):
            figure(source, name, ".0f")
