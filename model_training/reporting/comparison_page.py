"""The page of two evaluations over the same queries."""

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import Dataset
from model_training.evaluation.compare import Comparison, p_text
from model_training.evaluation.failures import position_errors, stages
from model_training.evaluation.paired import PairedShares
from model_training.evaluation.saved_run import SavedRun
from model_training.reporting.charts import error_curve, recall_curves
from model_training.reporting.page import Section, figure, page, table, write_page
from model_training.reporting.plan import Plan
from model_training.reporting.queries import Shown, gallery, locate
from model_training.reporting.run_page import PAGE

_SHOWN = 20
#: Error of a query without an answer when changes are sorted, metres.
_FAR_M = 1e6
LABELS = {
    "within_0_5_m": "accepted, within 0.5 m",
    "within_1_m": "accepted, within 1 m",
    "within_5_m": "accepted, within 5 m",
    "forced_within_0_5_m": "forced, within 0.5 m",
    "forced_within_1_m": "forced, within 1 m",
    "recall_at_1_5m": "R@1 at 5 m",
    "recall_at_5_5m": "R@5 at 5 m",
    "recall_at_10_5m": "R@10 at 5 m",
    "localized": "accepted",
    "accepted_but_wrong": "accepted, wrong",
}


def write_comparison_page(
    folder: Path, first: SavedRun, second: SavedRun, found: Comparison, *, dataset: Dataset | None, plan: Plan | None
) -> Path:
    """Write ``index.html`` and return its path; images need the dataset, and maps need the plan.

    Args:
        folder: folder of the page.
        first: evaluation A.
        second: evaluation B.
        found: comparison of both.
        dataset: dataset of the queries; None if absent.
        plan: the map from above; None if absent.
    """
    sections = [
        Section("shares", "Shares", _shares(found)),
        Section("errors", "Errors", _errors(found)),
        Section("curves", "Curves", f'<div class="pair">{_curves(found)}</div>'),
        Section("lost", f"Lost: {len(found.lost)}", _changed(found.lost, first, found, dataset, plan)),
        Section(
            "gained",
            f"Gained: {len(found.gained)}",
            _changed(found.gained, first, found, dataset, plan, has_plan=bool(found.lost)),
        ),
    ]
    title = f"{first.settings.dataset.name}: A against B"
    path = folder / PAGE
    write_page(path, page(title, _lead(first, second, found), sections))
    return path


def _curves(found: Comparison) -> str:
    runs = {"A": found.first, "B": found.second}
    curve = figure(error_curve(runs), "Share of all queries whose answer, accepted or not, lies within a distance.")
    return curve + figure(
        recall_curves(runs), "Share of queries with the right place among the first k neighbours, verified ones first."
    )


def _lead(first: SavedRun, second: SavedRun, found: Comparison) -> str:
    lines = "".join(f"<br>{name}: {escape(_run(run))}" for name, run in (("A", first), ("B", second)))
    asked = f"{len(found.first.T_true)} queries, sent to both."
    return f'<p class="verdict">{escape(found.verdict)}</p><p class="soft">{asked}{lines}</p>'


def _run(run: SavedRun) -> str:
    settings = run.settings
    made = f"streetfix {settings.streetfix}" + (f", commit {settings.commit[:10]}" if settings.commit else "")
    asked = "registered" if settings.registered else "retrieval alone"
    asked_of = f"map {settings.map.name} version {settings.map.version}"
    return (
        f"{run.folder.name}, {asked_of}, {settings.described()}, {asked}, {made}, {settings.made_at:%Y-%m-%d %H:%M} UTC"
    )


def row_of(label: str, each: PairedShares) -> list[str]:
    """Return the cells of a measure: A, B, difference, interval, queries that only A and only B have, and p.

    Args:
        label: name of the measure, HTML.
        each: paired shares of the measure.
    """
    low, high = each.interval
    return [
        label,
        f"{each.first:.1%}",
        f"{each.second:.1%}",
        f"{100 * each.difference:+.1f}",
        f"{100 * low:+.1f} to {100 * high:+.1f}",
        str(each.only_first),
        str(each.only_second),
        p_text(each.p),
    ]


HEAD = ("", "A", "B", "B - A", "95 % interval", "only A", "only B", "p")


def _shares(found: Comparison) -> str:
    whole = table(
        "Paired differences in percentage points over all queries: Newcombe's interval (method 10), McNemar's exact "
        "p. Forced: whatever the status. With many measures some differ by chance: without any true difference, one "
        "in twenty has p below 0.05.",
        HEAD,
        [row_of(escape(LABELS[name]), each) for name, each in found.shares.items()],
    )
    if len(found.sets) == 1:
        return whole
    return whole + table(
        "Within 1 m and accepted, by query set.",
        HEAD,
        [row_of(escape(name), each) for name, each in found.sets.items()],
    )


def _errors(found: Comparison) -> str:
    each = found.errors
    if each is None:
        return "<p>There is no query that both runs answered.</p>"
    rows = [
        ["median of the differences", f"{each.median_difference_m:+.3f} m", _metres(each.median_interval_m)],
        ["mean of the differences", f"{each.mean_difference_m:+.3f} m", _metres(each.mean_interval_m)],
    ]
    return table(
        f"Errors of B less those of A, over the {each.count} queries that both answered, accepted or not "
        f"(median of A {each.first_median_m:.3f} m, of B {each.second_median_m:.3f} m); intervals by paired bootstrap. "
        f"Wilcoxon's signed-rank p {p_text(each.p)}.",
        ("", "B - A", "95 % interval"),
        rows,
    )


def _metres(interval: tuple[float, float]) -> str:
    return "{:+.3f} to {:+.3f} m".format(*interval)


def _changed(
    rows: Sequence[int],
    first: SavedRun,
    found: Comparison,
    dataset: Dataset | None,
    plan: Plan | None,
    *,
    has_plan: bool = False,
) -> str:
    if not rows:
        return "<p>None.</p>"
    became = stages(found.first), stages(found.second)
    errors = position_errors(found.first), position_errors(found.second)
    by_change = sorted(
        rows, key=lambda row: -abs(np.nan_to_num(errors[1][row] - errors[0][row], nan=0.0, posinf=1e9, neginf=-1e9))
    )
    shown = []
    for name, number, row in locate(by_change[:_SHOWN], first.predictions, first_image=first.settings.mode.frames - 1):
        statuses = "".join(
            f'<br>{run}: <span class="tag">{escape(became[k][row])}</span> {_off(errors[k][row])}'
            for k, run in enumerate(("A", "B"))
        )
        shown.append(Shown(name, number, row, f"<p>{statuses.removeprefix('<br>')}</p>"))
    more = f"<p>The page shows the {_SHOWN} queries that changed most.</p>" if len(rows) > _SHOWN else ""
    legend = (
        ""
        if plan is None
        else (
            "<p>Circle: the true position. Red cross: the answer of A. Blue cross: the answer of B. Dots: candidate "
            "places and poses of A.</p>"
        )
    )
    return more + legend + gallery(shown, found.first, dataset, plan, other=found.second, has_plan=has_plan)


def _off(error_m: float) -> str:
    return f"{error_m:.2f} m off" if np.isfinite(error_m) else "no answer"
