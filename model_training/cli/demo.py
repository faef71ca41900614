"""``streetfix demo``."""

import time
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.demo_answers import ask, print_answers, print_next
from model_training.cli.demo_map import CityDemo, DemoMap, city_demo, recorded_demo
from model_training.cli.demo_samples import write_samples
from model_training.cli.demo_service import serving
from model_training.cli.progress import bars
from model_training.stock import ENCODER
from service.maps.manifest import read_manifest


def command(
    out: Annotated[
        Path | None, typer.Option(help="Folder of all results.  [default: out/demo, or out/demo-real with --real]")
    ] = None,
    real: Annotated[
        Path | None, typer.Option(help="Folder of stereo frames in KITTI's object layout. They replace the city.")
    ] = None,
    encoder: Annotated[
        Path, typer.Option(help="ONNX file of an encoder.  [default: the stock encoder]", show_default=False)
    ] = ENCODER,
    streets: Annotated[str, typer.Option(help="Streets of the paper's city to map.")] = "1,5,7",
    queries: Annotated[int, typer.Option(help="Queries to send.", min=1)] = 12,
    depth: Annotated[str, typer.Option(help="Depth camera: ideal, precise or stereo.")] = "precise",
    seed: Annotated[int, typer.Option(help="Seed of the city and its traversals.", min=0)] = 0,
    port: Annotated[int, typer.Option(help="Port of the service. 0 lets the system choose.", min=0, max=65535)] = 0,
    once: Annotated[
        bool, typer.Option("--once", help="End after the answers. Otherwise the service keeps running.")
    ] = False,
) -> None:
    """Build a map, serve it and compare answers with ground truth.

    The command sends the queries over HTTP. It shows each answer beside the ground truth.

    \b
    Examples:
      streetfix demo --once
      streetfix demo --real KITTI --once
    """
    began, console = time.monotonic(), Console(highlight=False)
    with bars() as report:
        if real is None:
            plan = CityDemo(streets=tuple(s for s in streets.split(",") if s), queries=queries, depth=depth, seed=seed)
            demo = city_demo(plan, out or Path("out/demo"), encoder, report)
        else:
            demo = recorded_demo(real, out or Path("out/demo-real"), encoder, report)
    samples = write_samples(demo.questions, demo.folder / "samples", map_name=read_manifest(demo.bundle).name)
    with serving(demo.bundle, port, samples) as service:
        try:
            _show(demo, samples, service.url, console, began, goes_on=not once)
            if not once:
                service.wait()
        except KeyboardInterrupt:  # also one that comes while the last lines are printed
            if once:
                raise
            console.print("stopped")


def _show(demo: DemoMap, samples: Path, url: str, console: Console, began: float, *, goes_on: bool) -> None:
    outcomes = [ask(question, url) for question in demo.questions]
    print_answers(outcomes, console, places=demo.place_names)
    minutes, seconds = divmod(round(time.monotonic() - began), 60)
    console.print(f"Total time {minutes} min {seconds} s; results: {demo.folder}\n", soft_wrap=True)
    print_next(outcomes, demo.bundle, samples, url, console, goes_on=goes_on)
