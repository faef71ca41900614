"""Print answers one by one, each error with its status and confidence."""

import math

from rich.console import Console
from rich.table import Table

from model_training.evaluation.error_measures import heading_errors_deg
from model_training.evaluation.failures import position_errors, worst
from model_training.evaluation.predict import Predictions, headings_of


def print_queries(name: str, answers: Predictions, console: Console, *, most: int, first_image: int = 0) -> None:
    """Print the worst answers of a query set: accepted and wrong first, then the others by distance.

    Args:
        name: name of the query set.
        answers: answers to all of its queries.
        console: destination.
        most: largest number of rows; 0 prints nothing.
        first_image: number of the image whose pose the first query asks for.
    """
    if most == 0:
        return
    rows = worst(answers, most)
    which = (
        f"all {len(rows)} queries"
        if len(rows) == len(answers.T_true)
        else f"the {len(rows)} worst of {len(answers.T_true)} queries"
    )
    table = Table(box=None, padding=(0, 1, 0, 0), title=f"{name}: {which}", title_justify="left")
    for head in ("query", "status", "confidence"):
        table.add_column(head)
    for head in ("forced error", "heading error"):
        table.add_column(head, justify="right")
    errors = position_errors(answers)
    turned = heading_errors_deg(headings_of(answers.T_answer), headings_of(answers.T_true))
    for row in rows:
        confidence = answers.confidence[row]
        table.add_row(
            str(row + first_image),
            str(answers.status[row]) or "refused",
            f"{confidence:.3f}" if math.isfinite(confidence) else "-",
            f"{errors[row]:.2f} m" if math.isfinite(errors[row]) else "-",
            f"{turned[row]:.0f}°" if math.isfinite(turned[row]) else "-",
        )
    console.print(table)
