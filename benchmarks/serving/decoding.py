"""Cost of each encoding of the query images: processor time to decode, and bytes to send."""

import time
from collections.abc import Callable
from statistics import mean, median

import cv2
import numpy as np

from benchmarks.report import Report
from benchmarks.serving.ratios import Site
from benchmarks.serving.rvl import write_rvl
from model_training.datasets.dataset import Dataset
from service.geometry.camera import PinholeCamera
from service.imaging.decode import decode_depth, decode_rgb
from service.imaging.depth_formats import read_depth_values
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.imaging.raw16 import write_raw16
from service.imaging.resample import finest_rad
from service.imaging.view_grid import ViewGrid
from service.runtime.threads import limit_pools

Data = list[bytes]
#: Factor of the larger camera's pixels along either side.
_TWICE = 2


def decoding_rows(report: Report, site: Site, *, rounds: int) -> None:
    """Add rows ``decode.WHAT.{cpu_ms,kib}``, the encodings interleaved; colour at 640x480 and at twice the size.

    Args:
        report: collects the rows.
        site: map and queries.
        rounds: number of measured rounds.
    """
    limit_pools()
    frames = list(Dataset(site.dataset).queries(site.queries))
    chosen = frames[:: max(1, len(frames) // site.pairs)][: site.pairs]
    camera = chosen[0].camera.pinhole()
    ways = _depth_ways([frame.depth_path.read_bytes() for frame in chosen], camera)
    ways |= _colour_ways([frame.rgb_path.read_bytes() for frame in chosen], camera)
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds + 1):  # the first round warms up
        for name, (data, decode) in ways.items():
            began = time.process_time()
            for each in data:
                decode(each)
            spent[name].append(1e3 * (time.process_time() - began) / len(data))
    for name, (data, _) in ways.items():
        report.row(f"decode.{name}.cpu_ms", median(spent[name][1:]), "ms", n=rounds)
        report.row(f"decode.{name}.kib", mean(len(each) for each in data) / 1024, "KiB", n=len(data))


def _depth_ways(stored: Data, camera: PinholeCamera) -> dict[str, tuple[Data, Callable[[bytes], object]]]:
    values = [read_depth_values(each, encoding=None, limits=DEFAULT_LIMITS) for each in stored]

    def plain(data: bytes) -> object:
        return decode_depth(data, camera=camera, scale_m=0.001)

    def ros(data: bytes) -> object:
        return decode_depth(data, camera=camera, scale_m=0.001, encoding="compressed_depth")

    def metres(data: bytes) -> object:
        return decode_depth(data, camera=camera)

    tiffs = [_encoded(".tiff", (0.001 * each).astype(np.float32)) for each in values]
    return {
        "depth.png": (stored, plain),
        "depth.raw16_zstd": ([write_raw16(each) for each in values], plain),
        "depth.raw16_lz4": ([write_raw16(each, "lz4") for each in values], plain),
        "depth.ros_png": ([bytes(12) + each for each in stored], ros),
        "depth.ros_rvl": ([bytes(12) + write_rvl(each) for each in values], ros),
        "depth.float_tiff": (tiffs, metres),
    }


def _colour_ways(stored: Data, camera: PinholeCamera) -> dict[str, tuple[Data, Callable[[bytes], object]]]:
    larger = camera.scaled_to(_TWICE * camera.width, _TWICE * camera.height)
    pictures = [_colour(each) for each in stored]
    twice = [cv2.resize(each, (larger.width, larger.height), interpolation=cv2.INTER_CUBIC) for each in pictures]
    finest = finest_rad(ViewGrid())
    return {
        "colour.jpeg": (stored, lambda data: decode_rgb(data, camera=camera, finest_rad=finest)),
        "colour.png": ([_encoded(".png", each) for each in pictures], decode_rgb),
        "colour.jpeg_twice_the_size": ([_encoded(".jpg", each) for each in twice], decode_rgb),
        "colour.jpeg_twice_the_size_as_needed": (
            [_encoded(".jpg", each) for each in twice],
            lambda data: decode_rgb(data, camera=larger, finest_rad=finest),
        ),
    }


def _colour(data: bytes) -> np.ndarray:
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError("a colour image of the dataset is damaged; create the dataset again")
    return picture


def _encoded(suffix: str, picture: np.ndarray) -> bytes:
    return cv2.imencode(suffix, picture)[1].tobytes()
