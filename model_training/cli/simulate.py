"""``streetfix simulate``."""

from pathlib import Path
from typing import Annotated, Literal, cast

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.cli.rig_option import depths_of, rig_lines, rig_named, sensors_of, simulate_rig
from model_training.cli.sensor_options import sensor_parameters
from model_training.simulation.lidar import LIDARS
from model_training.simulation.plan import CameraPlan, QueryPlan, SimulationPlan
from model_training.simulation.sensor_parameters import DepthParameters, RgbParameters, StereoParameters
from service.errors import DatasetError

_RIGS = "\n".join(f"  {line}" for line in rig_lines())
EXAMPLE = f"""Simulate a city, its LiDAR survey and its RGB-D query traversals.

The command writes a dataset folder.
The same command resumes an interrupted run.
The same seed gives the same bytes, for any number of workers.

\b
Examples:
  streetfix simulate --city paper --table1 --drives 5 --depth precise --depth stereo --out data/paper

\b
  streetfix simulate --seed 9001 --queries 334 --out data/unseen1

\b
  streetfix simulate --lidar hdl_64 --camera 1242x376 --hfov 81.4 --depth sgbm --set stereo.focal_baseline_px_m=384 --out data/pairs

\b
  streetfix simulate --lidar os1_128 --rgb small --set lidar.channels=64 --set rgb.noise=2 --set depth.noise_px=0.3 --out data/others

\b
  streetfix simulate --rig d435 --queries 100 --out data/d435

\b
Rigs (--rig), with image size, depth, LiDAR and distance between its scans:
{_RIGS}
"""


