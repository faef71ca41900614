"""One query against one map: fuse, encode, search, cluster and vote as the paper does; then register on the cloud."""

from time import perf_counter

import numpy as np

from service.errors import BundleError
from service.geometry.rigid import Transform, inverse, transform_from
from service.imaging.query_view import QueryViews, query_views
from service.localization.answer import Answer, Timings
from service.localization.encoder import Encoder
from service.localization.hypotheses import ClusterSettings, Hypothesis, cluster
from service.localization.query import Query
from service.localization.refine import RefineSettings, refine
from service.localization.search import distinct_places, search_views
from service.localization.street_vote import StreetVote, vote
from service.maps.reader import MapBundle

#: A query is also asked turned a third of the fan's 15 degrees either way: some turn is then within 2.5 degrees of a view.
TURNS_RAD = tuple(float(turn) for turn in np.deg2rad([-5.0, 0.0, 5.0]))

#: Distinct places that are looked up at least: registration starts from several.
RANKED = 40


class Localizer:
    """A map and the encoder that made it; ``localize`` is safe to call from several threads.

    Raises:
        BundleError: the encoder is not the one that made the map's descriptors, or reads another view grid.
    """

    def __init__(
        self, bundle: MapBundle, encoder: Encoder, *, clusters: ClusterSettings | None = None, refining: RefineSettings | None = None
    ) -> None:  # fmt: skip
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
        self.bundle = bundle
        self.encoder = encoder
        self.clusters = clusters or ClusterSettings()
        self.refining = refining or RefineSettings()
        self.turns_rad = TURNS_RAD

    @classmethod
    def open(cls, bundle: MapBundle) -> "Localizer":
        """With the encoder that lies in the bundle."""
        return cls(bundle, Encoder.open(bundle.encoder_bytes()))

    def localize(self, query: Query) -> Answer:
        """Answer a query.

        Raises:
            NoDepthError: the depth picture holds no measurement within the view grid.
        """
        started = perf_counter()
        views = query_views(
            query.rgb, query.depth_m, query.camera, turns_rad=self.turns_rad,
            grid=self.bundle.grid, rows_seen=self.bundle.rows_seen, down_camera=query.down_camera,
        )  # fmt: skip
        fused = perf_counter()
        descriptors = self.encoder.encode(views.planes, side="query")
        encoded = perf_counter()
        wanted = max(query.neighbours, query.ranked, RANKED)
        matches = search_views(
            self.bundle, descriptors, turns_rad=views.turns_rad, places=wanted, fewest=self.clusters.views
        )
        neighbours = distinct_places(matches, wanted)
        hypotheses = cluster(matches, self.clusters)
        streets = (
            None if self.bundle.streets is None else vote(neighbours[: query.neighbours], self.clusters.temperature)
        )
        found = perf_counter()
        refined = None
        if query.refine and self.bundle.cloud is not None:
            refined = refine(
                self.bundle.cloud, query.depth_m, query.camera, matches, R_level_camera=views.R_level_camera,
                height_m=views.height_m, lidar_height_m=self.bundle.manifest.lidar_height_m, settings=self.refining,
            )  # fmt: skip
        done = perf_counter()
        T_map_camera = self._pose_of(hypotheses[0], views) if refined is None else refined.T_map_camera
        return Answer(
            status="LOCALIZED",
            confidence=None,
            street=self._street_of(T_map_camera, streets, registered=refined is not None),
            vote=streets,
            T_map_camera=T_map_camera,
            covariance=None if refined is None else refined.covariance,
            registration=None if refined is None else refined.candidates,
            T_map_vehicle=None if query.T_vehicle_camera is None else T_map_camera @ inverse(query.T_vehicle_camera),
            neighbours=neighbours[: max(query.neighbours, query.ranked)],
            hypotheses=hypotheses,
            measured_share=views.measured_share,
            height_m=views.height_m,
            timings=Timings(
                fuse_ms=1e3 * (fused - started),
                encode_ms=1e3 * (encoded - fused),
                search_ms=1e3 * (found - encoded),
                register_ms=0.0 if refined is None else 1e3 * (done - found),
                total_ms=1e3 * (done - started),
            ),
        )

    def _street_of(self, T_map_camera: Transform, voted: StreetVote | None, *, registered: bool) -> int:
        """A metric position says which street it lies in; a cluster of places does not know better than their vote."""
        if self.bundle.streets is None or voted is None:
            return -1
        return self.bundle.streets.index_at(T_map_camera[:2, 3]) if registered else voted.street

    def _pose_of(self, hypothesis: Hypothesis, view: QueryViews) -> Transform:
        """The camera stands at the hypothesis, at its own height above the ground under the places' LiDAR."""
        above_lidar_m = view.height_m - self.bundle.manifest.lidar_height_m
        position_m = hypothesis.position_m + np.array([0.0, 0.0, above_lidar_m])
        return transform_from(hypothesis.R_map_level @ view.R_level_camera, position_m)
