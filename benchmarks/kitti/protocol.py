"""Place recognition by the published protocol, and by one whose map does not hold the query's own moment."""

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from service.errors import NoDepthError
from service.geometry.earth import Georeference
from service.imaging.query_view import query_views
from service.localization.encoder import Encoder
from service.localization.retrieval import turns_on
from service.maps.reader import MapBundle

RIGHT_M = 10.0
#: The published protocol leaves out the scan of the query's own moment: half of KITTI's ten scans a second.
OWN_SCAN_S = 0.05
#: A loop is closed where the vehicle comes back after so long.
LOOP_S = 60.0


def place_similarities(bundle: MapBundle, dataset: Dataset, query_set: str) -> Float32[NDArray[np.float32], "Q P"]:
    """How alike each query and each place are: the best of the place's views and of the query's turns; -1 without any depth."""
    encoder = Encoder.open(bundle.encoder_bytes())
    place, count = np.array(bundle.view_place), bundle.manifest.counts.places
    vectors = bundle.view_index.vectors(np.arange(len(place)))
    rows = []
    for frame in dataset.queries(query_set):
        best = np.full(count, -1.0, np.float32)
        try:
            views = query_views(
                frame.rgb(), frame.depth_m(), frame.camera.pinhole(), grid=bundle.grid, rows_seen=bundle.rows_seen,
                turns=turns_on(bundle.grid),
            )  # fmt: skip
            np.maximum.at(best, place, (vectors @ encoder.encode(views.planes, "query").T).max(axis=1))
        except NoDepthError:
            pass  # nothing to compare: the query finds no place
        rows.append(best)
    return np.stack(rows)


def found_within(
    similarity: Float32[NDArray[np.float32], "Q P"], query_xy: Float64[NDArray[np.float64], "Q 2"],
    place_xy: Float64[NDArray[np.float64], "P 2"], *, query_s: Float64[NDArray[np.float64], " Q"],
    place_s: Float64[NDArray[np.float64], " P"], left_out_s: float,
) -> tuple[Bool[NDArray[np.bool_], " Q"], Bool[NDArray[np.bool_], " Q"]]:  # fmt: skip
    """Whether the most similar place is within 10 m, where places near in time do not count.

    Args:
        similarity: of queries and places.
        query_xy: where they were taken, metres.
        place_xy: where the places are, in the same frame.
        query_s: when;
        place_s: and when the places were scanned.
        left_out_s: a place that was scanned within so many seconds of a query is not there for it. Negative: all count.

    Returns:
        (Q) right, and (Q) asked: there is a place within 10 m that counts.
    """
    counts = np.abs(query_s[:, None] - place_s[None]) > left_out_s
    near = np.hypot(*(query_xy[:, None] - place_xy[None]).transpose(2, 0, 1)) <= RIGHT_M
    asked = (near & counts).any(axis=1)
    first = np.where(counts, similarity, -np.inf).argmax(axis=1)
    right = near[np.arange(len(first)), first] & asked
    return right, asked


def in_the_frame_of(
    mapped: Dataset, asked: Dataset, xyz: Float64[NDArray[np.float64], "n 3"]
) -> Float64[NDArray[np.float64], "n 3"]:
    """Positions of one georeferenced dataset in the frame of another, metres.

    Raises:
        ValueError: one of them is not georeferenced.
    """
    one, other = mapped.description.georeference, asked.description.georeference
    if one is None or other is None:
        raise ValueError(f"{mapped.folder} or {asked.folder} has no georeference; two days need it")
    to, of = Georeference(**one), Georeference(**other)
    moved: Float64[NDArray[np.float64], "n 3"] = np.array([to.to_map(*of.to_earth(position)) for position in xyz])
    return moved
