"""Place recognition by the published protocol, and by one whose map lacks the query's own moment."""

import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy.typing import NDArray

from model_training.datasets.dataset import Dataset
from service.errors import NoDepthError
from service.geometry.earth import Georeference
from service.imaging.query_view import query_views
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder
from service.retrieval.retrieve import turns_on

RIGHT_M = 10.0
#: Time around a query whose scan the published protocol leaves out: half of the period of KITTI's ten scans per second.
OWN_SCAN_S = 0.05
#: Time after which a return of the vehicle counts as a loop.
LOOP_S = 60.0


def place_similarities(bundle: MapBundle, dataset: Dataset, query_set: str) -> Float32[NDArray[np.float32], "Q P"]:
    """Compute the similarity of queries and places: the best of all views and turns; -1 without depth.

    Args:
        bundle: the map.
        dataset: the dataset of the queries.
        query_set: name of the query set.
    """
    encoder = Encoder.open(bundle.encoder_bytes())
    place, count = np.array(bundle.view_place), bundle.manifest.counts.places
    vectors = bundle.view_index.vectors(np.arange(len(place)))
    rows = []
    for frame in dataset.queries(query_set):
        best = np.full(count, -1.0, np.float32)
        try:
            views = query_views(
                frame.rgb(),
                frame.depth_m(),
                frame.camera.pinhole(),
                grid=bundle.grid,
                rows_seen=bundle.rows_seen,
                turns=turns_on(bundle.grid),
            )
            np.maximum.at(best, place, (vectors @ encoder.encode(views.planes, "query").T).max(axis=1))
        except NoDepthError:
            pass  # nothing to compare: the query finds no place
        rows.append(best)
    return np.stack(rows)


def found_within(
    similarity: Float32[NDArray[np.float32], "Q P"],
    query_xy: Float64[NDArray[np.float64], "Q 2"],
    place_xy: Float64[NDArray[np.float64], "P 2"],
    *,
    query_s: Float64[NDArray[np.float64], " Q"],
    place_s: Float64[NDArray[np.float64], " P"],
    left_out_s: float,
) -> tuple[Bool[NDArray[np.bool_], " Q"], Bool[NDArray[np.bool_], " Q"]]:
    """Check whether the most similar place is within 10 m; places near in time are excluded.

    Args:
        similarity: similarities of queries and places (Q, P).
        query_xy: positions of the queries (Q, 2), metres.
        place_xy: positions of the places (P, 2), metres, same frame.
        query_s: times of the queries (Q,), seconds.
        place_s: times of the places' scans (P,), seconds.
        left_out_s: a place scanned within this time of a query is excluded, seconds. A negative value excludes none.

    Returns:
        (Q,) correct, and (Q,) counted: an included place lies within 10 m.
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
    """Transform positions of one georeferenced dataset into the frame of another.

    Args:
        mapped: dataset of the target frame.
        asked: dataset of the positions.
        xyz: positions (n, 3), metres, map frame of ``asked``.

    Raises:
        ValueError: one of them is not georeferenced.
    """
    one, other = mapped.description.georeference, asked.description.georeference
    if one is None or other is None:
        raise ValueError(f"{mapped.folder} or {asked.folder} has no georeference; two days need it")
    to, of = Georeference(**one), Georeference(**other)
    moved: Float64[NDArray[np.float64], "n 3"] = np.array([to.to_map(*of.to_earth(position)) for position in xyz])
    return moved
