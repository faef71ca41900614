"""The options ``--engine`` and ``--workers`` of ``streetfix build-map`` and ``streetfix map update``: how tiles are built."""

from typing import Annotated

import typer

from model_training.tasks.engines import Engine

EngineOption = Annotated[
    Engine | None,
    typer.Option(
        help="What builds the tiles: processes of this machine, or tasks of Ray (extra `ray`). RAY_ADDRESS names a cluster.  "
        "[default: local]",
        show_default=False,
    ),
]
WorkersOption = Annotated[
    int | None,
    typer.Option(
        help="Number of tiles at the same time.  [default: one per core, fewer if the memory does not suffice]",
        min=1,
        show_default=False,
    ),
]


def refuse_without_tiles(engine: Engine | None, workers: int | None, *, remedy: str) -> None:
    """Refuse the options for a map of one bundle, because they would have no effect.

    Args:
        engine: value of ``--engine``; None if it is not given.
        workers: value of ``--workers``; None if it is not given.
        remedy: end of the error.

    Raises:
        BadParameter: one of them is given.
    """
    for option, value in (("--engine", engine), ("--workers", workers)):
        if value is not None:
            raise typer.BadParameter(f"it builds tiles; {remedy}", param_hint=option)
