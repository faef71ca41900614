"""Retrieval: views and descriptors of an image pair, the most similar places, their clusters and the street vote."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64
from numpy.typing import NDArray

from service.errors import BundleError
from service.geometry.rigid import Rotation, Transform, transform_from
from service.imaging.query_view import QueryViews, query_views
from service.imaging.view_grid import ViewGrid
from service.maps.map import Map
from service.registration.points import inverse_depth_noise
from service.retrieval.encoder import Encoder
from service.retrieval.hypotheses import ClusterSettings, Hypothesis, cluster, rerank_with_prior
from service.retrieval.knn import Neighbour, StreetVote, ViewMatches, distinct_places, search_views, vote
from service.retrieval.query import Query
from service.timing import stage

#: A query is searched at three turns, 5 degrees apart. The views of a place are 15 degrees apart, so one of the turns is within
#: 2.5 degrees of a map view.
TURN_RAD = float(np.deg2rad(5.0))

#: Radius of the area of a prior: so many of its standard deviations, and a view's reach beyond (m).
NEAR_SIGMAS, NEAR_M = 4.0, 50.0

#: Smallest number of distinct places to find. Registration starts from several of them.
RANKED = 40


@dataclass(frozen=True, slots=True, eq=False)
class EncodedFrame:
    """An image pair with the results of the map search.

    Attributes:
        query: image pair, camera and options.
        T_reference_camera: pose of this camera in the camera frame of the reference; identity for the reference itself.
        views: query views, one per turn.
        descriptors: descriptors of the views, one row per turn.
        matches: most similar map views, the best first.
        noise: standard deviation of the inverse depth of one pixel, 1/m.
        independent_noise: the same without the correlated error that adjacent pixels share, 1/m.
    """

    query: Query
    T_reference_camera: Transform
    views: QueryViews
    descriptors: Float32[NDArray[np.float32], "T D"]
    matches: ViewMatches
    noise: float
    independent_noise: float

    @property
    def R_level_camera(self) -> Rotation:
        """Rotation from the camera's optical frame to the level frame."""
        return self.views.R_level_camera

    def pose_of_camera(self, T_level: Transform) -> Transform:
        """Compute the pose of the camera from the pose of its level frame. Both have their origin at the camera.

        Args:
            T_level: pose of the level frame, in any frame.
        """
        return transform_from(T_level[:3, :3] @ self.R_level_camera, T_level[:3, 3])

    def pose_of_level(self, T_camera: Transform) -> Transform:
        """Compute the pose of the level frame from the pose of the camera.

        Args:
            T_camera: pose of the camera, in any frame.
        """
        return transform_from(T_camera[:3, :3] @ self.R_level_camera.T, T_camera[:3, 3])

    def T_reference_level(self, reference: "EncodedFrame") -> Transform:
        """Compute the pose of this frame's level frame in the level frame of the reference.

        The origin of each level frame is at its camera.

        Args:
            reference: reference frame of the query.
        """
        T_reference_camera, R_level_reference = self.T_reference_camera, reference.R_level_camera
        R = R_level_reference @ T_reference_camera[:3, :3] @ self.R_level_camera.T
        return transform_from(R, R_level_reference @ T_reference_camera[:3, 3])


@dataclass(frozen=True, slots=True, eq=False)
class Retrieved:
    """Result of retrieval.

    Attributes:
        neighbours: distinct places, the most similar first.
        hypotheses: clusters of the most similar views, the heaviest first; a prior, if given, counts in this order.
        vote: street vote of the k nearest places; None if the map has no streets.
    """

    neighbours: tuple[Neighbour, ...]
    hypotheses: tuple[Hypothesis, ...]
    vote: StreetVote | None


