"""Print a map's answers to a dataset's queries, with every number bit by bit.

``python_in`` runs this module in an unpacked wheel.

Example: python -m benchmarks.native.answers --map maps/city --dataset data/city --queries drive1_stereo --count 200
"""

import argparse
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from model_training.datasets.dataset import Dataset
from service.localization.answer import Timings
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder
from service.retrieval.query import Query


def told(value: object) -> Iterator[str]:
    """Yield all of an answer except its timings; numbers are hexadecimal, so no digit is lost.

    Args:
        value: the answer, or a part of it.
    """
    if isinstance(value, Timings):
        return
    if is_dataclass(value):
        for field in fields(value):
            yield field.name
            yield from told(getattr(value, field.name))
    elif isinstance(value, list | tuple):
        for each in value:
            yield from told(each)
    elif isinstance(value, np.ndarray):
        yield str(value.shape)
        yield from told(value.ravel().tolist())
    elif isinstance(value, float | np.floating):
        yield float(value).hex()
    else:
        yield repr(value)


def main() -> None:
    """Print one line per answer."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--map", type=Path, required=True, help="map bundle")
    parser.add_argument("--dataset", type=Path, required=True, help="dataset with the queries")
    parser.add_argument("--queries", required=True, help="query set")
    parser.add_argument("--count", type=int, required=True, help="number of queries")
    arguments = parser.parse_args()
    bundle = MapBundle.open(arguments.map)
    localizer = Localizer(bundle, Encoder.open(bundle.encoder_bytes(), threads=1))
    for frame in islice(Dataset(arguments.dataset).queries(arguments.queries), arguments.count):
        query = Query(rgb=frame.rgb(), depth_m=frame.depth_m(), camera=frame.camera.pinhole())
        print(" ".join(told(localizer.localize(query))), flush=True)


if __name__ == "__main__":
    main()