def command(
    out: Annotated[Path, typer.Option(help="Folder of the dataset to write.")],
    city: Annotated[
        str,
        typer.Option(
            help="paper: the paper's nine streets. city: another city for each seed. mixed: like city, with eight "
            "kinds of districts."
        ),
    ] = "city",
    seed: Annotated[int, typer.Option(help="Seed of everything random.", min=0)] = 0,
    name: Annotated[str, typer.Option(help="Name of the dataset.  [default: the folder's name]")] = "",
    size: Annotated[
        str | None, typer.Option(help="Extents of a random city, metres, 30 to 10000 each.  [default: 300x400]")
    ] = None,
    streets: Annotated[str, typer.Option(help="Drive only these streets, such as 1,5,between.")] = "",
    rig: Annotated[
        str | None,
        typer.Option(
            help="Rig preset, listed above: camera, depth, LiDAR and survey. Other options replace single values of it."
        ),
    ] = None,
    lidar: Annotated[
        str | None, typer.Option(help=f"LiDAR preset: {', '.join(LIDARS)}.  [default: paper_32, or the rig's]")
    ] = None,
    spacing: Annotated[
        float | None, typer.Option(help="Distance between scans, metres.  [default: 1, or the rig's]", min=0.02)
    ] = None,
    queries: Annotated[int, typer.Option(help="Queries of each query traversal. 0 simulates none.", min=0)] = 200,
    drives: Annotated[
        int, typer.Option(help="Query traversals. Each has its own vehicles, people and light.", min=1)
    ] = 1,
    table1: Annotated[
        bool, typer.Option("--table1", help="Simulate as many queries of each class as the paper's Table I (626).")
    ] = False,
    on_track: Annotated[
        int,
        typer.Option(
            help="Additional queries at the survey's own poses and among its vehicles. This is the paper's split. "
            "Queries and survey overlap (data leakage), so the figures are too good.",
            min=0,
        ),
    ] = 0,
    depth: Annotated[
        list[str] | None,
        typer.Option(
            help="ideal, precise or stereo: modelled depth error. sgbm, sgbm3way or bm: depth from a rendered and "
            "matched stereo pair. Repeat for several of one sort.  [default: precise, or the rig's]"
        ),
    ] = None,
    rgb: Annotated[
        str,
        typer.Option(
            help=(
                "RGB camera: automatic, small, fixed or machine. machine is a machine-vision camera. Highlights "
                "saturate, and shadows are dark."
            )
        ),
    ] = "automatic",
    sun_elevation: Annotated[
        float | None,
        typer.Option(
            help="Elevation of the sun above the horizon, degrees.  [default: by the condition]", min=1, max=90
        ),
    ] = None,
    sun_azimuth: Annotated[
        float | None,
        typer.Option(
            help="Azimuth of the sun, counter-clockwise from east, degrees.  [default: random]", min=-360, max=360
        ),
    ] = None,
    condition: Annotated[
        str, typer.Option(help="Condition of all queries: clear, hard_light, rain, snow, fog, night or low_sun.")
    ] = "clear",
    survey_condition: Annotated[str, typer.Option(help="Condition of the survey.")] = "clear",
    survey_error: Annotated[bool, typer.Option(help="Add a smooth error to survey poses: 3 cm, 0.05 degrees.")] = True,
    parked_changed: Annotated[
        float,
        typer.Option(help="Share of parking slots that differ between traversals (not --on-track).", min=0, max=1),
    ] = 0.5,
    aside: Annotated[
        float,
        typer.Option(
            help="Largest distance of a query from the survey's lane, metres (not --on-track).", min=0, max=10
        ),
    ] = 2.0,
    heading: Annotated[
        float,
        typer.Option(
            help="Largest angle between a query and the street's axis, degrees (not --on-track).", min=0, max=180
        ),
    ] = 15.0,
    turn: Annotated[
        float, typer.Option(help="Yaw of the camera relative to the vehicle, degrees.", min=-180, max=180)
    ] = 0.0,
    pitch: Annotated[float, typer.Option(help="Pitch error of the camera, degrees.", min=-45, max=45)] = 0.0,
    followed: Annotated[
        float | None,
        typer.Option(help="Share of images with a vehicle driving ahead (not --blocked).", min=0, max=1),
    ] = None,
    blocked: Annotated[
        float, typer.Option(help="Share of the image columns that a lorry ahead hides.", min=0, max=0.9)
    ] = 0.0,
    max_depth: Annotated[
        float | None, typer.Option(help="Largest depth, metres. The simulator removes depth beyond it.", min=1)
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="SENSOR.NUMBER=VALUE",
            help=(
                "Set one sensor parameter of lidar, rgb, depth, stereo or survey. It replaces the preset's value. "
                "Repeat for several."
            ),
        ),
    ] = None,
    camera: Annotated[
        str | None, typer.Option(help="Image size, pixels, up to 4096x4096.  [default: 640x480, or the rig's]")
    ] = None,
    hfov: Annotated[
        float | None,
        typer.Option(help="Horizontal field of view, degrees.  [default: 90, or the rig's]", min=20, max=150),
    ] = None,
    workers: Annotated[int | None, typer.Option(help="Processes.  [default: one per core]", min=1)] = None,
) -> None:
    """See ``EXAMPLE``, which the command line shows."""
    lidar_parameters, rgb_parameters, depth_parameters, stereo_parameters, survey_parameters = sensor_parameters(
        settings or []
    )
    untaken = (depth_parameters, rgb_parameters, stereo_parameters)
    own = None if rig is None else rig_named(rig)
    if own is not None:
        depth_parameters, stereo_parameters, survey_parameters = sensors_of(
            own, depth_parameters, stereo_parameters, survey_parameters, survey_error=survey_error
        )
    of_all: dict[str, object] = {
        "depths": tuple(depth or ["precise"]) if own is None else depths_of(own, depth or []),
        "cameras": None if own is None or own.cameras == 1 else own.cameras,
        "condition": condition,
        "turn_deg": turn,
        "pitch_deg": pitch,
        "blocked": blocked,
        "followed": followed,
        "max_depth_m": max_depth,
        "depth_parameters": depth_parameters,
        "stereo_parameters": stereo_parameters,
        "rgb": None if rgb == "automatic" else rgb,
        "rgb_parameters": rgb_parameters,
        "sun_elevation_deg": sun_elevation,
        "sun_azimuth_deg": sun_azimuth,
    }
    of_drives: dict[str, object] = {"parked_changed": parked_changed, "aside_m": aside, "heading_deg": heading}
    plans = []
    if queries or table1:
        given = of_all | of_drives | {"count": max(1, queries), "per_class": table1}
        plans = [QueryPlan.model_validate(given | {"name": f"drive{k}", "traversal": k}) for k in range(1, drives + 1)]
    if on_track:
        tracked = of_all | {"name": "survey_drive", "traversal": 0, "count": on_track, "on_track": True}
        # Without any drive nothing would take these three: the plan refuses them rather than pass them over.
        plans.append(QueryPlan.model_validate(tracked if plans else tracked | of_drives))
    looks = {"rgb": None if rgb == "automatic" else rgb, "sun-elevation": sun_elevation, "sun-azimuth": sun_azimuth}
    for option, value in looks.items():
        if not plans and value is not None:
            raise DatasetError(
                f"{option}: this option has no effect without queries; set --queries, or omit the option", field=option
            )
    if not plans and untaken != (DepthParameters(), RgbParameters(), StereoParameters()):
        raise DatasetError(
            "set: without queries only parameters of lidar and survey have an effect; set --queries, or set only those",
            field="set",
        )
    if city not in ("paper", "city", "mixed"):
        raise DatasetError(f"city: {city!r} is not valid; choose paper, city or mixed", field="city")
    if city == "paper" and size is not None:
        raise DatasetError("size: the paper's city has a fixed size; omit --size, or use --city city", field="size")
    lens = CameraPlan() if own is None else own.camera
    width, height = (lens.width, lens.height) if camera is None else _pair(camera, "camera", least=48, most=4096)
    plan = SimulationPlan(
        name=name or out.name,
        city=cast(Literal["paper", "city", "mixed"], city),
        seed=seed,
        size_m=_pair(size or "300x400", "size", least=30, most=10_000),
        streets=tuple(s for s in streets.split(",") if s),
        lidar=lidar if lidar is not None else "paper_32" if own is None else own.lidar,
        spacing_m=spacing if spacing is not None else 1.0 if own is None else own.spacing_m,
        survey_condition=survey_condition,
        survey_error=survey_error,
        camera=CameraPlan.model_validate(
            {"width": width, "height": height, "horizontal_deg": lens.horizontal_deg if hfov is None else hfov}
        ),
        queries=tuple(plans),
        lidar_parameters=lidar_parameters,
        survey_parameters=survey_parameters,
    )
    if own is not None:
        heights_m = {"camera_height_m": own.camera_height_m, "lidar_height_m": own.lidar_height_m}
        plan = plan.model_copy(update=heights_m)
    with bars() as report:
        simulate_rig(plan, out, () if own is None else own.beams, workers=workers, report=report)
    Console().print(f"dataset {plan.name}: {out}")


command.__doc__ = EXAMPLE


def _pair(text: str, field: str, *, least: float, most: float) -> tuple[float, float]:
    parts = text.lower().split("x")
    try:
        first, second = (float(part) for part in parts)
    except ValueError as error:
        raise DatasetError(
            f"{field}: {text!r} is not two numbers separated by x, such as 640x480", field=field
        ) from error
    for value in (first, second):
        if not least <= value <= most:  # which NaN is not either
            raise DatasetError(f"{field}: {value:g} in {text!r} is not between {least} and {most}", field=field)
    return first, second
