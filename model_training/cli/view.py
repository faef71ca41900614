"""``streetfix view``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.viewing.mcap_file import write_mcap
from model_training.viewing.rerun_file import write_rerun
from model_training.viewing.source import events_of


def command(
    source: Annotated[Path, typer.Argument(help="Dataset, map bundle or folder of `evaluate --report`.")],
    save: Annotated[Path | None, typer.Option(help="Write a file for Rerun instead of starting its viewer.")] = None,
    mcap: Annotated[Path | None, typer.Option(help="Write an MCAP file for Foxglove or Lichtblick instead.")] = None,
    scans: Annotated[int, typer.Option(help="Largest number of survey scans to show.", min=1)] = 200,
    points: Annotated[int, typer.Option(help="Largest number of points to show of a cloud.", min=1)] = 200_000,
) -> None:
    """Show a dataset, a map or answers in Rerun, Foxglove or Lichtblick.

    The viewer shows clouds, tracks, cameras with their images, and 2.5D images. For answers it also shows the places
    that retrieval found, and the poses of the answers.

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
