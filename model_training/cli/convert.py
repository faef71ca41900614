"""``streetfix convert``."""

from pathlib import Path
from typing import Annotated, cast

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset
from service.errors import DatasetError

FORMATS = ("mcap", "sqlite3", "bag", "kitti-raw")


def command(
    dataset: Annotated[Path, typer.Argument(help="dataset folder")],
    to: Annotated[str, typer.Option(help="mcap or sqlite3 (ROS 2), bag (ROS 1), kitti-raw")],
    out: Annotated[Path, typer.Option(help="file or folder to write")],
    queries: Annotated[
        str, typer.Option(help="query set whose pictures go in [default: the first with truth; '' for none]")
    ] = "auto",
) -> None:
    """Write a dataset in another tool's format: survey first, then the pictures of a query set.

    \b
    Example:
      streetfix convert data/small --to mcap --out small_mcap    # look at it in Foxglove or RViz
      streetfix import rosbag small_mcap --out data/again
    """
    if to not in FORMATS:
        raise DatasetError(f"to: {to!r} is not known; there is: {', '.join(FORMATS)}", field="to")
    opened = Dataset(dataset)
    sets = opened.query_sets(with_truth=True)
    chosen = (sets[0] if sets else None) if queries == "auto" else (queries or None)
    with bars() as report:
        if to == "kitti-raw":
            from model_training.exporting.kitti_raw import write_kitti_raw

            count = write_kitti_raw(opened, chosen, out, report=lambda done, of: report("moments", done, of))
        else:
            from model_training.exporting.ros_bag import BagFormat, write_bag

            kind = cast(BagFormat, to)
            count = write_bag(opened, chosen, out, kind=kind, report=lambda done, of: report("moments", done, of))
    Console().print(f"{out}: {count} moments, pictures of: {chosen or 'no query set'}", soft_wrap=True)
