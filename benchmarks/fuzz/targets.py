"""Parsers of untrusted input: each target takes any bytes and may raise only the project's own errors."""

import contextlib
import hashlib
import json
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from pydantic import ValidationError

from benchmarks.fuzz.grpc_bytes import SEEDS as GRPC_SEEDS
from benchmarks.fuzz.grpc_bytes import GrpcCalls
from benchmarks.fuzz.http_bytes import SEEDS, Connections
from service.contract import schema
from service.contract.convert import parsed, query_from, sequence_from
from service.contract.oscp import GeoPoseRequest, query_of
from service.errors import StreetfixError
from service.geometry.camera import PinholeCamera
from service.http.body import split_multipart
from service.imaging.decode import DepthEncoding, DepthKind, ImageLimits, decode_depth, decode_rgb
from service.imaging.depth_units import depth_from_values
from service.imaging.raw16 import write_raw16
from service.localization.localizer import Localizer
from service.maps.manifest import FILE as MANIFEST_FILE
from service.maps.manifest import Manifest, read_manifest
from service.maps.reader import MapBundle
from service.retrieval.query import Query

LIMITS = ImageLimits(max_bytes=2**20, max_pixels=2**20)
CAMERA = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
_DOCUMENT = {
    "camera": {
        "width": 64,
        "height": 48,
        "fx": 32,
        "fy": 32,
        "cx": 31.5,
        "cy": 23.5,
        "height_m": 0.3,
        "height_std_m": 0.02,
        "distortion": [-0.1, 0.02, 0.001, 0],
        "distortion_model": "brown_conrady",
    },
    "depth": {"scale_m": 0.001, "kind": "disparity", "encoding": "auto", "baseline_m": 0.12, "max_range_m": 40},
    "gravity": {"x": 0, "y": 9.8, "z": 0.1},
    "map": "tiny@1",
    "options": {"neighbours": 5, "refine": True, "false_accept_rate": 0.01},
    "prior": {"position": {"x": 1, "y": 2, "std_m": 3}, "heading_deg": 10, "heading_std_deg": 20},
}


@dataclass(frozen=True)
class Target:
    """One fuzz target.

    Attributes:
        take: handles the bytes; an unexpected exception is a finding.
        seeds: valid inputs that the fuzzer mutates.
        share: share of all inputs; slow targets get fewer.
    """

    take: Callable[[bytes], object]
    seeds: tuple[bytes, ...]
    share: float


