"""``streetfix map``: maintain map bundles."""

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from model_training.cli.progress import bars
from model_training.cli.tile_options import EngineOption, WorkersOption, refuse_without_tiles
from model_training.datasets.dataset import require_map_first
from model_training.datasets.stored_survey import dataset_at
from model_training.mapping.build import describe
from model_training.mapping.diff import diff_of, difference_png
from model_training.mapping.info import info_of
from model_training.mapping.merge import merge_maps
from model_training.mapping.tiled_care import diff_of_tiles, merge_tiled
from model_training.mapping.update import update_map
from model_training.mapping.update_tiled import update_tiled
from model_training.mapping.verify import damage_of
from service.cli.map_folders import folder_of_map, folder_of_new_map
from service.errors import BundleError
from service.maps.calibration import RigCorrection
from service.maps.manifest import Manifest, read_manifest
from service.maps.reader import MapBundle
from service.maps.search_address import COLLECTION
from service.maps.store.transfer import Copied
from service.maps.store.transfer import pull as pull_map
from service.maps.store.transfer import push as push_map
from service.maps.tiles import open_map

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Maintain map bundles: info, verify, diff, merge, update, push, pull, index.",
)

_Bundle = Annotated[Path, typer.Argument(help="Folder of a map bundle.", callback=folder_of_map)]
_Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_Out = Annotated[Path, typer.Option(help="Folder of the new map bundle.", callback=folder_of_new_map)]
_Overwrite = Annotated[bool, typer.Option(help="Replace an existing map bundle.")]


@app.command()
def info(bundle: _Bundle, as_json: _Json = False) -> None:
    """Show the content of a map bundle.

    \b
    Example:
      streetfix map info maps/paper-city
    """
    found = info_of(bundle)
    if as_json:
        typer.echo(json.dumps(found, indent=1))
        return
    for line in _info_lines(found):
        typer.echo(line)


@app.command()
def verify(bundle: _Bundle) -> None:
    """Check a map bundle.

    The command checks hashes, sizes, format and streets. It also checks the index against the places.
    A damaged bundle gives a line for each defect and exit code 1.

    \b
    Example:
      streetfix map verify maps/paper-city
    """
    with bars() as report:
        damaged = damage_of(bundle, report=report)
    for line in damaged:
        typer.echo(line)
    if damaged:
        raise typer.Exit(1)
    typer.echo(f"{bundle}: no defects")


@app.command()
def diff(
    before: _Bundle,
    after: _Bundle,
    as_json: _Json = False,
    picture: Annotated[Path | None, typer.Option(help="PNG file for a view of both clouds from above.")] = None,
) -> None:
    """Show the changes from one map bundle to another.

    The command compares places, cloud by area, streets, parameters and encoder. Of tiled maps it compares tile by tile, without a picture.

    \b
    Example:
      streetfix map diff maps/town maps/town-may --picture changes.png
    """
    if read_manifest(before).tiles:
        _diff_tiles(before, after, as_json=as_json, picture=picture)
        return
    a, b = MapBundle.open(before), MapBundle.open(after)
    found = diff_of(a, b)
    if picture is not None:
        try:
            picture.write_bytes(difference_png(a, b))
        except OSError as error:
            raise BundleError(
                f"{picture} cannot be written ({error.strerror}); choose another file", field="picture"
            ) from error
    if as_json:
        typer.echo(json.dumps(found, indent=1))
        return
    for line in _diff_lines(found):
        typer.echo(line)


@app.command()
def merge(
    first: _Bundle,
    second: _Bundle,
    out: _Out,
    name: Annotated[
        str | None, typer.Option(help="Name of the map in requests.  [default: the name of the first]")
    ] = None,
    overwrite: _Overwrite = False,
) -> None:
    """Merge two map bundles into one.

    Both have the same frame, encoder and parameters. A merge that was killed begins again, also of tiled maps.

    \b
    Example:
      streetfix map merge maps/north maps/south --out maps/town
    """
    rigs = [_rigs_of(each) for each in (first, second)]
    merging = merge_tiled if read_manifest(first).tiles else merge_maps
    with bars() as report:
        made = merging(first, second, out, name=name, overwrite=overwrite, report=report)
    Console().print(f"{describe(made)}: {out}")
    if rigs[0] != rigs[1]:
        Console(soft_wrap=True).print(
            "confidence: the two maps have different corrections for rigs, and the new map has only those of both; run "
            f"`streetfix calibrate --map {out} --drive DATASET`"
        )


