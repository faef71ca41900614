"""``streetfix view``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.viewing.mcap_file import write_mcap
from model_training.viewing.rerun_file import write_rerun
from model_training.viewing.source import events_of


def command(
    source: Annotated[Path, typer.Argument(help="a dataset, a map bundle, or a folder of `evaluate --report`")],
    save: Annotated[Path | None, typer.Option(help="write a file for Rerun instead of starting its viewer")] = None,
    mcap: Annotated[Path | None, typer.Option(help="write an MCAP file for Foxglove or Lichtblick instead")] = None,
    scans: Annotated[int, typer.Option(help="scans of a survey that are shown at most", min=1)] = 200,
    points: Annotated[int, typer.Option(help="points that a cloud is shown with at most", min=1)] = 200_000,
) -> None:
    """Look at a dataset, a map or answers: clouds, tracks, cameras with their pictures, 2.5D pictures, what was found and answered.

    \b
    Examples:
      streetfix view reports/paper --save paper.rrd    # then: rerun paper.rrd
      streetfix view data/paper --mcap paper.mcap      # opens in Foxglove or Lichtblick
    """
    console = Console(soft_wrap=True)
    if mcap is not None:
        count = write_mcap(events_of(source, most_scans=scans, most_points=points), mcap)
        console.print(f"{count} events: {mcap}")
    if save is not None or mcap is None:
        count = write_rerun(events_of(source, most_scans=scans, most_points=points), save)
        console.print(f"{count} events: {save or 'in the viewer'}")
