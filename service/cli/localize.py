"""``streetfix localize``: send queries to a running service, and print the answers for people or programs."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.pair_files import read_batch
from service.cli.send import Connection, Overrides, localize_batch, localize_pair, localize_sequence
from service.cli.tls_options import Ca, Cert, Key
from service.errors import RequestError, StreetfixError

#: Exit code for an answer that is not LOCALIZED, so that a script does not take it for a pose. 1 and 2 are errors.
NOT_LOCALIZED = 3
_EITHER = "Not with --sequence or --batch."


def command(
    rgb: Annotated[
        Path | None, typer.Option(help=f"Colour image: JPEG, PNG or WebP. {_EITHER}", show_default=False)
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(help=f"Depth image: 16-bit PNG, TIFF, NPY or raw16. {_EITHER}", show_default=False)
    ] = None,
    camera: Annotated[
        Path | None,
        typer.Option(
            help=f'JSON file: {{"camera": {{...}}, "depth": {{...}}, "gravity": {{...}}}}. {_EITHER}',
            show_default=False,
        ),
    ] = None,
    sequence: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="JSON file with frames of one traversal or the cameras of a rig: one answer, the pose of the first frame.",
            show_default=False,
        ),
    ] = None,
    batch: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="JSON file with independent image pairs: one answer for each.", show_default=False
        ),
    ] = None,
    url: Annotated[str, typer.Option(help="URL of the service.")] = "http://127.0.0.1:8000",
    map_name: Annotated[
        str | None, typer.Option("--map", help="Name of the map. Required if the service has several.")
    ] = None,
    near: Annotated[
        str | None,
        typer.Option(help="Approximate position: X,Y or X,Y,STD in the map frame, metres.", show_default=False),
    ] = None,
    heading: Annotated[
        float | None, typer.Option(help="Approximate heading, degrees counter-clockwise from map x.")
    ] = None,
    camera_height: Annotated[
        float | None,
        typer.Option(
            help="Height of the camera above the ground, metres. Without it, the service finds the height in the depth image.",
            show_default=False,
        ),
    ] = None,
    camera_height_std: Annotated[
        float | None,
        typer.Option(help="Standard deviation of the height, metres.  [default: 0.05]", show_default=False),
    ] = None,
    false_accept_rate: Annotated[
        float | None,
        typer.Option(
            help="Share of out-of-map queries that may be LOCALIZED. Up to 0.01, the answer has a confidence of at least 0.9, and above "
            "it one of at least 0.5.  [default: that of the service]",
            show_default=False,
        ),
    ] = None,
    api_key: Annotated[
        str | None,
        typer.Option(
            "--api-key", envvar="STREETFIX_API_KEY", help="API key, if the service requires one.", show_default=False
        ),
    ] = None,
    ca: Ca = None,
    cert: Cert = None,
    key: Key = None,
    try_focal: Annotated[
        bool | None,
        typer.Option(
            "--try-focal/--no-try-focal",
            help="If the answer is not LOCALIZED, or the camera seems to be at half or twice the usual height, send the query "
            "twice more, with fx and fy halved and doubled. Report a factor that fits better. Not with --batch.  "
            "[default: try-focal; off for --batch]",
            show_default=False,
        ),
    ] = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print the answer as the service sent it. --try-focal adds focal_length_factor if it ran (null: neither fits).",
        ),
    ] = False,
) -> None:
    """Send a query to a service, and print the pose.

    A query is a colour image and a depth image. With --sequence it has several image pairs with known relative poses.
    With --batch the command sends many independent queries.

    A file for --sequence looks as follows. Paths are relative to the file. "camera" and "depth" may also be in each frame.
    T_odometry_camera in all frames replaces T_reference_camera.

    \b
      {"camera": {"width": 640, "height": 480,
                  "fx": 320, "fy": 320, "cx": 319.5, "cy": 239.5},
       "depth": {"scale_m": 0.001},
       "frames": [
         {"rgb_file": "0.jpg", "depth_file": "0.png"},
         {"rgb_file": "1.jpg", "depth_file": "1.png",
          "T_reference_camera": {
            "position": {"x": 0, "y": 0, "z": 1},
            "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}}]}

    A file for --batch has "requests" instead of "frames", without these poses.

    \b
    Exit codes:
      0  the answer is LOCALIZED (--batch: all are)
      1  an error (--batch: also if the service refused a pair)
      2  wrong options
      3  the answer is AMBIGUOUS or OUT_OF_MAP (--batch: at least one is)

    With exit code 3 there is no pose. The command then says what to check, the likeliest cause first.

    \b
    Examples:
      streetfix localize --url http://127.0.0.1:8000 --rgb 0.jpg --depth 0.png --camera camera.json --near 12,-40
      streetfix localize --sequence sequence.json
      streetfix localize --batch batch.json --json
    """
    _check_choice(rgb=rgb, depth=depth, camera=camera, sequence=sequence, batch=batch, try_focal=try_focal)
    connection = Connection(url, api_key, ca, cert, key)
    overrides = Overrides(
        map_name, _prior(near, heading), camera_height, camera_height_std, false_accept_rate=false_accept_rate
    )
    if batch is not None:
        _answer_batch(connection, batch, overrides, as_json=as_json)
        return

    def ask(focal_factor: float) -> dict[str, Any]:
        changed = replace(overrides, focal_factor=focal_factor)
        if sequence is not None:
            return localize_sequence(connection, sequence, changed)
        assert rgb is not None and depth is not None and camera is not None  # noqa: S101, PT018  # `_check_choice` has refused it
        return localize_pair(connection, rgb, depth, camera, changed)

    answer = ask(1.0)
    if try_focal is not False and (answer["status"] != "LOCALIZED" or _has_suspicious_height(answer)):
        answer["focal_length_factor"] = _fitting_factor(answer, ask)
    if as_json:
        typer.echo(json.dumps(answer))
    else:
        from service.cli.answer_text import print_answer

        print_answer(answer)
    if answer["status"] != "LOCALIZED":
        raise typer.Exit(NOT_LOCALIZED)


def _check_choice(
    *,
    rgb: Path | None,
    depth: Path | None,
    camera: Path | None,
    sequence: Path | None,
    batch: Path | None,
    try_focal: bool | None,
) -> None:
    """Refuse options that do not belong together."""
    single = {"--rgb": rgb, "--depth": depth, "--camera": camera}
    several = {"--sequence": sequence, "--batch": batch}
    given = [option for option, value in several.items() if value is not None]
    if len(given) > 1:
        raise typer.BadParameter("--sequence and --batch exclude each other")
    if given:
        for option, value in single.items():
            if value is not None:
                raise typer.BadParameter(
                    f"{option} and {given[0]} exclude each other: the file of {given[0]} names the images"
                )
        if batch is not None and try_focal:
            raise typer.BadParameter("--try-focal and --batch exclude each other")
        return
    missing = [option for option, value in single.items() if value is None]
    if missing:
        why = " (every query needs a depth image of the same moment)" if "--depth" in missing else ""
        raise typer.BadParameter(f"missing {', '.join(missing)}{why}; or give --sequence FILE or --batch FILE")


def _answer_batch(connection: Connection, path: Path, overrides: Overrides, *, as_json: bool) -> None:
    """Send a batch, and print the outcomes. If the connection fails, those that came before are printed."""
    from service.cli.answer_text import print_outcomes

    pairs, outcomes = read_batch(path), list[dict[str, Any]]()
    try:
        for answered in localize_batch(connection, path, pairs, overrides):
            outcomes += answered
            typer.echo(f"streetfix: {len(outcomes)} of {len(pairs)} pairs answered", err=True)
    finally:
        if as_json:
            typer.echo(json.dumps({"outcomes": outcomes}))
        elif outcomes:
            print_outcomes([pair.rgb.name for pair in pairs], outcomes)
    if any(each["problem"] is not None for each in outcomes):
        raise typer.Exit(1)
    if any(each["answer"]["status"] != "LOCALIZED" for each in outcomes):
        raise typer.Exit(NOT_LOCALIZED)


def _has_suspicious_height(answer: dict[str, Any]) -> bool:
    from service.imaging.level import is_suspicious_height

    height = answer.get("camera_height")  # an older service sends none
    return height is not None and is_suspicious_height(height["height_m"], height["origin"])


def _fitting_factor(answer: dict[str, Any], ask: Callable[[float], dict[str, Any]]) -> float | None:
    """Return the factor of fx and fy that fits the map clearly better than the given camera; None if there is none."""
    from service.confidence.reasons import FOCAL_FACTORS, GAIN_OF_ONE

    before, best, most = _support(answer), None, (False, GAIN_OF_ONE)
    for factor in FOCAL_FACTORS:
        try:
            changed = ask(factor)
        except StreetfixError as error:  # the first answer stays valid
            typer.echo(f"streetfix: fx and fy times {factor:g} could not be tried: {error}", err=True)
            continue
        gained = _support(changed) - before
        fit = (changed["status"] == "LOCALIZED" and gained > 0, gained)
        if fit >= most:
            best, most = factor, fit
    return best


def _support(answer: dict[str, Any]) -> float:
    """Return the support of the first hypothesis, nats; 0 if nothing could be registered."""
    from service.confidence.reasons import support_of

    return max((support_of(each["inliers"], each["similarity"]) for each in answer["hypotheses"][:1]), default=0.0)


def _prior(near: str | None, heading_deg: float | None) -> dict[str, Any] | None:
    found: dict[str, Any] = {} if heading_deg is None else {"heading_deg": heading_deg}
    if near is not None:
        try:
            numbers = [float(part) for part in near.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3):
            raise RequestError(f"--near: {near!r} is not X,Y or X,Y,STD in metres, such as 12,-40,20", field="near")
        found["position"] = dict(zip(("x", "y", "std_m"), numbers, strict=False))
    return found or None