@app.command()
def update(
    bundle: _Bundle,
    dataset: Annotated[
        str,
        typer.Argument(
            help="Dataset folder with a survey, or its URL in object storage, as s3://BUCKET/PATH (extra `store`). One of another "
            "georeference is moved into the map's frame."
        ),
    ],
    out: _Out,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace the area that the new survey covers, such as a rebuilt block.")
    ] = False,
    replace_area: Annotated[
        Path | None, typer.Option(help="GeoJSON file of a polygon in map metres. The command replaces the part inside.")
    ] = None,
    passes_vote: Annotated[
        bool,
        typer.Option(
            help="Visibility vote between passes of the new survey: drop points that more passes see through than hit."
        ),
    ] = False,
    engine: EngineOption = None,
    workers: WorkersOption = None,
    overwrite: _Overwrite = False,
) -> None:
    """Add a survey to a map, or replace a rebuilt part.

    The command uses the map's own encoder and settings. The same command resumes an update that was killed at any moment.
    Only a tiled map takes --engine and --workers.

    \b
    Examples:
      streetfix map update maps/town data/may --replace-area block.geojson --out maps/town-may
      streetfix map update maps/town-tiled data/may --workers 4 --out maps/town-may
      streetfix map update maps/town-tiled s3://bucket/surveys/may --out maps/town-may
    """
    if replace and replace_area is not None:
        raise typer.BadParameter("give --replace or --replace-area, not both")
    require_map_first(bundle, Path(dataset), "map update")
    updating: Callable[..., Manifest] = update_map
    if read_manifest(bundle).tiles:
        warn = partial(typer.echo, err=True)
        updating = partial(update_tiled, engine=engine or "local", workers=workers, warn=warn)
    else:
        refuse_without_tiles(engine, workers, remedy=f"{bundle} is a map of one bundle, so omit the option")
    with bars() as report, dataset_at(dataset, out) as opened:
        made = updating(
            bundle,
            opened,
            out,
            replace_covered=replace,
            replace_area=replace_area,
            passes_vote=passes_vote,
            overwrite=overwrite,
            report=report,
        )
    Console().print(f"{describe(made)}: {out}")


@app.command()
def push(
    bundle: Annotated[
        Path, typer.Argument(help="Folder of a map bundle or of a tiled map.", metavar="MAP", callback=folder_of_map)
    ],
    url: Annotated[
        str, typer.Argument(help="URL of the map: s3://, gs:// or az://BUCKET/PATH, or file:///FOLDER.", metavar="URL")
    ],
) -> None:
    """Copy a map into object storage.

    The command skips tiles that the store has. If it was interrupted, run it again. The new version appears when it is whole.
    Credentials come from the environment (docs/operate.md). Needs the extra `store`.

    \b
    Example:
      streetfix map push maps/town s3://bucket/maps/town
    """
    with bars() as report:
        copied = push_map(bundle, url, report=report)
    Console(soft_wrap=True).print(f"{_copied_text(copied)}: {url}", highlight=False)


@app.command()
def pull(
    url: Annotated[str, typer.Argument(help="URL of a map in object storage, or URL@VERSION.", metavar="URL")],
    out: Annotated[
        Path,
        typer.Argument(help="Folder of the map. It must not exist.", metavar="OUT", callback=folder_of_new_map),
    ],
) -> None:
    """Copy a whole map out of object storage.

    The command checks the hash of every file. If it was interrupted, run it again. Needs the extra `store`.

    \b
    Example:
      streetfix map pull s3://bucket/maps/town maps/town
    """
    with bars() as report:
        copied = pull_map(url, out, report=report)
    Console(soft_wrap=True).print(f"{_copied_text(copied)}: {out}", highlight=False)


@app.command(name="index")
def index_command(
    maps: Annotated[
        list[Path], typer.Argument(help="Folders of tiled maps.", metavar="MAP...", callback=folder_of_map)
    ],
    qdrant: Annotated[
        str, typer.Option(envvar="STREETFIX_QDRANT_URL", help="URL of the server, such as http://127.0.0.1:6333.")
    ],
    collection: Annotated[
        str, typer.Option(envvar="STREETFIX_QDRANT_COLLECTION", help="Name of the collection.")
    ] = COLLECTION,
    prune: Annotated[
        bool, typer.Option("--prune", help="Delete the views of all tiles that none of these maps has.")
    ] = False,
) -> None:
    """Bring a collection of Qdrant in line with tiled maps.

    The command skips tiles whose views are all there. If it was interrupted, run it again.
    With --prune, name every map and version that a service has mounted.
    The key of the server comes from STREETFIX_QDRANT_API_KEY. Needs the extra `qdrant`.

    \b
    Example:
      streetfix map index maps/town --qdrant http://127.0.0.1:6333
    """
    from service.maps.qdrant import Collection, index_maps

    opened = Collection.open(qdrant, collection, api_key=os.environ.get("STREETFIX_QDRANT_API_KEY") or None)
    try:
        with bars() as report:
            done = index_maps(maps, opened, prune=prune, report=report)
    finally:
        opened.close()
    Console(soft_wrap=True).print(
        f"collection {collection}: {done.views} views of {done.sent} tiles sent, {done.kept} tiles there already, "
        f"{done.deleted} views deleted",
        highlight=False,
    )


