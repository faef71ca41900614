"""``streetfix build-map``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.cli.tile_options import EngineOption, WorkersOption, refuse_without_tiles
from model_training.datasets.dataset import MOST_SURVEY_STD_DEG, MOST_SURVEY_STD_M
from model_training.datasets.stored_survey import dataset_at
from model_training.mapping.build import build_map, describe, require_new
from model_training.mapping.build_tiled import build_tiled
from model_training.mapping.calibration_file import calibration_for
from model_training.mapping.frame_choice import in_chosen_frame
from model_training.mapping.settings import BuildSettings
from model_training.mapping.tiles import require_tile_edge
from model_training.stock import CALIBRATION, ENCODER
from model_training.tasks.engines import require_engine
from service.cli.map_folders import folder_of_map, folder_of_new_map
from service.retrieval.encoder import Encoder

_DEFAULT = BuildSettings(name="default")


def command(
    dataset: Annotated[
        str,
        typer.Argument(
            help="Dataset folder with a survey, or its URL in object storage, as s3://BUCKET/PATH (extra `store`)."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder of the map bundle.", callback=folder_of_new_map)],
    encoder: Annotated[
        Path, typer.Option(help="ONNX file of `streetfix export`.  [default: the stock encoder]", show_default=False)
    ] = ENCODER,
    name: Annotated[str, typer.Option(help="Name of the map in requests.  [default: the dataset's name]")] = "",
    spacing: Annotated[
        float,
        typer.Option(
            help="Travelled distance between the scans that become places, metres. 0 takes every scan.", min=0
        ),
    ] = _DEFAULT.spacing_m,
    between: Annotated[
        float,
        typer.Option(
            help="Largest distance between places, metres. Farther scans get places between them, with views rendered "
            "from both scans. 0 puts none there.",
            min=0,
        ),
    ] = _DEFAULT.between_m,
    headings: Annotated[
        int, typer.Option(help="Map views of each place. The stock encoder was trained for 24.", min=1, max=360)
    ] = _DEFAULT.headings,
    voxel: Annotated[
        float, typer.Option(help="Edge length of the cloud's voxels, metres.", min=0.01)
    ] = _DEFAULT.voxel_m,
    lidar_height: Annotated[
        float, typer.Option(help="Approximate height of the LiDAR above the ground, metres.", min=0.1)
    ] = _DEFAULT.expected_lidar_height_m,
    remove_weather: Annotated[
        bool, typer.Option(help="Drop isolated points such as rain and snow by local PCA.")
    ] = False,
    passes_vote: Annotated[
        bool,
        typer.Option(
            help="Visibility vote between passes: drop points that more passes see through than hit, such as moved "
            "vehicles."
        ),
    ] = False,
    traffic_vote: Annotated[
        bool,
        typer.Option(
            help="Visibility vote between scans: drop points that later scans of a traversal see through, such as "
            "driving vehicles."
        ),
    ] = True,
    align_survey: Annotated[
        bool,
        typer.Option(
            help="Align the survey's scans first. Survey poses are off by centimetres, and the scans show by how much."
        ),
    ] = True,
    survey_std_m: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of the survey's positions per axis, metres. It widens the covariance of answers.  "
            "[default: what the dataset states]",
            min=0,
            max=MOST_SURVEY_STD_M,
            show_default=False,
        ),
    ] = None,
    survey_std_deg: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of the survey's angles, degrees.  [default: what the dataset states]",
            min=0,
            max=MOST_SURVEY_STD_DEG,
            show_default=False,
        ),
    ] = None,
    licence: Annotated[str, typer.Option(help="Licence text for the manifest.")] = "",
    calibration: Annotated[
        Path,
        typer.Option(
            help="File of `streetfix calibrate` for the same encoder.  [default: the calibration of the stock encoder]",
            show_default=False,
        ),
    ] = CALIBRATION,
    tile_m: Annotated[
        float | None,
        typer.Option(
            help="Build a tiled map with squares of this edge, metres: 50 to 10,000. It is for large surveys: the memory depends on "
            "a tile, and all cores work.  [default: one bundle]",
            show_default=False,
        ),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(
            help="Map frame: `survey` keeps that of the dataset. `global` takes the one that all maps of a region share. The folder of "
            "a map takes the frame of that map. The last two need a georeference.  [default: global for a tiled map of a survey with "
            "georeference, else survey]",
            metavar="survey|global|MAP",
            callback=folder_of_map,
            show_default=False,
        ),
    ] = None,
    engine: EngineOption = None,
    workers: WorkersOption = None,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing map bundle.")] = False,
) -> None:
    """Build a map bundle from a dataset's survey.

    The same command resumes a build that was killed at any moment.

    \b
    Examples:
      streetfix build-map data/paper --out maps/paper-city
      streetfix build-map data/town --out maps/town --tile-m 500
      streetfix build-map data/north --out maps/north --tile-m 500 --frame maps/town
      streetfix build-map s3://bucket/surveys/town --out maps/town --tile-m 500
    """
    if tile_m is None:
        refuse_without_tiles(engine, workers, remedy="give --tile-m too")
    # What can be refused is refused before scans are fetched.
    require_new(out, name or "unnamed", overwrite=overwrite)
    calibration_for(calibration, Encoder.open(encoder).sha256)
    if tile_m is not None:
        require_tile_edge(tile_m)
        require_engine(engine or "local", workers)
    told = list[str]()
    with bars() as report, dataset_at(dataset, out) as given:
        opened = in_chosen_frame(given, frame, tiled=tile_m is not None)
        settings = BuildSettings(
            name=name or opened.name,
            spacing_m=spacing,
            between_m=between,
            headings=headings,
            voxel_m=voxel,
            expected_lidar_height_m=lidar_height,
            remove_weather=remove_weather,
            passes_vote=passes_vote,
            traffic_vote=traffic_vote,
            licence=licence,
            calibration=calibration,
            align_survey=align_survey,
            survey_std_m=survey_std_m,
            survey_std_deg=survey_std_deg,
        )
        if tile_m is None:
            manifest = build_map(opened, encoder, out, settings, overwrite=overwrite, report=report)
        else:
            manifest = build_tiled(
                opened,
                encoder,
                out,
                settings,
                tile_m=tile_m,
                engine=engine or "local",
                workers=workers,
                overwrite=overwrite,
                report=report,
                warn=lambda text: typer.echo(text, err=True),
                tell=told.append,
            )
    for line in told:
        typer.echo(line)
    Console().print(f"{describe(manifest)}: {out}")
