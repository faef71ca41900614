"""The composition root: builds a running engine from the settings. Both request handlers call only this module."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from service.errors import BundleError, RequestError, StreetfixError
from service.geometry.camera import PinholeCamera
from service.geometry.rigid import inverse
from service.imaging.decode import DepthEncoding, DepthKind, ImageLimits
from service.imaging.level import GivenHeight
from service.imaging.picture_headers import DEFAULT_LIMITS
from service.localization.answer import Answer
from service.localization.belief import OdometryStd
from service.localization.localizer import Localizer
from service.localization.track_bytes import packed, unpacked
from service.localization.tracker import Track, follow
from service.maps.manifest import Manifest
from service.maps.map import Map
from service.maps.store.cache import TileCache, default_folder
from service.maps.store.stored_map import StoredMap
from service.maps.tiles import OpenSearch
from service.option_limits import NEIGHBOURS
from service.retrieval.prior import Prior
from service.retrieval.query import DepthFormat, Query, decoded_query
from service.retrieval.retrieve import EncodedFrame
from service.runtime.admission import Admission
from service.runtime.fetch_log import FetchLog
from service.runtime.last_answers import LastAnswers
from service.runtime.map_registry import MapRegistry
from service.runtime.map_watcher import MapWatcher
from service.runtime.memory import (
    DEPTH_KEPT,
    DEPTH_PEAK,
    DEPTH_PEAK_CONVERTED,
    RGB_PEAK,
    budget_of,
)
from service.runtime.metrics import Metrics
from service.runtime.seal import Seal
from service.runtime.serving_table import ServingTable
from service.runtime.settings import MapUrl, Settings
from service.runtime.threads import limit_pools, threads_per_process, usable_cores
from service.runtime.tile_metrics import TileMetrics
from service.runtime.tracing import Tracing
from service.timing import stage, timed_request

#: Pose of the reference in its own frame.
_HERE = np.eye(4)


@dataclass(frozen=True, slots=True, eq=False)
class CarriedTrack:
    """What a client sends to continue its track.

    Attributes:
        sealed_belief: bytes of the answer before; None begins.
        T_previous_camera: odometry, from this camera's frame to the previous camera's frame, (4, 4), metres; None if it is unknown.
        odometry_std: standard deviations of the odometry; None if they are unknown.
    """

    sealed_belief: bytes | None
    T_previous_camera: NDArray[np.float64] | None
    odometry_std: OdometryStd | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EncodedQuery:
    """A query as received. The images are still encoded; the request handler has checked the numbers.

    Attributes:
        rgb: encoded RGB image.
        depth: encoded depth image.
        camera: intrinsics of both images.
        map_name: map to localize in, as ``name`` or ``name@version``; None takes the only mounted map, or the nearest one to
            ``prior_wgs84``.
        depth_encoding: file encoding of the depth image.
        depth_kind: meaning of the stored values.
        scale_m: metres per stored unit; None lets the format decide.
        baseline_m: of the stereo camera, for disparity.
        max_range_m: depths beyond this range count as not measured; None sets no limit.
        down_camera: direction of gravity in the camera frame, (3,); None if unknown.
        camera_height: height of the camera above the ground; None: it is found in the depth image.
        T_vehicle_camera: from the camera frame to the vehicle frame, (4, 4), metres; None if the vehicle pose is not wanted.
        neighbours: number of distinct places that vote and that the answer lists.
        refine: whether to register the images on the map cloud.
        prior: prior of the camera pose; None if nothing is known.
        prior_wgs84: latitude and longitude (degrees) of the prior's position, if it was given so.
        false_accept_rate: share of out-of-map queries that may be LOCALIZED; None takes the setting of the service.
        track: state that the client carries; None for a query without memory.
    """

    rgb: bytes
    depth: bytes
    camera: PinholeCamera
    map_name: str | None = None
    depth_encoding: DepthEncoding = "auto"
    depth_kind: DepthKind = "z"
    scale_m: float | None = None
    baseline_m: float | None = None
    max_range_m: float | None = None
    down_camera: NDArray[np.float64] | None = None
    camera_height: GivenHeight | None = None
    T_vehicle_camera: NDArray[np.float64] | None = None
    neighbours: int = NEIGHBOURS
    refine: bool = True
    prior: Prior | None = None
    prior_wgs84: tuple[float, float] | None = None
    false_accept_rate: float | None = None
    track: CarriedTrack | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """An answer, the map bundle that gave it, and the sealed belief for a client that carries it."""

    answer: Answer
    bundle: Map
    sealed_belief: bytes | None = None


class Engine:
    """Open maps and the worker threads that serve them.

    Args:
        registry: of the maps.
        settings: checked.
        watcher: of the maps folders; None creates one.
        tiles: metrics that the watcher uses; None creates them.
    """

    def __init__(
        self,
        registry: MapRegistry,
        settings: Settings,
        watcher: MapWatcher | None = None,
        tiles: TileMetrics | None = None,
    ) -> None:
        tiles = tiles or TileMetrics()
        self.registry = registry
        self.settings = settings
        self.watcher = watcher or watcher_of(registry, settings, tiles)
        self.threads = threads_per_process(settings.threads, workers=settings.workers, cores=usable_cores())
        self.admission = Admission(threads=self.threads, queue=settings.queue, initializer=limit_pools)
        self.memory = budget_of(settings, threads=self.threads)
        self.metrics = Metrics(self.admission, registry, self.memory, tiles, self.watcher.cached_tiles)
        self.last_answers = LastAnswers()
        self._seal = Seal(None if settings.belief_key is None else settings.belief_key.get_secret_value())
        endpoint = settings.traces_endpoint
        self.tracing = None if endpoint is None else Tracing.open(endpoint, share=settings.traces_share)
        self.is_draining = False

    @classmethod
    def open(cls, settings: Settings, table: ServingTable | None = None) -> "Engine":
        """Open the maps of the settings. ``registry.refused`` lists those that cannot be opened.

        Args:
            settings: checked.
            table: serving table that the workers of a service share; None for a single process. With a shared table the engine
                opens the versions that serve in the other workers, and waits until it can.

        Raises:
            StreetfixError: there are bundles, but none can be mounted. With the setting ``strict``: one cannot be mounted, or
                there is none.
        """
        limit_pools()
        registry = MapRegistry(provider=settings.provider, table=table)
        tiles = TileMetrics()
        watcher = watcher_of(registry, settings, tiles)
        watcher.open_first(strict=settings.strict)
        return cls(registry, settings, watcher, tiles)

    def serve_version(self, name: str, version: str) -> Localizer:
        """Select the serving version of a map, in every worker.

        Args:
            name: of the map.
            version: a mounted version.

        Raises:
            UnknownMapError: no such map or version is mounted.
        """
        return self.registry.serve(name, version)

    @property
    def is_ready(self) -> bool:
        """Whether a map is mounted and the service is not shutting down."""
        return len(self.registry) > 0 and not self.is_draining

    def drain(self) -> None:
        """Mark the service as shutting down. It still answers. Safe to call from a signal handler."""
        self.is_draining = True

    def localizer_for(self, encoded: EncodedQuery) -> Localizer:
        """Return the localizer of the map that a query names, or of the map that is nearest to its prior on the Earth.

        Args:
            encoded: the query.

        Raises:
            NotReadyError: no map is mounted.
            UnknownMapError: no map has that name; or the query names none, several maps are mounted, and its prior cannot choose one.
        """
        return self.registry.get(encoded.map_name, encoded.prior_wgs84)

    def localize(self, encoded: EncodedQuery) -> Located:
        """Decode and localize one query, in the thread of the caller.

        Args:
            encoded: the query.

        Raises:
            NotReadyError: no map is mounted.
            UnknownMapError: as ``localizer_for``.
            RequestError: an image cannot be decoded, has the wrong size, or holds no depth.
            UnsupportedFormatError: the format of an image is not supported.
            TooLargeError: an image exceeds the limits.
        """
        return self.localize_sequence((encoded,), (_HERE,))

    def localize_sequence(
        self, encoded: tuple[EncodedQuery, ...], T_reference_camera: tuple[NDArray[np.float64], ...]
    ) -> Located:
        """Decode several image pairs and localize them as one, in the thread of the caller.

        Args:
            encoded: the image pairs, the reference first; its map is queried, and its track continues.
            T_reference_camera: for each pair, from its camera frame to the reference camera frame, (4, 4), metres. The first is
                the identity.

        Raises:
            StreetfixError: as for ``localize``; with several pairs its field is under ``frames.K``.
        """
        if encoded[0].track is not None:
            return self._continued(encoded, T_reference_camera, encoded[0].track)
        return self._without_track(encoded, T_reference_camera)

    @timed_request()
    def _without_track(
        self, encoded: tuple[EncodedQuery, ...], T_reference_camera: tuple[NDArray[np.float64], ...]
    ) -> Located:
        localizer = self.localizer_for(encoded[0])
        return self.answer(localizer, self._frames(localizer, encoded, T_reference_camera))

    def _frames(
        self,
        localizer: Localizer,
        encoded: tuple[EncodedQuery, ...],
        T_reference_camera: tuple[NDArray[np.float64], ...],
    ) -> tuple[EncodedFrame, ...]:
        """Decode and look up image pairs. The field of an error is under ``frames.K`` if there are several."""
        frames = []
        for number, (each, T) in enumerate(zip(encoded, T_reference_camera, strict=True)):
            try:
                frame = self.encode_and_search(localizer, each)
            except StreetfixError as error:
                if len(encoded) > 1:
                    error.field = f"frames.{number}.{error.field}" if error.field else f"frames.{number}"
                raise
            frames.append(replace(frame, T_reference_camera=T))
        return tuple(frames)

    def answer(self, localizer: Localizer, frames: tuple[EncodedFrame, ...]) -> Located:
        """Answer frames that were looked up, and count the answer in the metrics.

        Args:
            localizer: of the map in which the frames were looked up.
            frames: the reference first.
        """
        return self._counted(localizer.answer(frames), localizer)

    @timed_request()
    def follow(
        self,
        localizer: Localizer,
        encoded: tuple[EncodedQuery, ...],
        track: Track,
        T_previous_camera: NDArray[np.float64] | None,
        odometry_std: OdometryStd | None = None,
        T_reference_camera: tuple[NDArray[np.float64], ...] = (_HERE,),
    ) -> tuple[Located, Track]:
        """Decode and answer the next frame of a robot, and count the answer in the metrics.

        Args:
            localizer: of the map.
            encoded: the image pairs of this moment: one, or those of the cameras of a rig with the reference first.
            track: of the frames before.
            T_previous_camera: odometry, from this camera's frame to the previous camera's frame, metres; None if it is unknown.
            odometry_std: standard deviations of the odometry; None if they are unknown.
            T_reference_camera: for each pair, as in ``localize_sequence``.

        Raises:
            StreetfixError: as for ``localize_sequence``.
        """
        frame, *beside = self._frames(localizer, encoded, T_reference_camera)
        answer, following = follow(localizer, frame, track, T_previous_camera, odometry_std, beside=tuple(beside))
        expect_next(localizer.bundle, following, T_previous_camera)
        if following.epoch != track.epoch:
            self.metrics.disrupted(localizer.bundle)
        return self._counted(answer, localizer), following

    def _counted(self, answer: Answer, localizer: Localizer) -> Located:
        self.metrics.answered(answer, localizer.bundle, frames=answer.frames)
        if self.settings.console:  # only the console reads them
            self.last_answers.add(answer, localizer.bundle, frames=answer.frames)
        return Located(answer, localizer.bundle)

    def _continued(
        self,
        encoded: tuple[EncodedQuery, ...],
        T_reference_camera: tuple[NDArray[np.float64], ...],
        carried: CarriedTrack,
    ) -> Located:
        """Answer a query whose client carries the belief.

        Raises:
            RequestError: the belief was not sealed by this service.
        """
        localizer = self.localizer_for(encoded[0])
        version = f"{localizer.bundle.name}@{localizer.bundle.manifest.version}"
        track = Track()
        if carried.sealed_belief is not None:
            content = self._seal.opened(carried.sealed_belief)
            if content is None:
                raise RequestError(
                    "track.belief: it does not come from this service, or the service has another key since it was restarted; omit "
                    "track.belief to begin again, or set STREETFIX_BELIEF_KEY to the same value in all replicas",
                    field="track.belief",
                )
            track = unpacked(content, map_version=version)
        located, following = self.follow(
            localizer, encoded, track, carried.T_previous_camera, carried.odometry_std, T_reference_camera
        )
        if located.answer.belief is None:
            return located
        content = packed(following, map_version=version)
        return replace(located, sealed_belief=self._seal.sealed(content))

    def encode_and_search(self, localizer: Localizer, encoded: EncodedQuery) -> EncodedFrame:
        """Decode an image pair and retrieve its most similar places.

        Args:
            localizer: of the map to search.
            encoded: the pair.

        Raises:
            StreetfixError: as for ``localize``.
        """
        with stage("decode"):
            query = self._decode(encoded, localizer.bundle)
        return localizer.encode_and_search(query)

    def close(self) -> None:
        """Wait for running requests and drop waiting ones."""
        self.admission.close()

    def _decode(self, encoded: EncodedQuery, bundle: Map) -> Query:
        """Decode both images. Their memory stays reserved until the depth image is deleted."""
        converted = encoded.depth_kind == "range" or encoded.depth_encoding == "carla"
        of_pixel = {"rgb": RGB_PEAK, "depth": DEPTH_PEAK_CONVERTED if converted else DEPTH_PEAK}
        with self.memory.hold() as hold:
            hold.grow(len(encoded.rgb) + len(encoded.depth))
            limits = self.settings.limits
            image_limits = ImageLimits(
                max_bytes=limits.max_part_bytes,
                max_pixels=limits.max_pixels,
                reserve=lambda field, pixels: hold.grow(pixels * of_pixel[field]),
            )
            query = query_in(encoded, bundle, self.settings.false_accept_rate, limits=image_limits)
            hold.shrink_to(query.rgb.nbytes + query.depth_m.size * DEPTH_KEPT)
            hold.leave_with(query.depth_m)
        return query


def expect_next(bundle: Map, track: Track, T_previous_camera: NDArray[np.float64] | None) -> None:
    """Let a tiled map prepare the tiles that a robot moves towards. This changes no answer.

    Args:
        bundle: the map.
        track: of the robot, after its last frame.
        T_previous_camera: odometry, from the last camera's frame to the frame of the camera before it, metres; None if it is unknown.
    """
    at = track.belief.modes[0] if track.belief.modes else track.last
    if at is not None and T_previous_camera is not None:
        T_map_previous = at.T_map_camera @ inverse(T_previous_camera)
        bundle.expect_next(at.T_map_camera[:2, 3], T_map_previous[:2, 3])


def watcher_of(registry: MapRegistry, settings: Settings, tiles: TileMetrics) -> MapWatcher:
    """Return the watcher of the maps of the settings. It has looked at none of them.

    Args:
        registry: where maps are mounted.
        settings: checked.
        tiles: counts the requests of tiles and the fetches.

    Raises:
        BundleError: there are maps in object storage, and the folder of the cache cannot be used.
        ExtraMissingError: the settings have a search server, and its client is not installed.
    """
    stored = []
    if urls := [each for each in settings.maps if isinstance(each, MapUrl)]:
        cache = TileCache(settings.tile_cache or default_folder(), settings.tile_cache_bytes)
        cache.clean()
        follow = partial(FetchLog, on_fetched=tiles.fetched)
        elsewhere = settings.qdrant_url is not None
        stored = [StoredMap(each, cache, follow, tiles.requested, is_searched_elsewhere=elsewhere) for each in urls]
    paths = [each for each in settings.maps if isinstance(each, Path)]
    return MapWatcher(
        registry,
        paths,
        warm=partial(warm_up, settings.false_accept_rate),
        stored=stored,
        open_tile_bytes=settings.open_tile_bytes,
        open_search=None if settings.qdrant_url is None else _search_server(settings, settings.qdrant_url),
    )


def _search_server(settings: Settings, url: str) -> OpenSearch:
    """Return what opens the search of a map in Qdrant."""
    from service.maps.qdrant import CARE_S, Collection, QdrantSearch

    key = None if settings.qdrant_api_key is None else settings.qdrant_api_key.get_secret_value()
    open_collection = partial(Collection.open, url, settings.qdrant_collection, api_key=key)
    collection = open_collection(timeout_s=settings.qdrant_timeout_s)

    def open_search(of_map: Manifest) -> QdrantSearch:
        search, counting = QdrantSearch(collection, of_map), open_collection(timeout_s=CARE_S)
        try:
            search.require_complete(counting)
        finally:
            counting.close()
        return search

    return open_search


def warm_up(false_accept_rate: float, localizer: Localizer) -> None:
    """Localize one random query, so that the encoder and the first map pages are in memory.

    It runs in the thread of the caller.

    Args:
        false_accept_rate: setting of the service for requests that give none.
        localizer: of the map.

    Raises:
        BundleError: the calibration of the map cannot guarantee this rate, so the map would refuse such requests.
        StreetfixError: the map cannot answer.
    """
    limit_pools()
    bundle = localizer.bundle
    if bundle.calibration is not None and false_accept_rate < (least := bundle.calibration.least_false_accept_rate):
        raise BundleError(
            f"{bundle.path}: the setting false_accept_rate is {false_accept_rate:g}, but the calibration of this map "
            f"supports {least:g} or more, so the service would refuse every request; set STREETFIX_FALSE_ACCEPT_RATE to {least:g} or more",
            field="false_accept_rate",
        )
    camera = PinholeCamera(64, 48, 32.0, 32.0, 31.5, 23.5)
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 255, (48, 64, 3), np.uint8)
    depth_m = rng.uniform(2.0, 20.0, (48, 64)).astype(np.float32)
    localizer.localize(Query(rgb=rgb, depth_m=depth_m, camera=camera, false_accept_rate=false_accept_rate))


def query_in(
    encoded: EncodedQuery, bundle: Map, false_accept_rate: float, *, limits: ImageLimits = DEFAULT_LIMITS
) -> Query:
    """Decode both images, and return the query with its options.

    Args:
        encoded: the query.
        bundle: the map; it gives the view grid and the place of a prior on the Earth.
        false_accept_rate: setting of the service for requests that give none.
        limits: largest size of each image.

    Raises:
        StreetfixError: as ``decoded_query`` and ``prior_in``.
    """
    depth_format = DepthFormat(
        encoding=encoded.depth_encoding,
        kind=encoded.depth_kind,
        scale_m=encoded.scale_m,
        baseline_m=encoded.baseline_m,
        max_range_m=encoded.max_range_m,
    )
    query = decoded_query(encoded.rgb, encoded.depth, encoded.camera, depth_format, grid=bundle.grid, limits=limits)
    return replace(
        query,
        down_camera=encoded.down_camera,
        camera_height=encoded.camera_height,
        T_vehicle_camera=encoded.T_vehicle_camera,
        neighbours=encoded.neighbours,
        refine=encoded.refine,
        prior=prior_in(encoded, bundle),
        false_accept_rate=encoded.false_accept_rate or false_accept_rate,
        rate_is_named=encoded.false_accept_rate is not None,
    )


def prior_in(encoded: EncodedQuery, bundle: Map) -> Prior | None:
    """Return the prior of a query in the map frame; None if there is none.

    Args:
        encoded: the query; its prior may have a position on the Earth.
        bundle: the map.

    Raises:
        RequestError: the prior has a position on the Earth, and the map is not georeferenced.
    """
    if encoded.prior is None or encoded.prior_wgs84 is None:
        return encoded.prior
    earth = bundle.earth
    if earth is None:
        raise RequestError(
            f"prior.wgs84: the map {bundle.name!r} is not georeferenced; send prior.position in the map frame",
            field="prior.wgs84",
        )
    latitude_deg, longitude_deg = encoded.prior_wgs84
    return replace(encoded.prior, position_m=earth.to_map(latitude_deg, longitude_deg, earth.height_m)[:2])
