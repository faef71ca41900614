"""Insert figures of reports, or of the code, into documents.

A document marks such a figure by comments, which Markdown does not show::

    <!-- figure: serving full.answers_per_s .0f -->41<!-- /figure -->
    <!-- figure: code false_accept_rate .0% -->2 %<!-- /figure -->

The first word is a report or ``code``. The second is the id of a row or a name of ``CODE``; ``ROW#n`` is the number of samples of a row.
The third is a format of Python; a percentage gets a space. ``make reports`` writes the figures again. A test fails if one is out of date.
"""

import json
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks.country import country_figures
from benchmarks.provenance import ROOT
from model_training.calibration.bounds import WRONG_RATE, trials_needed
from model_training.stock import CALIBRATION
from service.maps.calibration import Calibration, read_calibration
from service.option_limits import FALSE_ACCEPT_RATE, LEAST_CONFIDENCE, SAFE_CONFIDENCE
from service.scoring.support import SupportWeights

REPORTS = ROOT / "reports"
_FIGURE = re.compile(r"(<!-- figure: (\S+) (\S+) (\S+) -->)(.*?)(<!-- /figure -->)", re.DOTALL)


def stock_calibration() -> Calibration:
    """Return the calibration of the stock encoder.

    Raises:
        ValueError: the stock encoder has no calibration.
    """
    calibration = read_calibration(CALIBRATION.read_bytes(), path=str(CALIBRATION))
    if calibration is None:
        raise ValueError(f"{CALIBRATION}: the stock encoder has no calibration")
    return calibration


def row_of(report: str, name: str) -> float:
    """Return a figure of a report.

    Args:
        report: name of the report.
        name: id of a row, or ``ROW#n``.

    Raises:
        ValueError: there is no such report or row, or the row has no value.
    """
    path = REPORTS / f"{report}.json"
    if not path.exists():
        raise ValueError(f"figure: {report}: report not found; use one of reports/*.json, or code")
    rows = json.loads(path.read_text())["rows"]
    values = {row["id"]: row["value"] for row in rows} | {f"{row['id']}#n": row.get("n") for row in rows}
    value: float | None = values.get(name)
    if value is None:
        raise ValueError(f"figure: {report} {name}: the report has no such row, or the row has no value")
    return value


def _of_country(name: str) -> float:
    return country_figures(row_of)[name]


#: Figures that documents may take from the code. Those of ``country`` are computed from rows of the reports.
CODE: dict[str, Callable[[], float]] = {
    "false_accept_rate": lambda: FALSE_ACCEPT_RATE,
    "safe_confidence": lambda: SAFE_CONFIDENCE,
    "least_confidence": lambda: LEAST_CONFIDENCE,
    "trials_for_wrong_rate": lambda: float(trials_needed(WRONG_RATE)),
    "localized_from_confidence_at_0_02": lambda: stock_calibration().threshold(0.02),
    "wrong_rate": lambda: WRONG_RATE,
    "structure_gap": lambda: SupportWeights().structure_gap,
    "rays_most": lambda: SupportWeights().rays_most,
    "least_false_accept_rate": lambda: stock_calibration().least_false_accept_rate,
    "localized_from_confidence": lambda: stock_calibration().threshold(FALSE_ACCEPT_RATE),
    **{f"country.{name}": partial(_of_country, name) for name in country_figures(lambda *_: 1.0)},
}


def documents() -> list[Path]:
    """Return README, the pages of ``docs``, and the model card."""
    return [
        ROOT / "README.md",
        *sorted((ROOT / "docs").glob("*.md")),
        ROOT / "model_training" / "stock" / "MODEL_CARD.md",
    ]


def figure(source: str, name: str, form: str) -> str:
    """Return a figure as a document shows it.

    Args:
        source: name of a report, or ``code``.
        name: id of a row, ``ROW#n``, or name in ``CODE``.
        form: format specification of Python.

    Raises:
        ValueError: there is no such report, row or name, or the row has no value.
    """
    if source == "code":
        if name not in CODE:
            raise ValueError(f"figure: {name}: unknown figure; choose one of: {', '.join(CODE)}")
        value = CODE[name]()
    else:
        value = row_of(source, name)
    shown = format(value, form)
    return shown.replace("%", " %") if form.endswith("%") else shown


def with_figures(text: str) -> str:
    """Return a document with all marked figures up to date.

    Args:
        text: the document.

    Raises:
        ValueError: the source of a figure does not exist.
    """
    return _FIGURE.sub(lambda found: found[1] + figure(found[2], found[3], found[4]) + found[6], text)


def without_figures(text: str) -> str:
    """Return a document without its marked figures, so only hand-written ones remain.

    Args:
        text: the document.
    """
    return _FIGURE.sub("", text)


def write_figures() -> list[Path]:
    """Update all documents; return those that changed."""
    changed = []
    for page in documents():
        text = page.read_text()
        if (new := with_figures(text)) != text:
            page.write_text(new)
            changed.append(page)
    return changed
