"""Print a table that compares queries with their ground truth, stage by stage."""

import math

from rich.console import Console
from rich.table import Table

from model_training.evaluation.stages import MEANING, QueryStages, lost_by_stage

_HEAD = (
    "query",
    "tilt",
    "height",
    "place rank",
    "start",
    "candidate",
    "from truth",
    "inliers at truth",
    "error",
    "heading",
    "status",
    "confidence",
    "lost by",
)
#: Columns that a row takes.
WIDTH = 120


def print_stages(name: str, found: list[QueryStages], console: Console) -> None:
    """Print one row per query, then how many queries each stage lost.

    Args:
        name: name of the query set.
        found: its queries.
        console: destination.
    """
    table = Table(box=None, padding=(0, 1, 0, 0), title=f"{name}: each stage against the truth", title_justify="left")
    for k, head in enumerate(_HEAD):
        table.add_column(head, justify="left" if k >= len(_HEAD) - 3 else "right", overflow="fold")
    for each in found:
        table.add_row(*_row(each))
    # In a file or a pipe no line need be cut: words broken at 80 columns cannot be read.
    Console(file=console.file, width=None if console.is_terminal else max(console.width, WIDTH)).print(table)
    for stage, count in lost_by_stage(found).items():
        if count:
            label = "right" if stage == "-" else f"lost by {stage}"
            console.print(f"  {count:4d} of {len(found)} {label}: {MEANING[stage]}", highlight=False, soft_wrap=True)


def _row(each: QueryStages) -> tuple[str, ...]:
    return (
        str(each.number),
        _number(each.tilt_deg, "{:.1f}°"),
        _number(each.height_error_m, "{:+.2f} m"),
        str(each.rank or "-"),
        *(_number(x, "{:.2f} m") for x in (each.start_m, each.candidate_m, each.from_truth_m)),
        f"{_number(each.inliers_at_truth, '{:.2f}')} > {_number(each.inliers_from_truth, '{:.2f}')}",
        _number(each.error_m, "{:.2f} m"),
        _number(each.heading_error_deg, "{:.0f}°"),
        each.status or "refused",
        _number(each.confidence, "{:.3f}"),
        str(each.lost),
    )


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "-"
