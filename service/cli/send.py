"""Send image pairs from files to a running service: one query, a sequence, or a batch."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from service.cli.pair_files import ImagePair, read_sequence
from service.errors import BundleError, RefusedError, RequestError, UnreachableError

A = TypeVar("A")
_TIMEOUT_S = 60.0
#: Most pairs in one request of a batch: half of what the contract allows, so that progress is reported more often.
_PAIRS_A_REQUEST = 8
#: Most bytes of images in one request of a batch. The service accepts bodies of 40 MiB by default.
_BYTES_A_REQUEST = 32 * 2**20


@dataclass(frozen=True, slots=True)
class Connection:
    """How to reach a service.

    Attributes:
        url: of the service, without a path.
        api_key: if the service requires one.
        ca: PEM file of the authorities of the service's certificate, as in ``Client``.
        cert: PEM file of the client's certificate.
        key: PEM file of the client's private key.
    """

    url: str
    api_key: str | None = None
    ca: Path | None = None
    cert: Path | None = None
    key: Path | None = None


@dataclass(frozen=True, slots=True)
class Overrides:
    """Options that override fields of a request.

    Attributes:
        map_name: name of the map.
        prior: as in the REST contract.
        camera_height_m: height of the camera above the ground, metres.
        camera_height_std_m: standard deviation of the height, metres.
        focal_factor: multiplies fx and fy.
        false_accept_rate: tolerated share of out-of-map queries that become LOCALIZED, 0 to 1.
    """

    map_name: str | None = None
    prior: dict[str, Any] | None = None
    camera_height_m: float | None = None
    camera_height_std_m: float | None = None
    focal_factor: float = 1.0
    false_accept_rate: float | None = None

    def on_camera(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return a request or a frame with the height and the focal length.

        Args:
            request: it contains ``camera``.

        Raises:
            RequestError: there is a standard deviation of the height, but no height.
        """
        return request | {"camera": _with_height(_scaled(request["camera"], self.focal_factor), self)}

    def on_request(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return a request with the map, the prior and the false-accept rate.

        Args:
            request: of a single query or of a sequence.
        """
        given: dict[str, Any] = {"map": self.map_name, "prior": self.prior}
        options = request.get("options") or {}
        if self.false_accept_rate is not None and isinstance(
            options, dict
        ):  # the service checks what a file has instead
            given["options"] = options | {"false_accept_rate": self.false_accept_rate}
        return request | {name: value for name, value in given.items() if value is not None}


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
        RequestError: a file cannot be read, the camera file is not a JSON object, the URL is invalid, the map's name is that of a
            folder, or a standard deviation is given without a height.
        KeysError: a TLS file cannot be used.
        UnreachableError: nothing answers at the address, or the answer is not from Streetfix.
        RefusedError: the service answered with a problem.
    """
    overrides = Overrides(map_name, prior, camera_height_m, camera_height_std_m, focal_factor)
    return localize_pair(Connection(url, api_key, ca, cert, key), rgb, depth, camera, overrides)


def localize_pair(connection: Connection, rgb: Path, depth: Path, camera: Path, overrides: Overrides) -> dict[str, Any]:
    """Send an image pair to a service and return its answer.

    Args:
        connection: how to reach the service.
        rgb: file of the RGB image.
        depth: file of the depth image.
        camera: JSON file with the parts of the request: camera, depth, gravity and so on.
        overrides: options.

    Raises:
        StreetfixError: as ``localize``.
    """
    request = overrides.on_request(overrides.on_camera(_camera_parts(camera)))
    images = {"rgb": (rgb.name, _bytes_of(rgb, "rgb")), "depth": (depth.name, _bytes_of(depth, "depth"))}
    # No retries: the user of a command wants the result at once.
    return _send(connection, "/v1/localize", images, request, _answer, overrides, attempts=1)


def localize_sequence(connection: Connection, path: Path, overrides: Overrides) -> dict[str, Any]:
    """Send a sequence to a service and return its answer: the pose of the first frame.

    Args:
        connection: how to reach the service.
        path: JSON file, see ``read_sequence``.
        overrides: options. The height and the focal factor hold for all frames.

    Raises:
        RequestError: a file cannot be read, or the service refused a field of the file. The message names the file and the field.
        StreetfixError: as ``localize``.
    """
    sequence = read_sequence(path)
    frames = [overrides.on_camera(pair.request) for pair in sequence.pairs]
    request = overrides.on_request(sequence.about | {"frames": frames})
    images = _numbered([(pair, *_images_of(path, pair)) for pair in sequence.pairs])
    with _naming(path, 0):
        return _send(connection, "/v1/localize/sequence", images, request, _answer, overrides, attempts=1)


def localize_batch(
    connection: Connection, path: Path, pairs: list[ImagePair], overrides: Overrides
) -> Iterator[list[dict[str, Any]]]:
    """Send independent pairs to a service in several requests, and yield the outcomes of each request.

    Args:
        connection: how to reach the service.
        path: JSON file of the pairs, for errors.
        pairs: see ``read_batch``.
        overrides: options for all pairs.

    Yields:
        The next outcomes in the order of the pairs. Each has ``answer`` and ``problem``, as in the REST contract; one is None.

    Raises:
        RequestError: a file cannot be read, or the service refused a field of the file. The message names the file and the field.
        StreetfixError: as ``localize``, after retries.
    """
    first = 0
    for part in _parts_of(path, pairs):
        requests = [overrides.on_request(overrides.on_camera(pair.request)) for pair, _, _ in part]

        def read(body: bytes, first: int = first, count: int = len(part)) -> list[dict[str, Any]]:
            return _outcomes(body, first, count)

        with _naming(path, first):
            yield _send(
                connection,
                "/v1/localize/batch",
                _numbered(part),
                {"requests": requests},
                read,
                overrides,
                attempts=None,
            )
        first += len(part)


#: An image pair and the bytes of its files.
_Loaded = tuple[ImagePair, bytes, bytes]


def _parts_of(path: Path, pairs: list[ImagePair]) -> Iterator[list[_Loaded]]:
    """Read the images, and yield the pairs of each request."""
    part, size = list[_Loaded](), 0
    for pair in pairs:
        loaded = (pair, *_images_of(path, pair))
        length = len(loaded[1]) + len(loaded[2])
        if part and (len(part) == _PAIRS_A_REQUEST or size + length > _BYTES_A_REQUEST):
            yield part
            part, size = [], 0
        part.append(loaded)
        size += length
    yield part


def _images_of(path: Path, pair: ImagePair) -> tuple[bytes, bytes]:
    found = []
    for file, field in ((pair.rgb, "rgb_file"), (pair.depth, "depth_file")):
        try:
            found.append(file.read_bytes())
        except OSError as error:
            name = f"{pair.name}.{field}"
            raise RequestError(f"{path}: {name}: {file} cannot be read ({error.strerror})", field=name) from error
    return found[0], found[1]


def _numbered(part: list[_Loaded]) -> dict[str, tuple[str, bytes]]:
    images: dict[str, tuple[str, bytes]] = {}
    for number, (pair, rgb, depth) in enumerate(part):
        images |= {f"rgb{number}": (pair.rgb.name, rgb), f"depth{number}": (pair.depth.name, depth)}
    return images


@contextmanager
def _naming(path: Path, first: int) -> Iterator[None]:
    """Name the file, and the number of the pair in it, if the service refuses a whole request.

    Args:
        path: of the file.
        first: number of the request's first pair in the file.
    """
    try:
        yield
    except RefusedError as error:
        if not error.field.startswith(("frames", "requests", "rgb", "depth")):
            raise
        raise RequestError(
            f"{path}: {_renumbered(error.message, first)}", field=_renumbered(error.field, first)
        ) from error


def _renumbered(text: str, first: int) -> str:
    """Replace numbers of pairs in a request by their numbers in the file."""
    return re.sub(r"\b(requests\.|rgb|depth)(\d+)", lambda match: f"{match[1]}{int(match[2]) + first}", text)


def _send(
    connection: Connection,
    path: str,
    images: dict[str, tuple[str, bytes]],
    request: dict[str, Any],
    read: Callable[[bytes], A],
    overrides: Overrides,
    *,
    attempts: int | None,
) -> A:
    """Send a request. ``attempts`` None: the default retries."""
    from service.client import Client, RetryPolicy, rest

    files = {name: (file, data, "application/octet-stream") for name, (file, data) in images.items()}
    files["request"] = ("request.json", json.dumps(request).encode(), "application/json")
    retry = RetryPolicy() if attempts is None else RetryPolicy(attempts=attempts)
    with Client(
        connection.url,
        api_key=connection.api_key,
        timeout_s=_TIMEOUT_S,
        retry=retry,
        ca=connection.ca,
        cert=connection.cert,
        key=connection.key,
    ) as client:
        try:
            return client.call(rest.Call("POST", path, read, files))
        except (RefusedError, UnreachableError) as error:
            about_map = isinstance(error, UnreachableError) or error.field.endswith("map")
            if about_map and overrides.map_name is not None and (wrong := _folder_for_a_name(overrides.map_name)):
                detail = error.detail if isinstance(error, RefusedError) else error.message
                raise RequestError(f"{wrong}\n  {detail}", field="map") from error
            raise


def _scaled(camera: Any, focal_factor: float) -> Any:
    """Return a camera with another focal length. The first query is sent unchanged, so that the service checks it."""
    if focal_factor == 1.0:
        return camera
    return camera | {name: float(camera[name]) * focal_factor for name in ("fx", "fy")}


def _with_height(camera: Any, overrides: Overrides) -> Any:
    """Return the camera of a request with the height of the options. The service checks the values.

    Raises:
        RequestError: there is a standard deviation, but neither the options nor the camera file give a height.
    """
    height_m, std_m = overrides.camera_height_m, overrides.camera_height_std_m
    if (height_m is None and std_m is None) or not isinstance(camera, dict):
        return camera
    if height_m is None and camera.get("height_m") is None:
        raise RequestError(
            "--camera-height-std: it needs a height; give --camera-height, or height_m of the camera in the file",
            field="camera_height_std",
        )
    given = {"height_m": height_m, "height_std_m": std_m}
    return camera | {name: value for name, value in given.items() if value is not None}


def _folder_for_a_name(map_name: str) -> str:
    """Say what is wrong if the name of a map is a folder of this machine; empty if there is no such folder."""
    from service.maps.manifest import DATASET_FILE, read_manifest

    folder = Path(map_name)
    if not folder.is_dir():
        return ""
    if (folder / DATASET_FILE).is_file():
        return f"--map: {map_name} is a dataset, not a map; give the name of a map of the service"
    try:
        name = read_manifest(folder).name
    except BundleError:
        return f"--map: {map_name} is a folder; give the name of a map of the service"
    return f"--map: {map_name} is the folder of a map bundle; give the name of the map: --map {name}"


def _answer(body: bytes) -> dict[str, Any]:
    """Parse an answer without changes, with any unknown fields of a newer service.

    Raises:
        ValueError: the body is not an answer.
    """
    return _checked(json.loads(body))


def _checked(answer: Any) -> dict[str, Any]:
    if (
        not isinstance(answer, dict)
        or "status" not in answer
        or (answer["status"] == "LOCALIZED") != bool(answer.get("pose"))
    ):
        raise ValueError("not an answer")
    return answer


def _outcomes(body: bytes, first: int, count: int) -> list[dict[str, Any]]:
    """Parse the outcomes of a batch. Numbers of pairs in problems become those of the file.

    Args:
        body: the JSON text.
        first: number of the request's first pair in the file.
        count: number of pairs in the request.

    Raises:
        ValueError: the body does not have ``count`` outcomes.
    """
    document = json.loads(body)
    outcomes = document.get("outcomes") if isinstance(document, dict) else None
    if not isinstance(outcomes, list) or len(outcomes) != count:
        raise ValueError("not the outcomes of a batch")
    for outcome in outcomes:
        if not isinstance(outcome, dict):
            raise ValueError("not an outcome")
        outcome.setdefault("answer", None)
        outcome.setdefault("problem", None)
        if outcome["answer"] is not None:
            _checked(outcome["answer"])
        elif not isinstance(problem := outcome["problem"], dict):
            raise ValueError("neither an answer nor a problem")
        else:
            renamed = ((name, problem.get(name)) for name in ("field", "detail"))
            problem |= {name: _renumbered(text, first) for name, text in renamed if isinstance(text, str)}
    return outcomes


def _camera_parts(path: Path) -> dict[str, Any]:
    try:
        parts = json.loads(_bytes_of(path, "camera"))
    except (ValueError, RecursionError) as error:
        raise RequestError(f"{path}: not valid JSON ({error})", field="camera") from error
    if not isinstance(parts, dict) or "camera" not in parts:
        raise RequestError(f'{path}: expected an object like {{"camera": {{"width": 640, ...}}}}', field="camera")
    return parts


def _bytes_of(path: Path, field: str) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RequestError(f"{path}: cannot be read ({error.strerror}); check --{field}", field=field) from error
