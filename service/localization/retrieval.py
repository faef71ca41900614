"""Retrieval: views and descriptors of an image pair, the most similar places, their clusters and the street vote."""

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from service.errors import BundleError
from service.imaging.query_view import query_views
from service.imaging.view_grid import ViewGrid
from service.localization.encoder import Encoder
from service.localization.frames import Frame
from service.localization.hypotheses import ClusterSettings, Hypothesis, believed, cluster
from service.localization.query import Query
from service.localization.search import Neighbour, distinct_places, search_views
from service.localization.street_vote import StreetVote, vote
from service.maps.reader import MapBundle
from service.registration.points import inverse_depth_noise

#: A query is searched at three turns, a third of the fan's 15 degrees apart. One of them is within 2.5 degrees of a map view.
TURN_RAD = float(np.deg2rad(5.0))

#: Distinct places to find at least. Registration starts from several of them.
RANKED = 40


@dataclass(frozen=True, slots=True, eq=False)
class Retrieved:
    """What retrieval says of a query.

    Attributes:
        neighbours: distinct places, the most similar first.
        hypotheses: clusters of the most similar views, the heaviest first; weighted by the prior if there is one.
        vote: of the nearest places over the streets; None if the map has no streets.
    """

    neighbours: tuple[Neighbour, ...]
    hypotheses: tuple[Hypothesis, ...]
    vote: StreetVote | None


def look_up(bundle: MapBundle, encoder: Encoder, query: Query, clusters: ClusterSettings) -> Frame:
    """Encode one image pair and search the map for similar views.

    Args:
        bundle: the map.
        encoder: of the map.
        query: image pair, camera and options.
        clusters: how many views the clusters need.

    Raises:
        NoDepthError: the depth image holds no measurement within the view grid.

    Returns:
        The frame as the reference of an answer.
    """
    started = perf_counter()
    views = query_views(
        query.rgb, query.depth_m, query.camera, turns=turns_on(bundle.grid),
        grid=bundle.grid, rows_seen=bundle.rows_seen, down_camera=query.down_camera,
    )  # fmt: skip
    fused = perf_counter()
    descriptors = encoder.encode(views.planes, side="query")
    encoded = perf_counter()
    matches = search_views(
        bundle, descriptors, turns_rad=views.turns_rad, places=places_of(query), fewest=clusters.views
    )
    # A query without registration does not need the noise. But a later frame of a stream may be registered together with this one.
    noise = inverse_depth_noise(query.depth_m, focal_baseline_px_m=query.focal_baseline_px_m)
    return Frame(
        query, np.eye(4), views, descriptors, matches, noise=noise.total, independent_noise=noise.independent,
        fuse_s=fused - started, encode_s=encoded - fused, search_s=perf_counter() - encoded,
    )  # fmt: skip


def retrieve(bundle: MapBundle, frame: Frame, clusters: ClusterSettings) -> Retrieved:
    """Rank the places, cluster the views and vote over the streets, as the paper does.

    Args:
        bundle: the map.
        frame: the reference, as ``look_up`` returned it.
        clusters: how views are clustered.
    """
    query = frame.query
    neighbours = distinct_places(frame.matches, places_of(query))
    hypotheses = believed(cluster(frame.matches, clusters), query.prior)
    streets = None if bundle.streets is None else vote(neighbours[: query.neighbours], clusters.temperature)
    return Retrieved(neighbours, hypotheses, streets)


def turns_on(grid: ViewGrid) -> tuple[int, ...]:
    """The turns at which a query is searched, in the nearest whole number of columns.

    Args:
        grid: of the views.
    """
    columns = max(1, round(TURN_RAD / grid.column_rad))
    return (-columns, 0, columns)


def places_of(query: Query) -> int:
    """How many distinct places a query needs.

    Args:
        query: its options count.
    """
    return max(query.neighbours, query.ranked, RANKED)


def require_encoder_of(bundle: MapBundle, encoder: Encoder) -> None:
    """Refuse an encoder that did not make the descriptors of a map.

    Args:
        bundle: the map.
        encoder: to search it with.

    Raises:
        BundleError: the encoder is another one, or reads another view grid.
    """
    expected, size = bundle.manifest.encoder_sha256, bundle.manifest.counts.descriptor_size
    if encoder.sha256 != expected or encoder.dimension != size:
        raise BundleError(
            f"{bundle.path}: the descriptors ({size} numbers) are of encoder {expected[:12]}, not of "
            f"{encoder.sha256[:12]} ({encoder.dimension} numbers): use the bundle's own, or build the map again",
            field="encoder.onnx",
        )
    grid = (bundle.grid.rows, bundle.grid.columns)
    if (encoder.rows, encoder.columns) != grid:
        raise BundleError(
            f"{bundle.path}: the encoder reads views of {encoder.rows} x {encoder.columns} cells, the map's have "
            f"{grid[0]} x {grid[1]}: build the map again with a view grid that its encoder reads",
            field="encoder.onnx",
        )
