"""One query against one map: fuse, encode, search, cluster and vote as the paper does; then register on the cloud."""

from dataclasses import replace
from time import perf_counter

import numpy as np

from service.errors import BundleError, RequestError
from service.geometry.rigid import Transform, heading_of_camera, inverse, transform_from
from service.imaging.query_view import QueryViews, query_views
from service.imaging.view_grid import ViewGrid
from service.localization.answer import Answer, Timings, require_finite
from service.localization.decide import decide
from service.localization.encoder import Encoder, Provider
from service.localization.evidence import evidence_of
from service.localization.frames import Frame
from service.localization.hypotheses import ClusterSettings, Hypothesis, believed, cluster
from service.localization.judge import Candidate
from service.localization.query import Query
from service.localization.reasons import Reason, reasons_of
from service.localization.refine import RefineSettings, refine
from service.localization.rerank import reranked
from service.localization.rivals import distinct_candidates, shares_of
from service.localization.search import distinct_places, search_views
from service.localization.spread import Extent, Spread, spread_of
from service.localization.street_vote import vote
from service.maps.reader import MapBundle
from service.registration.points import inverse_depth_noise

#: A query is also asked turned a third of the fan's 15 degrees either way: some turn is then within 2.5 degrees of a view.
TURN_RAD = float(np.deg2rad(5.0))

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
        self.turns = turns_on(bundle.grid)
        self.extent = Extent.of_places(bundle.T_map_place[:, :3, 3], bundle.manifest.spacing_m)

    @classmethod
    def open(cls, bundle: MapBundle, *, provider: Provider = "cpu") -> "Localizer":
        """With the encoder that lies in the bundle.

        Raises:
            EncoderError: the provider is not installed.
        """
        return cls(bundle, Encoder.open(bundle.encoder_bytes(), provider=provider))

    def localize(self, query: Query) -> Answer:
        """Answer a query.

        Raises:
            NoDepthError: the depth picture holds no measurement within the view grid.
        """
        return self.localize_frames((query,), (np.eye(4),))

    def localize_frames(self, queries: tuple[Query, ...], T_reference_camera: tuple[Transform, ...]) -> Answer:
        """Answer several picture pairs whose cameras are known against each other, as one.

        Frames of a drive with the odometry between them, or the cameras of a rig at one instant: what a single picture leaves
        open, all of them together may tell.

        Args:
            queries: the reference first; its pose is answered, and its options, its prior and its vehicle count.
            T_reference_camera: of each; the first is the identity.

        Raises:
            NoDepthError: a depth picture holds no measurement within the view grid.
        """
        pairs = zip(queries, T_reference_camera, strict=True)
        return self.answer(tuple(replace(self.look_up(query), T_reference_camera=T) for query, T in pairs))

    def look_up(self, query: Query) -> Frame:
        """What one picture pair says before the cloud is asked, as the reference of an answer.

        Raises:
            NoDepthError: the depth picture holds no measurement within the view grid.
        """
        started = perf_counter()
        views = query_views(
            query.rgb, query.depth_m, query.camera, turns=self.turns,
            grid=self.bundle.grid, rows_seen=self.bundle.rows_seen, down_camera=query.down_camera,
        )  # fmt: skip
        fused = perf_counter()
        descriptors = self.encoder.encode(views.planes, side="query")
        encoded = perf_counter()
        matches = search_views(
            self.bundle, descriptors, turns_rad=views.turns_rad, places=_places_of(query), fewest=self.clusters.views
        )
        # Without registration nobody asks for it, but a later frame of a stream may be registered together with this one.
        noise = inverse_depth_noise(query.depth_m, focal_baseline_px_m=query.focal_baseline_px_m)
        return Frame(
            query, np.eye(4), views, descriptors, matches, noise=noise.total, independent_noise=noise.independent,
            fuse_s=fused - started, encode_s=encoded - fused, search_s=perf_counter() - encoded,
        )  # fmt: skip

    def answer(self, frames: tuple[Frame, ...]) -> Answer:
        """Answer frames that were looked up.

        Args:
            frames: the reference first, as in ``localize_frames``.

        Raises:
            RequestError: fewer false accepts are wanted than the map's calibration can promise.
            NotFiniteError: a number of the answer is not finite, by a defect of ours or of the map.
        """
        started = perf_counter()
        query, matches = frames[0].query, frames[0].matches
        self._require_promise(query)
        wanted = _places_of(query)
        neighbours = distinct_places(matches, wanted)
        hypotheses = believed(cluster(matches, self.clusters), query.prior)
        streets = (
            None if self.bundle.streets is None else vote(neighbours[: query.neighbours], self.clusters.temperature)
        )
        found = perf_counter()
        refined, evidence = None, None
        registers = query.refine and self.bundle.cloud is not None
        if query.refine and self.bundle.cloud is not None:
            refined = refine(self.bundle, self.bundle.cloud, frames, query.prior, self.refining)
            evidence = (
                None
                if refined is None
                else evidence_of(
                    frames, refined, neighbours, hypotheses, self.bundle.T_map_place[:, :2, 3], self.bundle.grid
                )
            )
        decision = None
        reasons: tuple[Reason, ...] = ()
        if registers and self.bundle.calibration is not None:
            prior_nats = 0.0
            if query.prior is not None and refined is not None:
                T = refined.best.T_map_camera
                prior_nats = query.prior.known_nats(T[:2, 3], heading_of_camera(T))
            decision = decide(self.bundle.calibration, evidence, query.false_accept_rate, prior_nats=prior_nats)
            if decision.status != "LOCALIZED":
                reasons = reasons_of(self.bundle.calibration, evidence)
        candidates, spread = None if refined is None else refined.candidates, None
        if decision is not None and decision.status != "LOCALIZED":
            candidates = None if refined is None else refined.with_covariances()
            spread = self._spread_of(candidates or (), len(frames), decision.confidence)
        done = perf_counter()
        fused, encoded, searched = (
            sum(getattr(frame, name) for frame in frames) for name in ("fuse_s", "encode_s", "search_s")
        )
        T_map_camera = self._pose_of(hypotheses[0], frames[0].views) if refined is None else refined.best.T_map_camera
        answer = Answer(
            status="LOCALIZED" if decision is None else decision.status,
            confidence=None if decision is None else decision.confidence,
            street=self._street_of(T_map_camera, hypotheses[0], registered=refined is not None),
            vote=streets,
            T_map_camera_guess=T_map_camera,
            covariance=None if refined is None else refined.covariance,
            candidates=candidates,
            spread=spread,
            reasons=reasons,
            frames=len(frames),
            evidence=evidence,
            T_map_vehicle_guess=None
            if query.T_vehicle_camera is None
            else T_map_camera @ inverse(query.T_vehicle_camera),
            neighbours=reranked(neighbours, candidates or ())[: max(query.neighbours, query.ranked)],
            hypotheses=hypotheses,
            measured_share=frames[0].views.measured_share,
            height_m=frames[0].views.height_m,
            timings=Timings(
                fuse_ms=1e3 * fused,
                encode_ms=1e3 * encoded,
                search_ms=1e3 * (searched + found - started),
                register_ms=0.0 if refined is None else 1e3 * (done - found),
                total_ms=1e3 * (done - started + fused + encoded + searched),
            ),
        )
        require_finite(answer)
        return answer

    def _spread_of(self, candidates: tuple[Candidate, ...], frames: int, confidence: float) -> Spread:
        distinct = distinct_candidates(candidates)
        covariances = [each.covariance for each in distinct if each.covariance is not None]
        return spread_of(
            [each.T_map_camera for each in distinct], covariances, shares_of(distinct, frames),
            confidence=confidence, extent=self.extent,
        )  # fmt: skip

    def _require_promise(self, query: Query) -> None:
        calibration = self.bundle.calibration
        if not query.refine or calibration is None:
            return
        least = calibration.least_false_accept_rate
        if query.false_accept_rate < least:
            raise RequestError(
                f"false_accept_rate: {query.false_accept_rate:g} is less than this map's calibration can promise; "
                f"ask for {least:g} or more",
                field="options.false_accept_rate",
            )

    def _street_of(self, T_map_camera: Transform, heaviest: Hypothesis, *, registered: bool) -> int:
        """A metric position says which street it lies in; without one it is that of the heaviest cluster, which never spans two.

        The vote of the nearest places crosses a street's border more often (decision log).
        """
        if self.bundle.streets is None:
            return -1
        return self.bundle.streets.index_at(T_map_camera[:2, 3]) if registered else heaviest.street

    def _pose_of(self, hypothesis: Hypothesis, view: QueryViews) -> Transform:
        """The camera stands at the hypothesis, at its own height above the ground under the places' LiDAR."""
        above_lidar_m = view.height_m - self.bundle.manifest.lidar_height_m
        position_m = hypothesis.position_m + np.array([0.0, 0.0, above_lidar_m])
        return transform_from(hypothesis.R_map_level @ view.R_level_camera, position_m)


def turns_on(grid: ViewGrid) -> tuple[int, ...]:
    """The turns at which a query is asked, in the nearest whole number of columns."""
    columns = max(1, round(TURN_RAD / grid.column_rad))
    return (-columns, 0, columns)


def _places_of(query: Query) -> int:
    return max(query.neighbours, query.ranked, RANKED)
