"""``streetfix build-map``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset
from model_training.mapping.build import BuildSettings, build_map, describe
from model_training.stock import CALIBRATION, ENCODER


def command(
    dataset: Annotated[Path, typer.Argument(help="dataset folder with a survey")],
    out: Annotated[Path, typer.Option(help="folder of the bundle")],
    encoder: Annotated[
        Path, typer.Option(help="ONNX file of `streetfix export` [default: the stock encoder]")
    ] = ENCODER,
    name: Annotated[str, typer.Option(help="how requests address the map [default: the dataset's name]")] = "",
    spacing: Annotated[float, typer.Option(help="travelled metres between places; 0 takes every scan", min=0)] = 1.0,
    headings: Annotated[
        int, typer.Option(help="views of each place; the stock encoder was trained for 24", min=1, max=360)
    ] = 24,
    voxel: Annotated[float, typer.Option(help="edge of the cloud's voxels, metres", min=0.01)] = 0.3,
    lidar_height: Annotated[float, typer.Option(help="of the LiDAR above the ground, roughly, metres", min=0.1)] = 1.8,
    remove_weather: Annotated[bool, typer.Option(help="drop lone points such as rain and snow by local PCA")] = False,
    passes_vote: Annotated[
        bool, typer.Option(help="drop what more passes of the survey look through than hit: vehicles that were moved")
    ] = False,
    traffic_vote: Annotated[
        bool,
        typer.Option(help="drop what later scans of a drive look through: vehicles that drove while it was surveyed"),
    ] = True,
    align_survey: Annotated[
        bool,
        typer.Option(
            help="bring the survey's scans into agreement first: poses are off by centimetres, scans tell by how much"
        ),
    ] = True,
    licence: Annotated[str, typer.Option(help="licence text kept in the manifest")] = "",
    calibration: Annotated[
        Path, typer.Option(help="of `streetfix calibrate` for the same encoder [default: the stock encoder's]")
    ] = CALIBRATION,
    overwrite: Annotated[bool, typer.Option(help="replace a bundle that is there")] = False,
) -> None:
    """Build a map bundle of a dataset's survey. Killed at any moment, the same command goes on where it was.

    \b
    Example:
      streetfix build-map data/paper --out maps/paper-city
    """
    opened = Dataset(dataset)
    settings = BuildSettings(
        name=name or opened.name, spacing_m=spacing, headings=headings, voxel_m=voxel, expected_lidar_height_m=lidar_height,
        remove_weather=remove_weather, passes_vote=passes_vote, traffic_vote=traffic_vote, licence=licence, calibration=calibration,
        align_survey=align_survey,
    )  # fmt: skip
    with bars() as report:
        manifest = build_map(opened, encoder, out, settings, overwrite=overwrite, report=report)
    Console().print(f"{describe(manifest)}: {out}")