def targets(bundle: Path, scratch: Path) -> dict[str, Target]:
    """Return all targets by name.

    Args:
        bundle: a small valid map.
        scratch: folder for damaged copies of it.
    """
    rng = np.random.default_rng(0)
    depth = (rng.integers(0, 4, (48, 64)) * 1000 + 2000).astype(np.uint16)
    rgb = rng.integers(0, 255, (48, 64, 3)).astype(np.uint8)
    request = json.dumps(_DOCUMENT).encode()
    frame = {key: value for key, value in _DOCUMENT.items() if key in ("camera", "depth", "gravity")}
    T = {"position": {"x": 0, "y": 0, "z": -1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    vehicle = {"T_vehicle_camera": T | {"position": {"x": 0, "y": 0, "z": 1.5}}, "vehicle_base_on_ground": True}
    sequence = json.dumps(vehicle | {"frames": [frame, frame | {"T_reference_camera": T}]}).encode()
    multipart = (
        b"--b\r\n"
        + b"\r\n--b\r\n".join(
            f'Content-Disposition: form-data; name="{name}"; filename="x"\r\n\r\n'.encode() + data
            for name, data in (("rgb", b"123"), ("depth", b"456"), ("request", b"{}"))
        )
        + b"\r\n--b--\r\n"
    )
    return {
        "http": Target(Connections().take, SEEDS, 0.10),
        "multipart": Target(_multipart, (multipart,), 0.20),
        "request_json": Target(_request, (request,), 0.18),
        "sequence_json": Target(_sequence, (sequence,), 0.06),
        "oscp_json": Target(_oscp, (_oscp_seed(),), 0.06),
        "grpc": Target(GrpcCalls(bundle).take, GRPC_SEEDS, 0.15),
        "depth": Target(_depth, (*_depth_seeds(depth),), 0.14),
        "depth_png_rows": Target(_png_rows, (_rows_of(depth[:12, :16]),), 0.05),
        "colour": Target(lambda data: decode_rgb(data, limits=LIMITS), (*_colour_seeds(rgb),), 0.04),
        "bundle": Target(_bundle_of(bundle, scratch), (b"\x00\x00\x00\x00", b"\x05\x00\x00\x00"), 0.005),
        "pictures": Target(
            _pictures_of(bundle),
            (
                struct.pack("<13d", 32, 32, 31.5, 23.5, 9.8, 0.1, 1.5, 0.1, 0, 0, 0, 0, 0)
                + _tiny_query().depth_m.tobytes(),
                struct.pack("<13d", 32, 32, 31.5, 23.5, 9.8, 0.1, 0, 0.1, 1, -0.1, 0.02, 0.001, 0)
                + _tiny_query().depth_m.tobytes(),
                struct.pack("<13d", 32, 32, 31.5, 23.5, 9.8, 0.1, 0, 0.1, -1, 0.01, 0, 0, 0)
                + _tiny_query().depth_m.tobytes(),
            ),
            0.015,
        ),
    }


def survives(take: Callable[[bytes], object], data: bytes) -> None:
    """Run a target on an input; the project's own errors are allowed.

    Args:
        take: function of the target.
        data: the input.
    """
    with contextlib.suppress(StreetfixError):
        take(data)


def _multipart(data: bytes) -> None:
    first, _, rest = data.partition(b"\n")
    kind = "multipart/form-data; boundary=b" if data.startswith(b"--b") else first.decode("latin-1")[:200]
    split_multipart(bytearray(data if data.startswith(b"--b") else rest), kind, max_parts=8)


def _request(data: bytes) -> None:
    query_from(parsed(data, schema.LocalizeRequest), rgb=b"", depth=b"")


def _sequence(data: bytes) -> None:
    request = parsed(data, schema.SequenceRequest)
    sequence_from(request, [(b"", b"")] * len(request.frames))


def _oscp(data: bytes) -> None:
    with contextlib.suppress(ValidationError):  # the route turns it into a problem
        query_of(parsed(data, GeoPoseRequest), None)


def _depth(data: bytes) -> None:
    """Decode a depth image; the first byte chooses the format."""
    if not data:
        return
    how, data = data[0], data[1:]
    kind: DepthKind = ("z", "range", "disparity")[how % 3]
    encoding: DepthEncoding = "carla" if how & 8 else "compressed_depth" if how & 64 else "auto"
    decode_depth(
        data,
        camera=CAMERA,
        encoding=encoding,
        scale_m=0.001 if how & 16 else None,
        kind=kind,
        baseline_m=0.1,
        max_range_m=40.0 if how & 32 else None,
        limits=LIMITS,
    )


def _depth_seeds(depth: np.ndarray) -> list[bytes]:
    metres = (depth / 1000).astype(np.float32)
    npy = (
        b"\x93NUMPY\x01\x00"
        + struct.pack("<H", 118)
        + b"{'descr': '<f4', 'fortran_order': False, 'shape': (48, 64), }".ljust(117)
        + b"\n"
    )
    colour = np.dstack([depth & 255, depth >> 8, 0 * depth]).astype(np.uint8)
    good = [
        (b"\x00", _encoded(".png", depth)),
        (b"\x30", _encoded(".tiff", metres)),
        (b"\x01", npy + metres.tobytes()),
        (b"\x02", write_raw16(depth)),
        (b"\x02", write_raw16(depth, "lz4")),
        (b"\x08", _encoded(".png", colour)),
        (b"\x40", bytes(12) + _encoded(".png", depth)),
        (b"\x40", bytes(12) + struct.pack("<ii", 64, 48) + b"\x00\x00\x86\x88"),
    ]
    return [how + data for how, data in good]


def _colour_seeds(rgb: np.ndarray) -> list[bytes]:
    return [_encoded(name, rgb) for name in (".jpg", ".png", ".webp")]


def _encoded(name: str, picture: np.ndarray) -> bytes:
    return cv2.imencode(name, picture)[1].tobytes()


def _rows_of(depth: np.ndarray) -> bytes:
    height, width = depth.shape
    return struct.pack(">BB", height, width) + b"".join(
        bytes([y % 5]) + depth[y].astype(">u2").tobytes() for y in range(height)
    )


def _png_rows(data: bytes) -> None:
    """Decode PNG rows with correct checksums, which random mutation does not reach."""
    if len(data) < 2:
        return

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", data[1], data[0], 16, 0, 0, 0, 0)
    png = (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data[2:], 1)) + chunk(b"IEND", b"")
    )
    decode_depth(png, camera=CAMERA, limits=LIMITS)


