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
    dataset: Annotated[Path, typer.Argument(help="Dataset folder.")],
    to: Annotated[str, typer.Option(help="Format: mcap or sqlite3 (ROS 2), bag (ROS 1), or kitti-raw.")],
    out: Annotated[Path, typer.Option(help="File or folder to write.")],
    queries: Annotated[
        str,
        typer.Option(
            help="Query set whose images are written. auto takes the first set with ground truth. '' takes none."
        ),
    ] = "auto",
) -> None:
    """Write a dataset in the format of another tool.

    The command writes the survey first, then the images of a query set.

    \b
    Example:
      streetfix convert data/small --to mcap --out small_mcap    # view it in Foxglove or RViz
      streetfix import rosbag small_mcap --out data/again
    """
    if to not in FORMATS:
        raise DatasetError(f"to: {to!r} is not valid; choose one of: {', '.join(FORMATS)}", field="to")
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
    Console().print(f"{out}: {count} moments, images of: {chosen or 'no query set'}", soft_wrap=True)
