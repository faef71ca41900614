"""The page of one evaluation: errors, confidence, the map, and the losses by stage."""

from collections import Counter
from html import escape
from pathlib import Path
from typing import Any

from model_training.datasets.dataset import Dataset
from model_training.evaluation.failures import WHY, Stage, position_errors, stages, worst
from model_training.evaluation.measures import label_of
from model_training.evaluation.predict import Predictions, joined
from model_training.evaluation.saved_run import SavedRun
from model_training.evaluation.why_refused import FEW, NO_CAUSE
from model_training.reporting.charts import (
    error_curve,
    error_histogram,
    recall_curves,
    reliability,
    series_of,
    side_by_side,
)
from model_training.reporting.page import Section, figure, page, table, write_page
from model_training.reporting.plan import ERRORS, Plan
from model_training.reporting.queries import Shown, gallery, locate, said_of
from service.maps.map import Map

PAGE = "index.html"
WORST = 20
_SHARES = (
    ("localized", "answered"),
    ("within_0_5_m", "within 0.5 m"),
    ("within_1_m", "within 1 m"),
    ("within_5_m", "within 5 m"),
    ("street_accuracy", "street right"),
    ("recall_at_1_5m", "R@1 at 5 m"),
    ("recall_at_5_5m", "R@5 at 5 m"),
    ("recall_at_10_5m", "R@10 at 5 m"),
)
_NUMBERS = (
    ("median_distance_error_m", "median error", "{:.2f} m"),
    ("mean_distance_error_m", "mean error", "{:.2f} m"),
    ("p95_distance_error_m", "95th percentile", "{:.2f} m"),
    ("median_heading_error_deg", "median heading error", "{:.2f}°"),
    ("ms_per_query", "time per query", "{:.0f} ms"),
)


def write_run_page(run: SavedRun, bundle: Map, dataset: Dataset, figures: dict[str, Any]) -> Path:
    """Write ``index.html`` beside the saved answers and return its path.

    Args:
        run: saved evaluation.
        bundle: the map that answered.
        dataset: dataset of the queries.
        figures: figures of the evaluation.
    """
    everything = joined(list(run.predictions.values()))
    plan = Plan.of(bundle)
    sections = [
        Section("figures", "Figures", _figures(figures)),
        Section("errors", "Errors", _errors(run.predictions, everything)),
        Section("search", "Search and confidence", _search(run.predictions, everything)),
        Section("map", "The map, coloured by error", _map(plan, everything)),
        Section("lost", "Losses by stage", _lost(everything)),
    ]
    if causes := causes_of(figures):
        sections.insert(1, Section("causes", "What to check", causes))
    if len(run.predictions) > 1:
        sections.insert(1, Section("conditions", "Conditions", _conditions(run, figures)))
    if figures.get("confusion"):
        sections.append(Section("streets", "Streets", _confusion(figures["confusion"])))
    sections.append(Section("worst", "The worst queries", _worst(run, everything, dataset, plan)))
    path = run.folder / PAGE
    write_page(path, page(f"{run.settings.dataset.name} on map {run.settings.map.name}", _lead(run, figures), sections))
    return path


def _lead(run: SavedRun, figures: dict[str, Any]) -> str:
    settings = run.settings
    low, high = figures["ci95"]["within_1_m"]
    made = f"streetfix {settings.streetfix}" + (f", commit {settings.commit[:10]}" if settings.commit else "")
    return (
        f'<p class="verdict">{figures["queries"]} queries: {figures["within_1_m"]:.1%} were accepted and lie within 1 m of the truth '
        f"(95 % interval {low:.1%} to {high:.1%}); {figures['localized']:.1%} were accepted at all.</p>"
        f'<p class="soft">Map {escape(settings.map.name)}, version {escape(settings.map.version)}; dataset '
        f"{escape(settings.dataset.name)}; "
        f"{escape(settings.described())}; "
        f"{'registered on the cloud' if settings.registered else 'retrieval alone'}; {escape(made)}; "
        f"{settings.made_at:%Y-%m-%d %H:%M} UTC.</p>"
    )


def _figures(figures: dict[str, Any]) -> str:
    columns = _columns(figures)
    rows = [
        [
            escape(label_of(key, label, registered=figures["registered"])),
            *(_share(values, key) for values in columns.values()),
        ]
        for key, label in _SHARES
        if figures.get(key) is not None
    ]
    rows += [
        [escape(label), *("-" if values.get(key) is None else form.format(values[key]) for values in columns.values())]
        for key, label, form in _NUMBERS
    ]
    head = [
        "",
        *(
            f'{escape(name)}<span class="ci">{values["queries"]} queries, {escape(values["split"].replace("_", " "))}</span>'
            for name, values in columns.items()
        ),
    ]
    caption = (
        "Shares are over all queries, with 95 % intervals; a query without an answer counts as wrong. Distances are "
        "over accepted answers."
    )
    return table(caption, head, rows)


