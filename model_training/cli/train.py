"""``streetfix train``."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.progress import SILENT, bars
from model_training.cli.training_cities import CitiesOption, RecipeOption, plans_of
from model_training.training.archive_places import archives_at
from model_training.training.loop import (
    Progress,
    TrainingConfig,
    device_of,
    read_config,
    require_shards,
    require_start,
    train,
)
from model_training.training.processes import joined
from model_training.training.shared_packs import make_packs_together
from model_training.training.unpacked_cities import unpack_together
from service.errors import DatasetError
from service.imaging.view_grid import ViewGrid


def command(
    run: Annotated[Path, typer.Option(help="Folder of the run: configuration, checkpoint, TensorBoard log.")],
    recipe: RecipeOption = "stock",
    cities: CitiesOption = None,
    packs: Annotated[Path, typer.Option(help="Folder of the simulated training cities.")] = Path("runs/packs"),
    cities_from: Annotated[
        str | None,
        typer.Option(
            help="Folder or URL that `streetfix simulate-training` wrote. The training unpacks its cities into --packs and simulates "
            "none.  [default: simulate the cities]",
            show_default=False,
        ),
    ] = None,
    steps: Annotated[int, typer.Option(help="Optimiser steps.", min=1)] = 4000,
    pairs: Annotated[int, typer.Option(help="Pairs of views per step, of all processes.", min=2, max=2048)] = 128,
    optimiser: Annotated[str, typer.Option(help="Optimiser: adamw or sgdm. The paper uses sgdm.")] = "adamw",
    rate: Annotated[float, typer.Option(help="Highest learning rate.", min=1e-8, max=1)] = 2e-3,
    turn: Annotated[
        float, typer.Option(min=0, max=180, help="Largest turn between a query and its map view, degrees.")
    ] = 9.0,
    seed: Annotated[int, typer.Option(help="Seed of all random draws.", min=0)] = 0,
    precision: Annotated[
        str, typer.Option(help="float32 or bfloat16. bfloat16 is twice as fast on GPUs and on processors that have it.")
    ] = "float32",
    start_from: Annotated[
        Path | None, typer.Option(help="Run or exported encoder (.onnx). Training starts from its weights.")
    ] = None,
    negatives: Annotated[
        str,
        typer.Option(
            help="batch: the batch's own pairs. look-alikes: half of a batch of 128 is hard negatives. memory: also "
            "descriptors of earlier batches. They spoil training on a single city."
        ),
    ] = "look-alikes",
    device: Annotated[str, typer.Option(help="Device: auto, cpu or cuda.")] = "auto",
    shards: Annotated[
        int | None,
        typer.Option(
            help="Parts of a batch with random numbers of their own. This is also the largest number of training "
            "processes. Their number does not change the result, except for rounding.  [default: that of the run, or the number of "
            "processes]",
            min=1,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(help="Processes that simulate, for each training process.  [default: one per core]", min=1),
    ] = None,
) -> None:
    """Simulate training cities and train an encoder on them.

    Ctrl-C or SIGTERM saves a checkpoint. The same command then resumes the training.

    \b
    Example, an encoder of your own:
      streetfix train --run runs/mine && streetfix export runs/mine --out encoder.onnx
    \b
    Example, four processes of one machine that resume up to three times after a failure:
      torchrun --standalone --nproc-per-node 4 --max-restarts 3 --no-python -- \\
        streetfix train --run runs/mine
    \b
    Example, cities that another machine or a cluster of Ray has simulated:
      streetfix simulate-training --out /shared/cities --engine ray
      streetfix train --run runs/mine --cities-from /shared/cities
    """
    plans = plans_of(recipe, cities)
    if optimiser not in ("adamw", "sgdm"):
        raise DatasetError(f"optimiser: {optimiser!r} is not valid; choose adamw or sgdm", field="optimiser")
    if precision not in ("float32", "bfloat16"):
        raise DatasetError(f"precision: {precision!r} is not valid; choose float32 or bfloat16", field="precision")
    if negatives not in ("batch", "look-alikes", "memory"):
        raise DatasetError(
            f"negatives: {negatives!r} is not valid; choose batch, look-alikes or memory", field="negatives"
        )
    if cities_from is not None and workers is not None:
        raise DatasetError("workers: nothing is simulated with --cities-from; omit --workers", field="workers")
    place = device_of(device)  # said before an hour of simulation, not after it
    with joined(place) as together:
        if shards is None:
            shards = read_config(run).shards if (run / "config.json").exists() else together.count
        together.wait()  # until all have looked: the first process writes the file later
        config = TrainingConfig.model_validate(
            {
                "steps": steps,
                "pairs": pairs,
                "optimiser": optimiser,
                "learning_rate": rate,
                "seed": seed,
                "turn_deg": turn,
                "precision": precision,
                "stale_negatives": negatives == "memory",
                "shards": shards,
            }
            | ({} if start_from is None else {"memory_after": 30})  # descriptors of a trained network drift slowly
            | ({"memory_after": None} if negatives == "batch" else {})
        )
        require_shards(config, together.count)
        if start_from is not None:
            require_start(start_from, config.encoder)
        grid = ViewGrid(rows=config.encoder.rows, columns=config.encoder.columns)
        with bars() if together.is_first else nullcontext(SILENT) as report:
            if cities_from is None:
                folders = make_packs_together(plans, packs, grid, together, workers=workers, report=report)
            else:
                folders = unpack_together(plans, archives_at(cities_from), packs, grid, together, report=report)

            def show(progress: Progress) -> None:
                stage = f"loss {progress.loss:.2f} {progress.accuracy:4.0%} {progress.images_per_s:.0f}/s"
                report("training", progress.step, progress.steps)
                report.describe("training", stage)

            train(folders, run, config, device=device, start_from=start_from, report=show, together=together)
    if together.is_first:
        Console().print(f"trained: {run}; next: streetfix export {run} --out encoder.onnx")
