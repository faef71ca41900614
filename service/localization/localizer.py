"""Localize a query in a map: retrieve places as the paper does, register candidates on the map cloud, and decide."""

from dataclasses import replace

import numpy as np

from service.confidence.decision import calibration_for, decision_of, require_promise
from service.confidence.features import evidence_of, require_features
from service.confidence.spread import Extent
from service.geometry.rigid import Transform
from service.localization.agreement import registered
from service.localization.answer import Answer
from service.localization.compose import QueryResult, compose
from service.localization.refine import RefineSettings, refine
from service.maps.map import Map
from service.retrieval.encoder import Encoder, Provider
from service.retrieval.hypotheses import ClusterSettings
from service.retrieval.query import Query
from service.retrieval.retrieve import EncodedFrame, encode_and_search, require_encoder_of, retrieve
from service.retrieval.starts import start_positions_m
from service.scoring.verifier import PoseVerifier, Verifier
from service.timing import stage, timed_request


class Localizer:
    """A map and its encoder; ``localize`` is safe to call from several threads.

    Args:
        bundle: the map.
        encoder: encoder that computed the map's descriptors.
        clusters: settings of the clustering; None for the defaults.
        refining: settings of registration and scoring; None for the defaults.
        verifier: compares poses with the map; None for the shipped one.

    Raises:
        EncoderError: the shipped verifier is missing or damaged.
        BundleError: the encoder did not compute the map's descriptors, or reads another view grid; or the map's calibration has
            other confidence features.
    """

    def __init__(
        self,
        bundle: Map,
        encoder: Encoder,
        *,
        clusters: ClusterSettings | None = None,
        refining: RefineSettings | None = None,
        verifier: PoseVerifier | None = None,
    ) -> None:
        require_encoder_of(bundle, encoder)
        require_features(bundle.calibration, str(bundle.path))
        self.bundle, self.encoder = bundle, encoder
        self.clusters, self.refining = clusters or ClusterSettings(), refining or RefineSettings()
        self.verifier: PoseVerifier = verifier or Verifier.shipped()
        self.extent = Extent.of_places(bundle.T_map_place[:, :3, 3], bundle.manifest.spacing_m)

    @classmethod
    def open(cls, bundle: Map, *, provider: Provider = "cpu", verifier: PoseVerifier | None = None) -> "Localizer":
        """Create a localizer with the encoder that the bundle contains.

        Args:
            bundle: the map.
            provider: execution provider that runs the encoder.
            verifier: compares poses with the map; None for the shipped one.

        Raises:
            EncoderError: the provider is not installed, or the encoder or the shipped verifier cannot be used.
        """
        return cls(bundle, Encoder.open(bundle.encoder_bytes(), provider=provider), verifier=verifier)

    def localize(self, query: Query) -> Answer:
        """Answer a query.

        Args:
            query: one image pair, its camera and its options.

        Raises:
            NoDepthError: the depth image holds no measurement within the view grid.
            RequestError: the calibration does not support such a low false-accept rate.
            NotFiniteError: a number of the answer is not finite, because of a defect of this program or of the map.
        """
        return self.localize_frames((query,), (np.eye(4),))

    @timed_request()
    def localize_frames(self, queries: tuple[Query, ...], T_reference_camera: tuple[Transform, ...]) -> Answer:
        """Answer several image pairs with known relative poses as one query.

        They are frames of a traversal with the odometry between them, or the cameras of a rig at one instant. Together they can
        resolve what a single image pair leaves ambiguous.

        Args:
            queries: image pairs, the reference first. The answer gives the pose of the reference. Only the options, the prior
                and the vehicle of the reference count.
            T_reference_camera: pose of each camera in the camera frame of the reference; the first is the identity.

        Raises:
            NoDepthError: a depth image holds no measurement within the view grid.
            RequestError: the calibration does not support such a low false-accept rate.
            NotFiniteError: a number of the answer is not finite, because of a defect of this program or of the map.
        """
        pairs = zip(queries, T_reference_camera, strict=True)
        return self.answer(tuple(replace(self.encode_and_search(query), T_reference_camera=T) for query, T in pairs))

    def encode_and_search(self, query: Query) -> EncodedFrame:
        """Encode one image pair and search the map for similar views, without registration.

        The returned frame is a reference. Set its ``T_reference_camera`` to use it as another frame of a query.

        Args:
            query: one image pair, its camera and its options.

        Raises:
            NoDepthError: the depth image holds no measurement within the view grid.
        """
        return encode_and_search(self.bundle, self.encoder, query, self.clusters)

    @timed_request()
    def answer(self, frames: tuple[EncodedFrame, ...]) -> Answer:
        """Answer a query from frames that ``encode_and_search`` returned.

        Args:
            frames: image pairs, the reference first, as in ``localize_frames``.

        Raises:
            RequestError: the calibration does not support such a low false-accept rate.
            NotFiniteError: a number of the answer is not finite, because of a defect of this program or of the map.
        """
        return self.compose(frames, registered(self.register, self.bundle.calibration, frames))

    def register(self, frames: tuple[EncodedFrame, ...], predicted: tuple[Transform, ...] = ()) -> QueryResult:
        """Retrieve, register and decide, without the parts of an answer that only its reader needs.

        Args:
            frames: image pairs, the reference first, as in ``localize_frames``.
            predicted: poses T_map_camera of the reference from odometry. Registration starts from them too.

        Raises:
            RequestError: the calibration does not support such a low false-accept rate.
        """
        query = frames[0].query
        # Of a tiled map, only the tiles of this query take part.
        bundle = self.bundle.around(lambda: start_positions_m(frames, predicted, self.bundle.manifest.lidar_height_m))
        cloud = bundle.cloud if query.refine else None
        calibration = calibration_for(bundle.calibration, (frame.query for frame in frames))
        require_promise(calibration if query.refine else None, query)
        # 1. Retrieval: the most similar places, clusters of the views, and the paper's K-NN vote over the streets.
        with stage("search"):
            found = retrieve(bundle, frames[0], self.clusters)
        with stage("register"):
            # 2. Registration: refine candidate poses on the map cloud, and rank them.
            refined = (
                None
                if cloud is None
                else refine(bundle, cloud, frames, query.prior, self.refining, self.verifier, predicted)
            )
            # 3. Confidence features of the best candidate and its rivals.
            evidence = None if refined is None else evidence_of(frames, refined, found, bundle.places_xy, bundle.grid)
            # 4. Decision: status and calibrated confidence.
            decision = None if cloud is None else decision_of(calibration, query, refined, evidence)
            return QueryResult(found, refined, evidence, decision)

    def compose(self, frames: tuple[EncodedFrame, ...], found: QueryResult) -> Answer:
        """Build the answer.

        Args:
            frames: image pairs, the reference first.
            found: result of ``register`` for these frames.

        Raises:
            NotFiniteError: a number of the answer is not finite, because of a defect of this program or of the map.
        """
        # 5. Reasons and spread if the answer is not LOCALIZED. Then the answer, and a check that all its numbers are finite.
        return compose(self.bundle, frames, found, self.extent)