def encode_and_search(bundle: Map, encoder: Encoder, query: Query, clusters: ClusterSettings) -> EncodedFrame:
    """Encode one image pair and search the map for similar views.

    Args:
        bundle: the map.
        encoder: encoder of the map.
        query: image pair, camera and options.
        clusters: settings of the clustering; they give the smallest number of views to find.

    Returns:
        The image pair as a reference frame: its ``T_reference_camera`` is the identity.

    Raises:
        NoDepthError: the depth image holds no measurement within the view grid.
    """
    with stage("fuse"):
        views = query_views(
            query.rgb,
            query.depth_m,
            query.camera,
            turns=turns_on(bundle.grid),
            grid=bundle.grid,
            rows_seen=bundle.rows_seen,
            down_camera=query.down_camera,
            given_height=query.camera_height,
            observed=query.observed,
        )
    with stage("encode"):
        descriptors = encoder.encode(views.planes, side="query")
    with stage("search"):
        part = bundle.searched(descriptors.mean(axis=0), near_prior(query))
        matches = search_views(
            part, descriptors, turns_rad=views.turns_rad, places=places_of(query), fewest=clusters.views
        )
        # A query without registration does not need the noise. But a later query of a stream may register this frame
        # (decision 0111).
        noise = inverse_depth_noise(query.depth_m, focal_baseline_px_m=query.focal_baseline_px_m)
    return EncodedFrame(
        query, np.eye(4), views, descriptors, matches, noise=noise.total, independent_noise=noise.independent
    )


def retrieve(bundle: Map, frame: EncodedFrame, clusters: ClusterSettings) -> Retrieved:
    """Rank the places, cluster the views and vote over the streets, as the paper does.

    Args:
        bundle: the map.
        frame: the reference, as ``encode_and_search`` returned it.
        clusters: settings of the clustering.
    """
    query = frame.query
    neighbours = distinct_places(frame.matches, places_of(query))
    hypotheses = rerank_with_prior(cluster(frame.matches, clusters), query.prior)
    streets = None if bundle.streets is None else vote(neighbours[: query.neighbours], clusters.temperature)
    return Retrieved(neighbours, hypotheses, streets)


def turns_on(grid: ViewGrid) -> tuple[int, ...]:
    """Return the turns at which a query is searched, in whole columns of the view grid, counter-clockwise.

    Args:
        grid: view grid of the map.
    """
    columns = max(1, round(TURN_RAD / grid.column_rad))
    return (-columns, 0, columns)


def near_prior(query: Query) -> tuple[Float64[NDArray[np.float64], "2"], float] | None:
    """Return x and y (m, map frame) and radius (m) of the area where the prior of a query expects the camera; None without a position.

    A tiled map is searched there. The area is generous, so a prior with a larger error than stated still finds its tile.

    Args:
        query: query with its options.
    """
    prior = query.prior
    if prior is None or prior.position_m is None:
        return None
    return prior.position_m, NEAR_SIGMAS * prior.position_std_m + NEAR_M


def places_of(query: Query) -> int:
    """Return how many distinct places to search for.

    Args:
        query: query with its options.
    """
    return max(query.neighbours, query.ranked, RANKED)


def require_encoder_of(bundle: Map, encoder: Encoder) -> None:
    """Refuse an encoder that did not compute the descriptors of a map.

    Args:
        bundle: the map.
        encoder: encoder for the queries.

    Raises:
        BundleError: the encoder did not compute the map's descriptors, or reads another view grid.
    """
    expected, size = bundle.manifest.encoder_sha256, bundle.manifest.counts.descriptor_size
    if encoder.sha256 != expected or encoder.dimension != size:
        raise BundleError(
            f"{bundle.path}: the descriptors ({size} numbers) are from encoder {expected[:12]}, not from "
            f"{encoder.sha256[:12]} ({encoder.dimension} numbers); use the encoder of the bundle, or build the map again",
            field="encoder.onnx",
        )
    grid = (bundle.grid.rows, bundle.grid.columns)
    if (encoder.rows, encoder.columns) != grid:
        raise BundleError(
            f"{bundle.path}: the encoder reads views of {encoder.rows} x {encoder.columns} cells, but those of the map have "
            f"{grid[0]} x {grid[1]}; build the map again with a view grid that its encoder reads",
            field="encoder.onnx",
        )
