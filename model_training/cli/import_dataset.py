"""``streetfix import``."""

from pathlib import Path
from typing import Annotated, Literal, cast

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.datasets.kitti_object import import_kitti_object
from service.errors import DatasetError

KINDS = ("kitti-object",)
DEPTHS = ("stored", "sgbm")


def command(
    kind: Annotated[str, typer.Argument(help="layout of the recording: kitti-object")],
    source: Annotated[Path, typer.Argument(help="folder of the recording")],
    out: Annotated[Path, typer.Option(help="folder to write the dataset to")],
    depth: Annotated[
        str, typer.Option(help="stored: the depth that lies beside; sgbm: from the stereo pair by OpenCV")
    ] = "sgbm",
) -> None:
    """Turn somebody else's recording into a dataset folder.

    \b
    Example:
      streetfix import kitti-object KITTI --depth sgbm --out data/kitti
    """
    if kind not in KINDS:
        raise DatasetError(f"kind: {kind!r} is not known; there is: {', '.join(KINDS)}", field="kind")
    if depth not in DEPTHS:
        raise DatasetError(f"depth: {depth!r} is neither 'stored' nor 'sgbm'", field="depth")
    with bars() as report:
        summary = import_kitti_object(
            source,
            out,
            depth=cast(Literal["stored", "sgbm"], depth),
            progress=lambda done, total: report("frames", done, total),
        )
    console = Console()
    console.print(f"{out}: {summary.places} places, query sets: frames {summary.frames}, elsewhere {summary.elsewhere}")
    if summary.skipped:
        console.print(f"left out, since they have no depth: {', '.join(summary.skipped)}")
