"""``streetfix compare``."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from model_training.datasets.dataset import Dataset
from model_training.evaluation.compare import Comparison, compare, p_text
from model_training.evaluation.saved_run import SavedRun
from model_training.reporting.comparison_page import HEAD, LABELS, row_of, write_comparison_page
from model_training.reporting.plan import Plan
from service.errors import BundleError, DatasetError
from service.maps.tiles import open_map


def command(
    first: Annotated[
        Path, typer.Argument(metavar="A", help="Folder of `evaluate --report`. This run is the reference.")
    ],
    second: Annotated[Path, typer.Argument(metavar="B", help="Folder of `evaluate --report` over the same queries.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for a report page with the images of the changed queries.")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON file for all figures.")] = None,
    dataset: Annotated[
        Path | None, typer.Option(help="Dataset with the query images.  [default: the dataset of A]")
    ] = None,
) -> None:
    """Compare two runs over the same queries.

    The command reports paired differences with intervals. It also lists the queries whose outcome changed.

    \b
    Example:
      streetfix compare reports/before reports/after --out reports/difference
    """
    a, b = SavedRun.open(first), SavedRun.open(second)
    found, console = compare(a, b), Console(soft_wrap=True)
    if json_file is not None:
        json_file.parent.mkdir(parents=True, exist_ok=True)
        part = json_file.with_name(json_file.name + ".part")
        part.write_text(json.dumps(found.as_json(), indent=1) + "\n")
        part.rename(json_file)
    for name, mode in zip("AB", found.modes, strict=True):
        console.print(f"{name}: {mode}", highlight=False)
    Console().print(_table(found))
    console.print(_errors(found), highlight=False)
    console.print(found.verdict, highlight=False)
    if out is not None:
        page = write_comparison_page(
            out, a, b, found, dataset=_dataset(a, dataset, console), plan=_plan((b, a), console)
        )
        console.print(f"report: {page}")


def _table(found: Comparison) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0))
    for k, name in enumerate(HEAD):
        table.add_column(name, justify="left" if k == 0 else "right", no_wrap=True)
    for name, each in found.shares.items():
        table.add_row(*row_of(LABELS[name], each))
    if len(found.sets) > 1:
        table.add_section()
        table.add_row("by set, 1 m:")
        for name, each in found.sets.items():
            table.add_row(*row_of(name, each))
    return table


def _errors(found: Comparison) -> str:
    each = found.errors
    if each is None:
        return "forced errors: there is no query that both runs answered"
    low, high = each.median_interval_m
    return (
        f"forced errors, whatever the status, of {each.count} queries: median {each.first_median_m:.3f} m of A, "
        f"{each.second_median_m:.3f} m of B, "
        f"median difference {each.median_difference_m:+.3f} m (95 % interval {low:+.3f} to {high:+.3f}; Wilcoxon's p {p_text(each.p)})"
    )


def _dataset(run: SavedRun, given: Path | None, console: Console) -> Dataset | None:
    """Open the dataset with the images if it exists; a folder that the user named must be a dataset."""
    if given is not None:
        return Dataset(given)
    try:
        return Dataset(Path(run.settings.dataset.path))
    except DatasetError as error:
        console.print(f"the page has no images: {error.message}", highlight=False)
        return None


def _plan(runs: tuple[SavedRun, ...], console: Console) -> Plan | None:
    """Open the map of one of the runs if it exists."""
    for run in runs:
        try:
            return Plan.of(open_map(Path(run.settings.map.path), verify=False))
        except BundleError as error:
            why = error.message
    console.print(f"the page has no map: {why}", highlight=False)
    return None