def _oscp_seed() -> bytes:
    camera = {
        "sensorId": "c",
        "timestamp": 1,
        "privacy": {},
        "sequenceNumber": 1,
        "imageFormat": "RGBA32",
        "size": [64, 48],
        "imageBytes": "AAAA",
        "params": {"model": "PINHOLE", "modelParams": [32, 32, 31.5, 23.5]},
    }
    depth = camera | {"imageFormat": "DEPTH", "sensorId": "d"}
    readings = {"cameraReadings": [camera, depth], "accelerometerReadings": [{"x": 0, "y": 9.8, "z": 0}]}
    return json.dumps(
        {"id": "1", "timestamp": "1", "type": "geopose", "sensors": [], "sensorReadings": readings}
    ).encode()


def _bundle_of(bundle: Path, scratch: Path) -> Callable[[bytes], None]:
    """Change one file of a bundle and make the manifest agree, as a forger would; what opens must answer or refuse."""
    files = sorted(path.relative_to(bundle) for path in bundle.rglob("*") if path.is_file())
    pristine = {name: (bundle / name).read_bytes() for name in files}
    own = scratch / "bundle"
    shutil.copytree(bundle, own, dirs_exist_ok=True)
    query = _tiny_query()

    def take(data: bytes) -> None:
        if len(data) < 4:
            return
        name = files[data[0] % len(files)]
        content = bytearray(pristine[name])
        at = struct.unpack("<I", data[:4])[0] // 256 % len(content)
        content[at : at + len(data) - 4] = data[4:]
        try:
            (own / name).write_bytes(content)
            if name.name != MANIFEST_FILE:
                _agree(own, name, bytes(content))
            Localizer.open(MapBundle.open(own)).localize(query)
        finally:
            for each in {name, Path(MANIFEST_FILE)}:
                (own / each).write_bytes(pristine[each])

    return take


def _agree(own: Path, name: Path, content: bytes) -> None:
    """Write the file's new hash and size into the manifest."""
    manifest = read_manifest(own)
    document = manifest.model_dump(mode="json")
    document["files"][name.as_posix()] = {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content)}
    (own / MANIFEST_FILE).write_bytes(Manifest.model_validate(document).stamped().to_bytes())


def _pictures_of(bundle: Path) -> Callable[[bytes], None]:
    """Localize with arbitrary intrinsics, lens, gravity, camera height and depth that pass validation."""
    localizer = Localizer.open(MapBundle.open(bundle))
    good = _tiny_query()

    def take(data: bytes) -> None:
        if len(data) < 112:
            return
        fx, fy, cx, cy, down, aside, height_m, height_std_m, lens, *distortion = struct.unpack("<13d", data[:104])
        height = {"height_m": height_m, "height_std_m": height_std_m} if height_m > 0 else {}  # else it is found
        model = {"distortion": distortion, "distortion_model": "brown_conrady" if lens > 0 else "kannala_brandt"}
        document = {
            "camera": {"width": 64, "height": 48, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
            | height
            | (model if lens else {}),
            "gravity": {"x": aside, "y": down, "z": 0.0},
        }
        try:
            request = schema.LocalizeRequest.model_validate(document)
        except ValidationError:
            return
        asked = query_from(request, rgb=b"", depth=b"")
        raw = np.frombuffer(data[104 : 104 + (len(data) - 104) // 4 * 4], np.float32)
        depth_m = depth_from_values(
            np.resize(raw, (48, 64)), scale_m=1.0, kind="z", camera=asked.camera, baseline_m=None, max_range_m=None
        )
        query = Query.of_images(good.rgb, depth_m, asked.camera)
        localizer.localize(replace(query, down_camera=asked.down_camera, camera_height=asked.camera_height))

    return take


def _tiny_query() -> Query:
    rng = np.random.default_rng(3)
    down = np.maximum((np.arange(48) - CAMERA.cy) / CAMERA.fy, 1e-6)[:, None]
    walls = np.repeat(rng.uniform(4, 15, 16), 4)[None, :].repeat(48, axis=0)
    depth_m = np.minimum(walls, 1.5 / down).astype(np.float32)
    return Query(rgb=rng.integers(0, 256, (48, 64, 3)).astype(np.uint8), depth_m=depth_m, camera=CAMERA)