def _columns(figures: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return figures["sets"] if len(figures["sets"]) == 1 else {"all": figures, **figures["sets"]}


def _share(values: dict[str, Any], key: str) -> str:
    if values.get(key) is None:
        return "-"
    low, high = values["ci95"][key]
    return f'{values[key]:.1%}<span class="ci">{low:.1%} to {high:.1%}</span>'


def _conditions(run: SavedRun, figures: dict[str, Any]) -> str:
    sets = figures["sets"]
    recall = label_of("recall_at_1_5m", "R@1 at 5 m", registered=figures["registered"])
    rows = [
        [
            f"{k}. {escape(each.name)}",
            escape(each.condition or "not known"),
            escape(each.split.replace("_", " ")),
            *(_share(sets[each.name], key) for key in ("localized", "within_1_m", "recall_at_1_5m")),
        ]
        for k, each in enumerate(run.settings.sets, 1)
    ]
    drawn = [
        figure(
            side_by_side({name: (values[key], *values["ci95"][key]) for name, values in sets.items()}, label),
            f"{label}, with 95 % intervals.",
        )
        for key, label in (("within_1_m", "within 1 m"), ("recall_at_1_5m", recall))
    ]
    return table(
        "Each query set with weather and light, and how its queries relate to the survey.",
        ["set", "condition", "split", "answered", "within 1 m", recall],
        rows,
    ) + _pair(drawn)


def causes_of(figures: dict[str, Any]) -> str:
    """Return the possible causes of each set as HTML, the likeliest first; empty if nothing is to be checked.

    Args:
        figures: figures of the evaluation, with the causes that ``streetfix evaluate`` adds for a calibrated map.
    """
    parts = []
    for name, values in figures["sets"].items():
        found = values.get("causes")
        if found is None or (values["localized"] >= FEW and not found):
            continue
        listed = "".join(f"<li>{escape(each['what'])}: {escape(each['check'])}</li>" for each in found)
        told = f"<ol>{listed}</ol>" if found else f"<p>{NO_CAUSE}</p>"
        parts.append(
            f"<p>{escape(name)}: {values['localized']:.0%} of the answers were accepted. The likeliest cause first.</p>{told}"
        )
    return "".join(parts)


def _errors(runs: dict[str, Predictions], everything: Predictions) -> str:
    curve = figure(
        error_curve(series_of(runs)), "Share of all queries whose answer, accepted or not, lies within a distance."
    )
    bars = figure(
        error_histogram(everything),
        "Answers by their distance from the truth; the last bar counts all larger distances.",
    )
    return _pair([curve, bars])


def _pair(figures: list[str]) -> str:
    return f'<div class="pair">{"".join(figures)}</div>'


def _search(runs: dict[str, Predictions], everything: Predictions) -> str:
    parts = [
        figure(
            recall_curves(series_of(runs)),
            "Share of queries with a place within 5 m of the truth among the first k neighbours, verified ones first.",
        )
    ]
    drawn = reliability(everything)
    if drawn is not None:
        words = (
            "Share of answers within 1 m by confidence, with 95 % intervals. On the dashed line the confidence equals "
            f"the share. Expected calibration error {drawn[1]:.3f}."
        )
        parts.append(figure(drawn[0], words))
    note = (
        ""
        if drawn is not None
        else "<p>Answers of this run have no confidence: the map is not calibrated, or nothing was registered.</p>"
    )
    return _pair(parts) + note


def _map(plan: Plan, everything: Predictions) -> str:
    legend = "".join(f'<li><i class="key {name}"></i>{label}</li>' for _, name, label in ERRORS)
    words = (
        "Walls from above, each query at its true position. Crosses are more than 5 m off or have no answer; dashed "
        "lines lead to the estimated positions."
    )
    return figure(plan.whole(everything) + f'<ul class="legend">{legend}</ul>', words)


def _lost(everything: Predictions) -> str:
    counts = Counter(stages(everything))
    total = len(everything.T_true)
    rows = [
        [escape(stage), str(counts[stage]), f"{counts[stage] / total:.1%}", escape(WHY[stage])]
        for stage in Stage
        if counts[stage]
    ]
    return table("Every query counts once.", ["outcome", "queries", "share", "meaning"], rows, kind="last-told")


def _confusion(confusion: dict[str, Any]) -> str:
    names, matrix = confusion["classes"], confusion["matrix"]
    head = "".join(f'<th scope="col" title="{escape(name)}">{k}</th>' for k, name in enumerate(names, 1))
    body = []
    for number, (name, row) in enumerate(zip(names, matrix, strict=True)):
        if not sum(row):
            continue
        cells = "".join(
            f'<td{"" if column == number else " class=wrong"} style="--share:{count / sum(row):.2f}">{count}</td>'
            if count
            else "<td></td>"
            for column, count in enumerate(row)
        )
        body.append(f'<tr><th scope="row">{escape(name)} ({number + 1})</th>{cells}</tr>')
    return (
        '<div class="scroll"><table class="confusion"><caption>Rows are true streets, columns are answered streets, by number. The last '
        "column counts answers without a street, and answers that were not accepted. Streets without queries are left out.</caption>"
        f'<thead><tr><th class="text">true street</th>{head}<th scope="col">none</th></tr></thead>'
        f"<tbody>{''.join(body)}</tbody></table></div>"
    )


def _worst(run: SavedRun, everything: Predictions, dataset: Dataset, plan: Plan) -> str:
    became, errors = stages(everything), position_errors(everything)
    shown = [
        Shown(name, number, row, said_of(everything, row, became[row], errors[row]))
        for name, number, row in locate(
            worst(everything, WORST), run.predictions, first_image=run.settings.mode.frames - 1
        )
    ]
    words = (
        "<p>Accepted wrong answers come first, then the others by distance. On the small maps the circle is the true "
        "position, the cross is the answer, and dots are candidate places and poses.</p>"
    )
    return words + gallery(shown, everything, dataset, plan, has_plan=True)
