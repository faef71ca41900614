"""``streetfix doctor``: find why a service does not start, or a query gets no answer."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from service.cli.map_folders import folder_of_map


def command(
    bundle: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="BUNDLE", help="Folder of a map bundle.", show_default=False, callback=folder_of_map
        ),
    ] = None,
    camera: Annotated[
        Path | None, typer.Option(help="JSON file of a camera, as for localize.", show_default=False)
    ] = None,
    rgb: Annotated[
        Path | None, typer.Option(help="Colour image. Needs --depth and --camera.", show_default=False)
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(help="Depth image. Needs --rgb and --camera.", show_default=False)
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="HTTP port that must be free.  [default: that of serve]")
    ] = None,
    grpc_port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="gRPC port that must be free.  [default: that of serve]")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Check the machine, a map, a camera file and an image pair.

    The command checks as much as the options allow. It prints a line for each check: ok, warning or problem, the
    finding, and the remedy. With a map and an image pair, it also localizes the pair. It needs no running service.

    \b
    Exit codes:
      0  there is no problem; there may be warnings
      1  there is a problem
      2  wrong options

    \b
    Example:
      streetfix doctor --map maps/paper-city --camera camera.json --rgb 0.jpg --depth 0.png
    """
    if (rgb is None) != (depth is None):
        raise typer.BadParameter("give --rgb and --depth together")
    if rgb is not None and camera is None:
        raise typer.BadParameter("--rgb and --depth need --camera")
    from service.runtime.threads import limit_pools_before_import

    limit_pools_before_import()
    from service.doctor.examine import DoctorInputs, examine

    findings = []
    for each in examine(
        DoctorInputs(bundle=bundle, camera=camera, rgb=rgb, depth=depth, port=port, grpc_port=grpc_port)
    ):
        findings.append(each)
        if not as_json:
            typer.echo(f"{each.level:<7}  {each.check}: {each.text}" + (f"; {each.remedy}" if each.remedy else ""))
    count = {level: sum(each.level == level for each in findings) for level in ("problem", "warning")}
    if as_json:
        report = {
            "problems": count["problem"],
            "warnings": count["warning"],
            "findings": [asdict(each) for each in findings],
        }
        typer.echo(json.dumps(report, indent=1))
    else:
        typer.echo(f"problems: {count['problem']}, warnings: {count['warning']}")
    if count["problem"]:
        raise typer.Exit(1)
