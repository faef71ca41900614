"""The bare pipeline as a reference for services: decode, fuse, encode, search and register in a loop.

``python -m benchmarks.serving.bare BUNDLE DATASET QUERIES PAIRS`` opens everything. Then it runs the command of each
input line and answers with a line of JSON. A command is ``full SECONDS`` or ``retrieval SECONDS``; ``fast`` selects the
cheapest depth encoding.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

from service.runtime.threads import limit_pools, limit_pools_before_import

limit_pools_before_import()

from numpy.typing import NDArray  # noqa: E402  # after the pools' limits

from model_training.datasets.dataset import Dataset, QueryFrame  # noqa: E402  # after the pools' limits
from service.imaging.decode import decode_depth, decode_rgb  # noqa: E402
from service.imaging.depth_formats import read_depth_values  # noqa: E402
from service.imaging.picture_headers import DEFAULT_LIMITS  # noqa: E402
from service.imaging.raw16 import write_raw16  # noqa: E402
from service.localization.localizer import Localizer  # noqa: E402
from service.maps.reader import MapBundle  # noqa: E402
from service.retrieval.encoder import Encoder  # noqa: E402
from service.retrieval.query import Query  # noqa: E402


def main() -> None:
    """Open the map and the queries, then run the commands of the input."""
    bundle, folder, queries, pairs = sys.argv[1:]
    limit_pools()
    opened = MapBundle.open(Path(bundle))
    localizer = Localizer(opened, Encoder.open(opened.encoder_bytes()))
    frames = list(Dataset(Path(folder)).queries(queries))
    chosen = frames[:: max(1, len(frames) // int(pairs))][: int(pairs)]
    slow = [(each, each.rgb_path.read_bytes(), each.depth_path.read_bytes()) for each in chosen]
    fast = [(each, rgb, write_raw16(_values(each), "lz4")) for each, rgb, _ in slow]
    for refine in (True, False):
        for each in slow[:5]:
            ask(localizer, *each, refine=refine)
    print(json.dumps({"ready": True}), flush=True)
    for line in sys.stdin:
        words = line.split()
        given = fast if "fast" in words else slow
        done, began, cpu = 0, time.perf_counter(), time.process_time()
        while time.perf_counter() - began < float(words[1]):
            ask(localizer, *given[done % len(given)], refine=words[0] == "full")
            done += 1
        spent = time.process_time() - cpu
        told = {"cpu_ms": 1e3 * spent / done, "per_s": done / (time.perf_counter() - began), "n": done}
        print(json.dumps(told), flush=True)


def ask(localizer: Localizer, frame: QueryFrame, rgb: bytes, depth: bytes, *, refine: bool) -> None:
    """Do the work of one request.

    Args:
        localizer: localizer of the map.
        frame: query frame with its camera.
        rgb: encoded RGB image.
        depth: encoded depth image.
        refine: whether to register.
    """
    camera, spec = frame.camera.pinhole(), frame.camera.depth
    localizer.localize(
        Query(
            rgb=decode_rgb(rgb),
            camera=camera,
            refine=refine,
            depth_m=decode_depth(
                depth,
                camera=camera,
                scale_m=spec.scale_m,
                kind=spec.kind,
                baseline_m=spec.baseline_m,
                max_range_m=spec.max_range_m,
            ),
        )
    )


def _values(frame: QueryFrame) -> NDArray[Any]:
    return read_depth_values(frame.depth_path.read_bytes(), encoding=None, limits=DEFAULT_LIMITS)


if __name__ == "__main__":
    main()
