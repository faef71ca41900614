"""``streetfix record``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.progress import bars
from service.errors import DatasetError


def command(
    kind: Annotated[str, typer.Argument(help="Simulator to record from: carla.")],
    out: Annotated[Path, typer.Option(help="New folder for the recording.")],
    host: Annotated[str, typer.Option(help="Host of the CARLA server.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port of the CARLA server.", min=1, max=65535)] = 2000,
    town: Annotated[str, typer.Option(help="CARLA map to load, such as Town01.  [default: the loaded one]")] = "",
    weather: Annotated[str, typer.Option(help="Weather preset of CARLA, such as ClearNoon or HardRainSunset.")] = "",
    frames: Annotated[int, typer.Option(help="Frames to record.", min=1)] = 600,
    step: Annotated[float, typer.Option(help="Simulated time between frames, seconds.", min=0.01, max=1.0)] = 0.1,
    seed: Annotated[int, typer.Option(help="Seed of the vehicle's place and the traffic.", min=0)] = 0,
) -> None:
    """Record a traversal by autopilot from a running CARLA.

    Ctrl-C ends the recording. The recorded frames stay.

    \b
    Example:
      streetfix record carla --host 192.168.0.7 --town Town01 --out recordings/town01
      streetfix import carla recordings/town01 --out data/town01
    """
    if kind != "carla":
        raise DatasetError(f"kind: {kind!r} is not a known simulator; choose: carla", field="kind")
    from model_training.importing.carla_record import RecordSettings, record

    settings = RecordSettings(town=town, weather=weather, frames=frames, step_s=step, seed=seed)
    with bars() as report:
        done = record(host, port, out, settings, report=lambda done, of: report("frames", done, of))
    Console().print(f"{out}: {done} frames; next: streetfix import carla {out} --out DATASET", soft_wrap=True)
