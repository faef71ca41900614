"""``streetfix evaluate``."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from model_training.cli.progress import bars
from model_training.cli.queries_table import print_queries
from model_training.cli.stages_table import print_stages
from model_training.datasets.dataset import Dataset, require_map_first
from model_training.evaluation.evaluate import evaluate, write_trajectory
from model_training.evaluation.measures import label_of, recall_at
from model_training.evaluation.predict import Predictions
from model_training.evaluation.query_mode import MOST_FRAMES, QueryMode
from model_training.evaluation.raw_range import raw_best_views
from model_training.evaluation.saved_run import save_run
from model_training.evaluation.stages import stages_of
from model_training.evaluation.why_refused import FEW, NO_CAUSE, causes
from service.cli.map_folders import folder_of_map
from service.errors import DatasetError
from service.localization.localizer import Localizer
from service.maps.map import Map
from service.maps.tiles import open_map

SHOWN = (
    ("queries", "queries", "{:d}"),
    ("odometry", "relative poses", "{}"),
    ("localized", "accepted", "{:.2%}"),
    ("accepted_wrong", "accepted, over 1 m off", "{:.2%}"),
    ("median_confidence", "median confidence", "{:.3f}"),
    ("street_accuracy", "accepted, street right", "{:.2%}"),
    ("within_0_5_m", "accepted, within 0.5 m", "{:.2%}"),
    ("within_1_m", "accepted, within 1 m", "{:.2%}"),
    ("within_5_m", "accepted, within 5 m", "{:.2%}"),
    ("mean_distance_error_m", "accepted, mean error", "{:.3f} m"),
    ("median_distance_error_m", "accepted, median error", "{:.3f} m"),
    ("p95_distance_error_m", "accepted, 95th percentile", "{:.3f} m"),
    ("rms_distance_error_m", "accepted, RMS error", "{:.3f} m"),
    ("mse_m2", "accepted, MSE", "{:.3f} m2"),
    ("median_heading_error_deg", "accepted, median heading error", "{:.2f} deg"),
    ("forced.within_0_5_m", "forced, within 0.5 m", "{:.2%}"),
    ("forced.within_1_m", "forced, within 1 m", "{:.2%}"),
    ("forced.within_5_m", "forced, within 5 m", "{:.2%}"),
    ("forced.median_distance_error_m", "forced, median error", "{:.3f} m"),
    ("forced.p95_distance_error_m", "forced, 95th percentile", "{:.3f} m"),
    ("recall_at_1_5m", "R@1 at 5 m", "{:.2%}"),
    ("recall_at_5_5m", "R@5 at 5 m", "{:.2%}"),
    ("recall_at_10_5m", "R@10 at 5 m", "{:.2%}"),
    ("recall_at_1_10m", "R@1 at 10 m", "{:.2%}"),
    ("raw_recall_at_1_5m", "raw range image R@1", "{:.2%}"),
    ("ms_per_query", "time per query", "{:.1f} ms"),
)
_CAPTION = (
    "accepted: status LOCALIZED, shares of all queries; forced: the best guess of every query, whatever its status"
)


def command(
    bundle: Annotated[Path, typer.Argument(help="Map bundle.", callback=folder_of_map)],
    dataset: Annotated[Path, typer.Argument(help="Dataset with query sets that have ground truth.")],
    queries: Annotated[
        list[str] | None, typer.Option(help="Query set. Repeat for several.  [default: all with ground truth]")
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="JSON file for all figures.")] = None,
    raw_baseline: Annotated[
        bool, typer.Option("--raw-baseline", help="Compare with the nearest neighbour of the raw range image.")
    ] = False,
    trajectory: Annotated[
        Path | None, typer.Option(help="File for the poses of accepted answers, TUM format (one query set).")
    ] = None,
    predictions: Annotated[
        Path | None,
        typer.Option(help="Folder for the answers, one NPZ file per query set. New measures then need no new run."),
    ] = None,
    report_folder: Annotated[
        Path | None,
        typer.Option(
            "--report", help="Folder for a report page (index.html), the answers and the settings of the run."
        ),
    ] = None,
    most: Annotated[
        int, typer.Option("--list", help="Queries to list one by one, the worst first. 0 lists none.", min=0)
    ] = 10,
    stages: Annotated[
        bool,
        typer.Option(
            "--stages",
            help="Name the stage of the answer that loses each query. The command then sends each query twice.",
        ),
    ] = False,
    refine: Annotated[
        bool,
        typer.Option(
            "--refine/--no-refine", help="Register each query on the map cloud. --no-refine measures retrieval alone."
        ),
    ] = True,
    frames: Annotated[
        int | None,
        typer.Option(
            help="Consecutive images in one query, as a sequence of the API. The relative poses come from odometry.txt of the set, else "
            "from the ground truth, with simulated errors of an odometry.  [default: 1]",
            min=1,
            max=MOST_FRAMES,
        ),
    ] = None,
    prior_std_m: Annotated[
        float | None,
        typer.Option(
            help="Give each query a prior position. Its standard deviation per axis, and that of its error from the true position, are "
            "this number of metres. With --track, only the first image has a prior.  [default: no prior]",
            min=0.01,
        ),
    ] = None,
    track: Annotated[
        bool,
        typer.Option(
            "--track",
            help="The images of a set are those of one moving robot, and each answer uses the images before. Odometry as for --frames.",
        ),
    ] = False,
    workers: Annotated[
        int | None, typer.Option(help="Queries that run at a time. Not with --track.  [default: 2]", min=1)
    ] = None,
) -> None:
    """Measure the answers of a map against ground truth.

    \b
    Examples:
      streetfix evaluate maps/paper-city data/paper --queries drive1_precise --json result.json
      streetfix evaluate maps/paper-city data/paper --report reports/paper
      streetfix evaluate maps/town data/robot --frames 5
      streetfix evaluate maps/town data/robot --track --prior-std-m 3
    """
    mode = _mode(frames, prior_std_m, track=track)
    _refuse_without_effect(mode, raw_baseline=raw_baseline, stages=stages, refine=refine, workers=workers)
    if report_folder is not None:
        # Only a report needs matplotlib, and its import takes longer than that of all others. It must not fail after the run.
        from model_training.reporting.run_page import write_run_page
    require_map_first(bundle, dataset, "evaluate")
    opened = open_map(bundle)
    data = Dataset(dataset).in_frame(opened.manifest.georeference)
    names = queries or data.query_sets(with_truth=True)
    if trajectory is not None and len(names) != 1:
        raise DatasetError(
            f"trajectory: expected one query set, not {len(names)}; choose it with --queries", field="queries"
        )
    for file in (json_file, trajectory):
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
    with bars() as report:
        result = evaluate(opened, data, names, mode=mode, refine=refine, workers=workers or 2, report=report)
        figures = result.figures
        if raw_baseline:
            places = raw_best_views(opened, data, list(result.predictions), report=report)
            _add_raw(figures, opened, places, result.predictions)
        traced = (
            {name: stages_of(Localizer.open(opened), data, name, report=report) for name in names} if stages else {}
        )
    _add_causes(figures, opened, data, result.predictions)
    if stages:
        figures["stages"] = {name: [each.as_json() for each in found] for name, found in traced.items()}
    if trajectory is not None:
        write_trajectory(trajectory, next(iter(result.predictions.values())))
    if predictions is not None:
        predictions.mkdir(parents=True, exist_ok=True)
        for name, answers in result.predictions.items():
            answers.save(predictions / f"{name}.npz")
    if report_folder is not None:
        page = write_run_page(save_run(report_folder, opened, data, result), opened, data, figures)
    if json_file is not None:
        part = json_file.with_name(json_file.name + ".part")
        part.write_text(json.dumps(figures, indent=1) + "\n")
        part.rename(json_file)
    Console().print(_table(figures))
    _say_why(figures)
    for name, answers in result.predictions.items():
        print_queries(name, answers, Console(), most=most, first_image=mode.frames - 1)
    for name, found in traced.items():
        print_stages(name, found, Console())
    if report_folder is not None:
        Console(soft_wrap=True).print(f"report: {page}")


def _mode(frames: int | None, prior_std_m: float | None, *, track: bool) -> QueryMode:
    if track and frames is not None:
        raise typer.BadParameter(
            "--frames and --track exclude each other: a track chooses how many images it uses together"
        )
    return QueryMode(frames=frames or 1, prior_std_m=prior_std_m, track=track)


def _refuse_without_effect(
    mode: QueryMode, *, raw_baseline: bool, stages: bool, refine: bool, workers: int | None
) -> None:
    """Refuse options that the mode cannot use."""
    if mode.track and workers is not None:
        raise typer.BadParameter("--workers and --track exclude each other: the images of a track follow one another")
    if mode.track and not refine:
        raise typer.BadParameter("--no-refine and --track exclude each other: a track needs registered images")
    named = "--track" if mode.track else "--frames" if mode.frames > 1 else "--prior-std-m"
    if mode == QueryMode():
        return
    if stages:
        raise typer.BadParameter(f"--stages examines single images without a prior; leave out --stages or {named}")
    if raw_baseline and mode.frames > 1:
        raise typer.BadParameter("--raw-baseline compares single images; leave out --raw-baseline or --frames")


def _add_raw(
    figures: dict[str, Any],
    bundle: Map,
    places: dict[str, NDArray[np.int64]],
    predictions: dict[str, Predictions],
) -> None:
    """Add R@1 of the raw range image over all queries and of each set, each at its best setting, and the setting's name.

    ``places`` has the first place of each query by setting, all sets in order; -1 for none.
    """
    truth = np.concatenate([p.T_true[:, :2, 3] for p in predictions.values()])
    xy = bundle.T_map_place[:, :2, 3]
    right = {setting: recall_at(xy[place][:, None], truth, 1) & (place >= 0) for setting, place in places.items()}
    figures |= _raw_figures(right, slice(None))
    first = 0
    for name, answers in predictions.items():
        count = len(answers.T_true)
        figures["sets"][name] |= _raw_figures(right, slice(first, first + count))
        first += count


def _raw_figures(right: dict[str, NDArray[np.bool_]], queries: slice) -> dict[str, Any]:
    recalls = {setting: float(flags[queries].mean()) for setting, flags in right.items()}
    best = max(recalls, key=lambda setting: recalls[setting])
    return {"raw_recall_at_1_5m": recalls[best], "raw": {"best_setting": best, "recall_at_1_5m": recalls}}


def _add_causes(figures: dict[str, Any], bundle: Map, data: Dataset, predictions: dict[str, Predictions]) -> None:
    """Add what to check to the figures of each set, if few answers were accepted or the focal length is suspicious, the likeliest first."""
    if bundle.calibration is None:
        return
    for name, answers in predictions.items():
        found = causes(Localizer.open(bundle), list(data.queries(name)), answers)
        figures["sets"][name]["causes"] = [asdict(cause) for cause in found]


def _say_why(figures: dict[str, Any]) -> None:
    """Print what to check in each set, the likeliest cause first."""
    console = Console(soft_wrap=True, highlight=False)
    for name, values in figures["sets"].items():
        found = values.get("causes")
        if found is None or (values["localized"] >= FEW and not found):
            continue
        console.print(
            f"{name}: {values['localized']:.0%} of the answers are accepted. What to check, the likeliest first:"
        )
        for number, cause in enumerate(found, 1):
            console.print(f"  {number}. {cause['what']}: {cause['check']}")
        if not found:
            console.print(f"  {NO_CAUSE}")


def _table(figures: dict[str, Any]) -> Table:
    title = f"{figures['dataset']} on map {figures['map']['name']} {figures['map']['version']}"
    mode = QueryMode.model_validate(figures["mode"])
    if mode != QueryMode():
        title += f"\n{mode.described()}"
    table = Table(caption=_CAPTION, title=title)
    columns = [("all", figures), *figures["sets"].items()] if len(figures["sets"]) > 1 else [*figures["sets"].items()]
    table.add_column("")
    for name, values in columns:
        table.add_column(f"{name}\n{values['split'].replace('_', ' ')}", justify="right")
    for key, label, form in SHOWN:
        cells = [_cell(values, key, form) for _, values in columns]
        if any(cell != "-" for cell in cells):
            table.add_row(label_of(key, label, registered=figures["registered"]), *cells)
    if "raw" in figures:
        table.add_row("raw range image's setting", *(v["raw"]["best_setting"] for _, v in columns))
    return table


def _cell(values: dict[str, Any], key: str, form: str) -> str:
    for part in key.split(".")[:-1]:
        values = values[part]
    value = values.get(key.split(".")[-1])
    return "-" if value is None else form.format(value)
