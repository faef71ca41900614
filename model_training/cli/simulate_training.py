"""``streetfix simulate-training``."""

from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.cli.training_cities import CitiesOption, RecipeOption, plans_of
from model_training.tasks.engines import Engine, require_engine
from model_training.training.archive_places import archives_at
from model_training.training.city_engines import simulate_archives
from service.imaging.view_grid import ViewGrid


def command(
    out: Annotated[
        str,
        typer.Option(
            help="Folder of the files to write, or its URL in object storage, as s3://BUCKET/PATH (extra `store`). The command keeps "
            "finished cities in it."
        ),
    ],
    recipe: RecipeOption = "stock",
    cities: CitiesOption = None,
    engine: Annotated[
        Engine,
        typer.Option(
            help="What simulates the cities: processes of this machine, or tasks of Ray (extra `ray`). RAY_ADDRESS names a cluster."
        ),
    ] = "local",
    workers: Annotated[
        int | None,
        typer.Option(help="Number of cities at the same time.  [default: one per core]", min=1, show_default=False),
    ] = None,
) -> None:
    """Simulate the cities of a training into files for other machines.

    Each city is a tar file in the format of WebDataset. The same command resumes an interrupted run. Both engines give the same bytes.

    \b
    Examples:
      streetfix simulate-training --out cities
      RAY_ADDRESS=head:6379 streetfix simulate-training --recipe streets --out /shared/cities --engine ray
      streetfix train --recipe streets --run runs/mine --cities-from /shared/cities
    """
    plans = plans_of(recipe, cities)
    require_engine(engine, workers)
    with bars() as report:
        simulate_archives(
            plans,
            archives_at(out),
            ViewGrid(),
            engine=engine,
            workers=workers,
            report=report,
            warn=lambda text: typer.echo(text, err=True),
        )
    more = "" if recipe == "stock" else f" --recipe {recipe}"
    more += "" if cities is None else f" --cities {cities}"
    Console().print(
        f"simulated: {len(plans)} cities in {out}; next: streetfix train{more} --run RUN --cities-from {out}"
    )
