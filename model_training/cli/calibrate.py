"""``streetfix calibrate``."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from model_training.calibration.make import calibrate
from model_training.calibration.own_drive import MOST_ELSEWHERE, frames_of_drive, images_of_drive
from model_training.calibration.own_range import range_lines
from model_training.calibration.own_rig import (
    learn_correction,
    replaced_by,
    report_lines,
    require_support,
    with_correction,
)
from model_training.calibration.rendered_rig import RigFile, frames_of_rig, read_rig
from model_training.cli.progress import bars
from model_training.datasets.dataset import Dataset, require_map_first
from model_training.mapping.build import describe
from model_training.mapping.calibration_file import renew_calibration
from model_training.stock import CALIBRATION, ENCODER
from service.cli.map_folders import folder_of_map
from service.errors import BundleError, DatasetError
from service.localization.localizer import Localizer
from service.maps.calibration import Calibration, RigCorrection
from service.maps.map import Map
from service.maps.rig_key import RigKey
from service.maps.tiles import MOST_AROUND, TiledMap, open_map
from service.maps.writer import replace_calibration
from service.option_limits import LEAST_FALSE_ACCEPT_RATE

#: Folder of cities, maps and answers if none is given.
WORK = Path("data/calibration")
#: Standard deviation of the end point of an odometry as a share of the distance, and queries at a time, if none is given.
ODOMETRY_NOISE, WORKERS = 0.02, 2
#: Value of --calibration for the calibration of the stock encoder.
STOCK = Path("stock")


def command(
    encoder: Annotated[
        Path | None, typer.Option(help="ONNX file of `streetfix export`.  [default: the stock encoder]")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Calibration file to write, JSON.  [default: beside the stock encoder]  With --map, --out writes a file for `build-map "
            "--calibration`. With --map and without --out, the command changes the map."
        ),
    ] = None,
    work: Annotated[
        Path | None, typer.Option(help=f"Folder that keeps cities, maps and answers.  [default: {WORK}]")
    ] = None,
    anew: Annotated[
        bool, typer.Option("--anew", help="Send all queries again, even if their answers are stored.")
    ] = False,
    map_bundle: Annotated[
        Path | None,
        typer.Option(
            "--map",
            help="Map bundle. Learn how its confidence must be corrected for a rig: give --drive or --rig.",
            callback=folder_of_map,
        ),
    ] = None,
    drive: Annotated[
        Path | None,
        typer.Option(
            help="Dataset folder with images of the rig, and with ground truth or odometry, in the map frame."
        ),
    ] = None,
    queries: Annotated[
        list[str] | None, typer.Option(help="Query set of --drive. Repeat for several.  [default: all]")
    ] = None,
    odometry_noise: Annotated[
        float | None,
        typer.Option(
            help="Standard deviation of the end point of --drive's odometry, as a share of the distance.  [default: 0.02]",
            min=0.0,
            max=0.5,
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(help="Camera of --drive whose images count. Needed if the images come from several rigs."),
    ] = None,
    false_accept_rate: Annotated[
        float | None,
        typer.Option(
            help="Share of out-of-map queries of this rig that may be LOCALIZED. The thresholds for this rig then come from --drive. "
            "The command refuses a rate that its images cannot support: 0.01 needs 299 of them.",
            min=LEAST_FALSE_ACCEPT_RATE,
            max=0.5,
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            help="JSON file of a rig. Its images are rendered from the map. They can only lower the confidence."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="With --map: queries that run at a time.  [default: 2]", min=1)
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="With --map: calibration file that replaces that of the map, for example after an update of Streetfix. `stock` is that of "
            "the stock encoder. The map keeps its site check."
        ),
    ] = None,
) -> None:
    """Fit the confidence of an encoder on calibration cities, or correct or renew the confidence of a map.

    Without --map: the command simulates the cities, about two hours. With --drive or --rig: seconds to minutes. With --calibration: a
    second. A correction holds for queries of its rig. It replaces an earlier correction of the same rig. Corrections of other rigs stay.

    \b
    Examples:
      streetfix calibrate --encoder runs/mine/encoder.onnx --out runs/mine/calibration.json
      streetfix build-map data/site --encoder runs/mine/encoder.onnx --calibration runs/mine/calibration.json --out maps/site
      streetfix calibrate --map maps/site --drive data/robot --queries recorded
      streetfix calibrate --map maps/site --drive data/robot --false-accept-rate 0.01
      streetfix calibrate --map maps/site --rig rig.json --out rig_calibration.json
      streetfix calibrate --map maps/site --calibration stock
    """
    of_drive = {
        "--queries": queries,
        "--odometry-noise": odometry_noise,
        "--camera": camera,
        "--false-accept-rate": false_accept_rate,
    }
    if out is not None and not out.parent.is_dir():  # said before the work, not after it
        raise DatasetError(f"--out: folder {out.parent} not found; create it first", field="out")
    if map_bundle is None:
        if given := _given(
            {"--drive": drive, "--rig": rig, "--workers": workers, "--calibration": calibration, **of_drive}
        ):
            raise typer.BadParameter(f"{given} changes the confidence of a map; give the map with --map")
        _calibrate_encoder(encoder or ENCODER, out or CALIBRATION, work or WORK, anew=anew)
        return
    if given := _given({"--encoder": encoder, "--work": work, "--anew": anew or None}):
        raise typer.BadParameter(f"--map uses the encoder and the calibration of the map; leave out {given}")
    if calibration is not None:
        if given := _given({"--drive": drive, "--rig": rig, "--out": out, "--workers": workers, **of_drive}):
            raise typer.BadParameter(f"--calibration replaces the calibration of the map; leave out {given}")
        _renew(map_bundle, CALIBRATION if calibration == STOCK else calibration)
        return
    if drive is None and (given := _given(of_drive)):
        raise typer.BadParameter(f"{given} belongs to --drive; give the recording with --drive")
    if out is not None and out.resolve().is_relative_to(map_bundle.resolve()):
        raise DatasetError(
            f"--out: {out} lies in the map bundle, and its manifest would no longer fit; leave out --out to correct this map",
            field="out",
        )
    frames_from = _source(map_bundle, drive, rig)
    noise = ODOMETRY_NOISE if odometry_noise is None else odometry_noise
    _calibrate_rig(
        map_bundle, frames_from, _OfDrive(queries or [], noise, camera, false_accept_rate), out, workers or WORKERS
    )


def _given(options: Mapping[str, object]) -> str:
    """Return the name of the first given option; empty if none is given."""
    return next((name for name, value in options.items() if value is not None), "")


def _source(map_bundle: Path, drive: Path | None, rig: Path | None) -> Dataset | RigFile:
    """Open the recording or the rig file. Exactly one of both must be given."""
    if drive is not None and rig is None:
        require_map_first(map_bundle, drive, "calibrate --map ... --drive")
        return Dataset(drive)
    if rig is not None and drive is None:
        return read_rig(rig)
    raise typer.BadParameter("--map needs either --drive, --rig or --calibration")


def _calibrate_encoder(encoder: Path, out: Path, work: Path, *, anew: bool) -> None:
    console = Console(highlight=False)
    with bars() as report:
        calibration, checks = calibrate(work, encoder, anew=anew, report=report)
    for line in checks:
        console.print(line, soft_wrap=True)
    _write(out, calibration)
    console.print(f"written: {out}")


def _renew(folder: Path, calibration: Path) -> None:
    console = Console(highlight=False, soft_wrap=True)
    manifest, had_rig = renew_calibration(folder, calibration)
    if had_rig:
        console.print("removed: the corrections for rigs; learn them again with --drive or --rig")
    console.print(f"{describe(manifest)}: {folder}")


@dataclass(frozen=True)
class _OfDrive:
    """Options of a recording: query sets (empty: all), noise of the odometry, camera and false-accept rate (None: not given)."""

    queries: list[str]
    odometry_noise: float
    camera: str | None
    false_accept_rate: float | None


def _calibrate_rig(folder: Path, source: Dataset | RigFile, given: _OfDrive, out: Path | None, workers: int) -> None:
    began = time.monotonic()
    console = Console(highlight=False, soft_wrap=True)
    opened = open_map(folder)
    if isinstance(source, Dataset):
        source = source.in_frame(opened.manifest.georeference)
    bundle = part_for(opened, source, given.queries)
    calibration = bundle.calibration
    if calibration is None:
        raise BundleError(
            f"{folder}: the map is not calibrated, so there is no confidence to correct; fit one with `streetfix calibrate --encoder`, "
            "and build the map with `--calibration`",
            field="calibration.json",
        )
    localizer = Localizer.open(bundle)
    if isinstance(source, RigFile):
        with bars() as report:
            frames = frames_of_rig(localizer, source, workers=workers, report=report)
        correction = learn_correction(
            calibration,
            frames,
            source="rendered",
            measured_on=f"images rendered for {source.name}",
            name=source.name,
            made_for=source.key(),
        )
    else:
        images, rate = images_of_drive(source, given.queries, given.camera), given.false_accept_rate
        if rate is not None:  # an image gives one out-of-map frame at most
            require_support(len(images), rate, "images")
        with bars() as report:
            found = frames_of_drive(
                localizer,
                source,
                given.queries,
                odometry_noise=given.odometry_noise,
                camera=given.camera,
                most_elsewhere=MOST_ELSEWHERE if rate is None else None,
                workers=workers,
                report=report,
            )
        console.print(f"recording: {found.described}")
        for count, what in (
            (found.unlabelled, "have no label"),
            (found.unregistered, "have too few points to register"),
        ):
            if count:
                console.print(f"left out: {count} images {what}")
        frames = found.frames
        correction = learn_correction(
            calibration,
            frames,
            source="drive",
            measured_on=found.described,
            name=found.name,
            made_for=found.rig,
            label_noise=found.label_noise,
            false_accept_rate=rate,
        )
    for line in (*report_lines(correction), *range_lines(calibration, correction, frames)):
        console.print(line)
    for line in _change_lines(calibration, correction):
        console.print(line)
    console.print(f"took_s: {time.monotonic() - began:.1f}")
    corrected = with_correction(calibration, correction)
    if out is None:
        console.print(f"{describe(replace_calibration(folder, corrected.model_dump(mode='json')))}: {folder}")
    else:
        _write(out, corrected)
        console.print(f"written: {out}")


def _change_lines(calibration: Calibration, correction: RigCorrection) -> list[str]:
    """Return what a new correction does to those that the map has."""
    replaced = replaced_by(calibration, correction)
    lines = [f"replaced: the correction {each.name} of the same rig ({each.measured_on})" for each in replaced]
    kept = [each.name for each in calibration.rigs if each not in replaced]
    lines += [f"kept: the corrections of other rigs ({', '.join(kept)})"] if kept else []
    if calibration.rig is not None:
        lines.append(
            f"kept: a correction of an earlier release ({calibration.rig.measured_on}); it applies to every camera without a correction of "
            "its own"
        )
    return lines + [
        _near_line(each, correction) for each in calibration.rigs if _differs_in_depth_only(each, correction)
    ]


def _differs_in_depth_only(one: RigCorrection, other: RigCorrection) -> bool:
    """Check whether two corrections are for the same camera, and their baseline or range limit tells them apart."""
    if one.made_for is None or other.made_for is None or one.made_for.is_same(other.made_for):
        return False
    a, b = (key.model_copy(update={"baseline_m": None, "max_range_m": None}) for key in (one.made_for, other.made_for))
    return a.is_same(b)


def _near_line(kept: RigCorrection, correction: RigCorrection) -> str:
    """Return the warning that two corrections are for the same camera."""
    theirs, ours = (_depth_of(each.made_for) for each in (kept, correction) if each.made_for is not None)
    return (
        f"warning: the kept correction {kept.name} is for the same camera with {theirs}; this one is for {ours}. A query gets the one "
        "whose values it states. If the robot states others than this recording, import it again with its baseline (--baseline-m), and "
        "calibrate again"
    )


def _depth_of(key: RigKey) -> str:
    """Describe what a rig states about its depth."""
    baseline = "no baseline" if key.baseline_m is None else f"baseline {key.baseline_m:g} m"
    limit = "no range limit" if key.max_range_m is None else f"range limit {key.max_range_m:g} m"
    return f"{baseline} and {limit}"


def part_for(opened: Map, source: Dataset | RigFile, queries: Sequence[str] = ()) -> Map:
    """Return the part of a map that calibrates a rig: all of it, or of a tiled map at most ``MOST_AROUND`` tiles.

    Args:
        opened: the map.
        source: the recording, or the rig whose images are rendered from tiles that are spread over the map.
        queries: names of the query sets of the recording; empty for all.

    Raises:
        BundleError: the recording lies in too many tiles, or the map has too many to localize one without ground truth in all of them.
    """
    if not isinstance(opened, TiledMap):
        return opened
    if isinstance(source, RigFile):
        spread = np.linspace(0, len(opened.T_map_place) - 1, MOST_AROUND).round().astype(int)
        return opened.around(lambda: np.array(opened.T_map_place[spread, :3, 3]))
    names = [name for name in source.query_sets(with_truth=True) if not queries or name in queries]
    frames = [frame for name in names for frame in source.queries(name)]
    positions = [frame.T_map_camera[:3, 3] for frame in frames if frame.T_map_camera is not None]
    if not positions and len(opened.tiles) > MOST_AROUND:
        raise BundleError(
            f"{opened.path}: the map has {len(opened.tiles)} tiles, and the recording does not say in which it was made; give a recording "
            "with queries/NAME/poses.txt, or calibrate on one of the tiles with --out",
            field="tiles",
        )
    xyz = np.array(positions) if positions else opened.T_map_place[:, :3, 3]
    if (count := len(opened.tiles.at(xyz[:, :2]))) > MOST_AROUND:
        raise BundleError(
            f"{opened.path}: the recording lies in {count} tiles, and a correction is learned in at most {MOST_AROUND}; give a part of it "
            "with --queries",
            field="tiles",
        )
    return opened.around(lambda: xyz)


def _write(out: Path, calibration: Calibration) -> None:
    """Write a calibration file that appears complete or not at all."""
    part = out.with_name(out.name + ".part")
    try:
        part.write_text(calibration.model_dump_json(indent=1) + "\n")
        part.rename(out)
    finally:
        part.unlink(missing_ok=True)
