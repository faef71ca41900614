"""``streetfix localize``: ask a running service, print its answer for people or programs."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.tls_options import Ca, Cert, Key
from service.errors import BundleError, RefusedError, RequestError, StreetfixError

_TIMEOUT_S = 60.0
#: Exit code for an answer that is not LOCALIZED, so that a script does not take it for a pose. 1 and 2 are errors.
NOT_LOCALIZED = 3


def command(
    rgb: Annotated[Path, typer.Option(help="Colour image: JPEG, PNG or WebP.", show_default=False)],
    depth: Annotated[Path, typer.Option(help="Depth image: 16-bit PNG, TIFF, NPY or SFD1.", show_default=False)],
    camera: Annotated[
        Path, typer.Option(help='JSON file: {"camera": {...}, "depth": {...}, "gravity": {...}}.', show_default=False)
    ],
    url: Annotated[str, typer.Option(help="URL of the service.")] = "http://127.0.0.1:8000",
    map_name: Annotated[
        str | None, typer.Option("--map", help="Map to ask. Required if the service has several.")
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
        bool,
        typer.Option(
            "--try-focal/--no-try-focal",
            help="If the answer is not LOCALIZED, or the camera seems to be at half or twice the usual height, ask twice "
            "more, with fx and fy halved and doubled. Report a factor that fits better.",
        ),
    ] = True,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json",
            help="Print the answer as it came. --try-focal adds focal_length_factor if it ran (null: neither fits).",
        ),
    ] = False,
) -> None:
    """Ask a service for the pose of one query.

    A query is a colour image and a depth image.

    \b
    Exit codes:
      0  the answer is LOCALIZED
      1  an error
      2  wrong options
      3  the answer is AMBIGUOUS or OUT_OF_MAP

    With exit code 3 there is no pose. The command then says what to check, the likeliest cause first.

    \b
    Example:
      streetfix localize --url http://127.0.0.1:8000 --rgb 0.jpg --depth 0.png --camera camera.json --near 12,-40
    """
    prior = _prior(near, heading)

    def ask(focal_factor: float) -> dict[str, Any]:
        return localize(
            url, rgb=rgb, depth=depth, camera=camera, map_name=map_name, prior=prior, api_key=api_key, ca=ca, cert=cert, key=key,
            focal_factor=focal_factor, camera_height_m=camera_height, camera_height_std_m=camera_height_std,
        )  # fmt: skip

    answer = ask(1.0)
    if try_focal and (answer["status"] != "LOCALIZED" or _has_suspicious_height(answer)):
        answer["focal_length_factor"] = _fitting_factor(answer, ask)
    if as_json:
        typer.echo(json.dumps(answer))
    else:
        from service.cli.answer_text import print_answer

        print_answer(answer)
    if answer["status"] != "LOCALIZED":
        raise typer.Exit(NOT_LOCALIZED)


def _has_suspicious_height(answer: dict[str, Any]) -> bool:
    from service.imaging.level import is_suspicious_height

    told = answer.get("camera_height")  # an older service sends none
    return told is not None and is_suspicious_height(told["height_m"], told["origin"])


def _fitting_factor(answer: dict[str, Any], ask: Callable[[float], dict[str, Any]]) -> float | None:
    """Factor of fx and fy that fits the map clearly better than the given camera; None if there is none."""
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
    """Support of the first hypothesis in nats; 0 if nothing could be registered."""
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


def localize(
    url: str,
    *,
    rgb: Path,
    depth: Path,
    camera: Path,
    map_name: str | None = None,
    prior: dict[str, Any] | None = None,
    api_key: str | None = None,
    ca: Path | None = None,
    cert: Path | None = None,
    key: Path | None = None,
    focal_factor: float = 1.0,
    camera_height_m: float | None = None,
    camera_height_std_m: float | None = None,
) -> dict[str, Any]:
    """Send an image pair to a service and return its answer.

    Args:
        url: of the service, without a path.
        rgb: file of the RGB image.
        depth: file of the depth image.
        camera: JSON file with the parts of the request: camera, depth, gravity and so on.
        map_name: name of the map; overrides the file.
        prior: as in the REST contract; overrides the file.
        api_key: if the service requires one.
        ca: PEM file of the authorities of the service's certificate, as in ``Client``.
        cert: PEM file of the client's certificate.
        key: PEM file of the client's private key.
        focal_factor: multiplies fx and fy of the camera file.
        camera_height_m: height of the camera above the ground, metres; overrides ``height_m`` of the camera file.
        camera_height_std_m: standard deviation of the height, metres; overrides the file.

    Raises:
        RequestError: a file cannot be read, the camera file is no JSON object, the URL is invalid, the map's name is that of a
            folder, or a standard deviation is given without a height.
        KeysError: a TLS file cannot be used.
        UnreachableError: nothing answers at the address, or the answer is not from Streetfix.
        RefusedError: the service answered with a problem.
    """
    from service.client import Client, RetryPolicy, rest

    request = _camera_parts(camera, focal_factor) | ({} if map_name is None else {"map": map_name})
    request["camera"] = _with_height(request["camera"], camera_height_m, camera_height_std_m)
    request |= {} if prior is None else {"prior": prior}
    files = {
        "rgb": (rgb.name, _bytes_of(rgb, "rgb"), "application/octet-stream"),
        "depth": (depth.name, _bytes_of(depth, "depth"), "application/octet-stream"),
        "request": ("request.json", json.dumps(request).encode(), "application/json"),
    }
    # No retries: the user of a command wants the result at once.
    patience = RetryPolicy(attempts=1)
    with Client(url, api_key=api_key, timeout_s=_TIMEOUT_S, retry=patience, ca=ca, cert=cert, key=key) as client:
        try:
            return client.call(rest.Call("POST", "/v1/localize", _answer, files))
        except RefusedError as error:
            if error.field == "map" and map_name is not None and (wrong := _folder_for_a_name(map_name)):
                raise RequestError(f"{wrong}\n  {error.detail}", field="map") from error
            raise


def _with_height(camera: Any, height_m: float | None, std_m: float | None) -> Any:
    """Return the camera of a request with the height of the options. The service checks the values.

    Raises:
        RequestError: there is a standard deviation, but neither the options nor the camera file give a height.
    """
    if (height_m is None and std_m is None) or not isinstance(camera, dict):
        return camera
    if height_m is None and camera.get("height_m") is None:
        raise RequestError(
            "--camera-height-std: there is no height that it belongs to; give --camera-height, or height_m in the camera file",
            field="camera_height_std",
        )
    given = {"height_m": height_m, "height_std_m": std_m}
    return camera | {name: value for name, value in given.items() if value is not None}


def _folder_for_a_name(map_name: str) -> str:
    """What is wrong with a map's name that names a folder of this machine; empty if there is no such folder."""
    from service.maps.manifest import DATASET_FILE, read_manifest

    folder = Path(map_name)
    if not folder.is_dir():
        return ""
    if (folder / DATASET_FILE).is_file():
        return f"--map: {map_name} is a dataset, not a map: give the name of a map that the service has"
    try:
        name = read_manifest(folder).name
    except BundleError:
        return f"--map: {map_name} is a folder: give the name of a map that the service has"
    return f"--map: {map_name} is the folder of a map bundle: give the map's name: --map {name}"


def _answer(body: bytes) -> dict[str, Any]:
    """Parse an answer without changes, with any unknown fields of a newer service.

    Raises:
        ValueError: the body is no answer.
    """
    answer = json.loads(body)
    if (
        not isinstance(answer, dict)
        or "status" not in answer
        or (answer["status"] == "LOCALIZED") != bool(answer.get("pose"))
    ):
        raise ValueError("no answer")
    return answer


def _camera_parts(path: Path, focal_factor: float) -> dict[str, Any]:
    try:
        parts = json.loads(_bytes_of(path, "camera"))
    except (ValueError, RecursionError) as error:
        raise RequestError(f"{path}: this is no JSON ({error})", field="camera") from error
    if not isinstance(parts, dict) or "camera" not in parts:
        raise RequestError(f'{path}: it must be an object like {{"camera": {{"width": 640, ...}}}}', field="camera")
    if focal_factor != 1.0:  # the first query is sent unchanged, so that the service checks it
        parts["camera"] |= {name: float(parts["camera"][name]) * focal_factor for name in ("fx", "fy")}
    return parts


def _bytes_of(path: Path, field: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RequestError(f"{path}: it cannot be read ({error.strerror}); check --{field}", field=field) from error