def _copied_text(copied: Copied) -> str:
    manifest = copied.manifest
    tiles = f", {copied.tiles} tiles copied, {copied.kept} there already" if manifest.tiles else ""
    return f"map {manifest.name}, version {manifest.version}, {copied.size / 1e6:.1f} MB copied{tiles}"


def _rigs_of(bundle: Path) -> list[RigCorrection | None]:
    """Return the correction of an earlier release, None if there is none, and those with a rig."""
    calibration = open_map(bundle, verify=False).calibration
    return [None] if calibration is None else [calibration.rig, *calibration.rigs]


def _info_lines(found: dict[str, Any]) -> list[str]:
    counts, low, high = found["counts"], found["extent_m"]["min"], found["extent_m"]["max"]
    place = found["georeference"]
    site = found["site"]
    checked = "" if site is None else f", {site['right']} of {site['queries']} right in the site check"
    rig = found["rig"]
    checked += "" if rig is None else f", corrected for every rig by {rig['frames']} frames ({rig['measured_on']})"
    for each in found["rigs"]:
        checked += f", corrected for {each['name']} by {each['frames']} frames ({each['measured_on']})"
    return [
        f"map {found['name']}, version {found['version']}, made {found['made_at']}, {found['size_bytes'] / 1e6:.1f} MB",
        f"places:      {counts['places']}, {found['spacing_m']:g} m apart, x {low[0]:g} to {high[0]:g} m, y {low[1]:g} to {high[1]:g} m",
        f"views:       {counts['views']}, {found['headings']} per place, descriptors of {counts['descriptor_size']}",
        *([] if not found["tiles"] else [f"tiles:       {len(found['tiles'])}, {found['tile_m']:g} m wide"]),
        f"cloud:       {counts['cloud_points']} points"
        + (", voxel sums stored" if found["keeps_sums"] else ", no voxel sums stored"),
        f"streets:     {len(found['streets'])}, {counts['streets']} classes, {found['places_in_no_street']} places in no street",
        f"encoder:     {found['encoder']['sha256'][:16]}",
        f"confidence:  {'calibrated' if found['calibrated'] else 'not calibrated'}{checked}",
        "on earth:    "
        + ("unknown" if place is None else f"{place['latitude_deg']:.6f}, {place['longitude_deg']:.6f}"),
        "parameters:  " + ", ".join(f"{name} {value:g}" for name, value in sorted(found["parameters"].items())),
        f"licence:     {found['licence'] or '-'}",
    ]


def _diff_tiles(before: Path, after: Path, *, as_json: bool, picture: Path | None) -> None:
    """Print the changes from one tiled map to another."""
    if picture is not None:
        raise typer.BadParameter(
            "a tiled map has no picture of its changes; omit the option to see which tiles have changed, and draw one of them: "
            f"streetfix map diff {before}/tiles/VERSION {after}/tiles/VERSION --picture FILE. `streetfix map info --json` lists column, "
            "row and version of each tile",
            param_hint="--picture",
        )
    with bars() as report:
        found = diff_of_tiles(before, after, report=report)
    if as_json:
        typer.echo(json.dumps(found, indent=1))
        return
    typer.echo(f"version:     {found['versions'][0]} -> {found['versions'][1]}")
    counts = {name: len(found[name]) for name in ("added", "removed", "changed")}
    typer.echo(f"tiles:       {', '.join(f'{count} {name}' for name, count in counts.items())}, {found['kept']} kept")
    for each in found["changed"]:
        typer.echo(f"tile ({each['column']}, {each['row']}):")
        for line in _diff_lines(each):
            typer.echo(f"  {line}")


def _diff_lines(found: dict[str, Any]) -> list[str]:
    places, cloud, streets = found["places"], found["cloud"], found["streets"]
    lines = [
        f"version:     {found['versions'][0]} -> {found['versions'][1]}",
        f"places:      {len(places['added'])} added, {len(places['removed'])} removed, {places['kept']} kept",
        f"             of which {places['moved']} moved, by up to {places['largest_move_m']:g} m",
        f"cloud:       {cloud['appeared']} points appeared, {cloud['vanished']} vanished, {cloud['kept']} kept",
    ]
    lines += [
        f"             around ({area['x']:g}, {area['y']:g}): {area['appeared']} appeared, {area['vanished']} vanished"
        for area in cloud["areas"][:10]
    ]
    lines += [f"streets:     {what}: {', '.join(names)}" for what, names in streets.items() if names]
    lines += [f"parameters:  {name}: {old} -> {new}" for name, (old, new) in found["parameters"].items()]
    return lines + ["encoder:     " + ("another" if found["encoder_changed"] else "the same")]
