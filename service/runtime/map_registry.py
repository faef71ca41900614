"""The open maps of a process, by name and version. A change replaces them atomically while requests run."""

import logging
import threading
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from service.errors import BundleError, NotReadyError, UnknownMapError
from service.localization.localizer import Localizer
from service.maps.manifest import FILE as MANIFEST_FILE
from service.maps.manifest import Manifest, dataset_error
from service.maps.tiles import open_map
from service.retrieval.encoder import Provider
from service.runtime.nearest_map import MapOnEarth, nearest_map
from service.runtime.serving_table import Key, MapVersion, ServingTable, Table

_log = logging.getLogger("streetfix.maps")
#: Maximum number of refused bundles that an answer names. The log names all of them.
MOST_REFUSED = 20
NO_MAP = "no map is mounted; add a map bundle to the maps folder, or try again when the operator has added one"


@dataclass(frozen=True, slots=True)
class Refused:
    """A bundle in a maps folder that is not mounted.

    Attributes:
        bundle: name of its folder.
        reason: readable text; it names no folder outside the bundle.
    """

    bundle: str
    reason: str


@dataclass(frozen=True, slots=True)
class _Map:
    """Localizers of one map, the newest version first, and the one that serves."""

    versions: tuple[Localizer, ...]
    serving: Localizer
    on_earth: MapOnEarth


@dataclass(frozen=True, slots=True)
class _View:
    """One state of the serving table, with the localizers of this process."""

    table: Table
    maps: Mapping[str, _Map]


class MapRegistry:
    """Open maps. The serving table, shared by all workers of a service, decides which versions are mounted and which one serves.

    Reading takes no lock, because a change replaces the whole view. A request keeps its localizer. A version that was removed stays
    in memory until no request uses it.

    Args:
        localizers: mounted at once.
        provider: ONNX Runtime provider for the encoders of maps that are opened later.
        table: serving table; None creates one for this process alone.

    Attributes:
        provider: as given.
        table: as given or created.
        refused: bundles that this process could not mount.

    Raises:
        BundleError: two localizers have the same version of a map.
    """

    def __init__(
        self, localizers: Sequence[Localizer] = (), *, provider: Provider = "cpu", table: ServingTable | None = None
    ) -> None:
        self.provider = provider
        self.table = table or ServingTable()
        self.refused: tuple[Refused, ...] = ()
        self._open: dict[Key, Localizer] = {}
        self._changing = threading.Lock()
        self._on_change: Callable[[Sequence[Localizer]], object] = lambda _: None
        self._view = _View(Table(), {})
        for localizer in localizers:
            bundle = localizer.bundle
            for other in self.versions(bundle.name):
                if other.bundle.manifest.version == bundle.manifest.version:
                    raise duplicate_version_error(bundle.path, other.bundle.path, bundle.manifest)
            self.mount(localizer)

    @classmethod
    def open(cls, paths: Sequence[Path], *, provider: Provider = "cpu") -> "MapRegistry":
        """Open and verify every bundle, or fail.

        Args:
            paths: bundles, or folders of bundles.
            provider: ONNX Runtime provider for their encoders.

        Raises:
            EncoderError: the provider is not installed.
            BundleError: a bundle is missing, damaged or mismatched; two are the same version of a map; or there is no bundle.
        """
        bundles = [bundle for path in paths for bundle in bundle_paths(path)]
        if not bundles:
            where = ", ".join(map(str, paths))
            raise BundleError(
                f"{where}: {_NO_MANIFEST}" if paths else "no map bundle given; give a folder that build-map wrote"
            )
        return cls([Localizer.open(open_map(path), provider=provider) for path in bundles], provider=provider)

    def watch(self, callback: Callable[[Sequence[Localizer]], object]) -> None:
        """Report the mounted versions now and after every change.

        Args:
            callback: called with all mounted versions of all maps. It must not use the registry.
        """
        with self._changing:
            self._on_change = callback
            self._renew()

    def __len__(self) -> int:
        return len(self._maps())

    def __iter__(self) -> Iterator[Localizer]:
        """Iterate over the serving version of each map."""
        return iter([each.serving for each in self._maps().values()])

    @property
    def has_open(self) -> bool:
        """Whether this process has any map open, mounted or not."""
        return bool(self._open)

    def get(self, name: str | None, near: tuple[float, float] | None = None) -> Localizer:
        """Return the localizer of a map.

        Args:
            name: of the map, or ``name@version`` for one version. None takes the only mounted map, or the nearest one to ``near``.
            near: latitude and longitude where the camera is about, degrees; None if unknown. It counts if several maps are mounted
                and the name is None.

        Raises:
            NotReadyError: no map is mounted.
            UnknownMapError: no map has that name; or several maps are mounted, the name is None, and ``near`` is None or no map is
                georeferenced.
        """
        maps = self._maps()
        if not maps:
            raise NotReadyError(NO_MAP)
        if name is None and len(maps) == 1:
            return next(iter(maps.values())).serving
        if name is not None:
            plain, _, version = name.partition("@")
            if plain in maps and not version:
                return maps[plain].serving
            for localizer in maps[plain].versions if plain in maps else ():
                if localizer.bundle.manifest.version == version:
                    return localizer
        what = f"map {(name or '')[:100]!r} not found"
        if name is None:
            nearest = None if near is None else nearest_map((each.on_earth for each in maps.values()), *near)
            if nearest is not None:
                return nearest
            what = "several maps are mounted, and the request names none"
            if near is not None:
                what += "; prior.wgs84 cannot choose one, because none of them is georeferenced"
        raise UnknownMapError(f"{what}; mounted maps: {', '.join(maps)}", field="map")

    def versions(self, name: str) -> tuple[Localizer, ...]:
        """Return every mounted version of a map, the newest first; empty for an unknown map.

        Args:
            name: of the map.
        """
        known = self._maps().get(name)
        return () if known is None else known.versions

    def mount(self, localizer: Localizer) -> None:
        """Add a version, or replace the same version.

        It is mounted once every worker has it, and serves if no mounted version is newer. Beyond ``MOST_VERSIONS`` the oldest version
        that does not serve is dropped.

        Args:
            localizer: of the version.
        """
        version = version_of(localizer.bundle.manifest)
        with self._changing:
            self._open[version.key] = localizer
            self.table.offer(version)
            self._renew()

    def join(self, given_up: Collection[Key] = ()) -> frozenset[MapVersion]:
        """Join the other workers, see ``ServingTable.join``.

        Args:
            given_up: mounted versions that this worker failed to open.

        Returns:
            Mounted versions that this worker must first open or give up; empty if it has joined.
        """
        with self._changing:
            lacking = self.table.join([version_of(each.bundle.manifest) for each in self._open.values()], given_up)
            self._renew()
            return lacking

    def wants(self, version: MapVersion) -> bool:
        """Return whether this process should open a version.

        That holds if the version is not open here yet, and is mounted or would be mounted once every worker had it.

        Args:
            version: of a bundle in a maps folder.
        """
        self._maps()  # releases versions that were removed meanwhile
        if (known := self._open.get(version.key)) is not None and _made_at(known.bundle.manifest) >= version.made_at:
            return False
        table = self.table.read()
        if table.is_mounted(version.key) and known is None:
            return True
        mine = [version_of(each.bundle.manifest) for key, each in self._open.items() if not table.is_mounted(key)]
        return table.wants(version, mine)

    def serve(self, name: str, version: str) -> Localizer:
        """Select the serving version of a map in all workers, to roll back or forward.

        Args:
            name: of the map.
            version: a mounted version.

        Raises:
            UnknownMapError: no such map or version is mounted.
        """
        self.table.choose(name, version)
        return self.get(f"{name}@{version}")

    def unmount(self, name: str, version: str) -> None:
        """Unmount a version in all workers. If it served, the newest remaining version serves.

        Args:
            name: of the map; an unknown one is ignored.
            version: of the map; an unknown one is ignored.
        """
        self.table.remove([(name, version)])

    def _maps(self) -> Mapping[str, _Map]:
        if self._view.table is not self.table.read():
            with self._changing:
                self._renew()
        return self._view.maps

    def _renew(self) -> None:
        """Update the view from the table and release versions that are neither mounted nor offered.

        The caller must hold the lock.
        """
        table = self.table.read()
        offers = table.offers.get(self.table.number)
        if offers is not None:
            offered = {each.key for each in offers}
            self._open = {key: each for key, each in self._open.items() if table.is_mounted(key) or key in offered}
        maps = {}
        for name, known in table.maps.items():
            versions = {each.version: self._open[each.key] for each in known.versions if each.key in self._open}
            if known.serving in versions:
                maps[name] = _Map(tuple(versions.values()), serving := versions[known.serving], MapOnEarth(serving))
            elif offers is not None:  # must not happen: a worker joins only when it has all of them
                _log.error("map_lacking name=%s version=%s", name, known.serving)
        self._view = _View(table, maps)
        self._on_change([localizer for each in maps.values() for localizer in each.versions])


def version_of(manifest: Manifest) -> MapVersion:
    """Return the entry of a bundle in the serving table.

    Args:
        manifest: of the bundle.
    """
    return MapVersion(manifest.name, manifest.version, _made_at(manifest))


def duplicate_version_error(path: Path, other: Path, manifest: Manifest) -> BundleError:
    """Build the error for two bundles with the same version of a map.

    Args:
        path: of one bundle.
        other: path of the other bundle.
        manifest: of either.
    """
    return BundleError(
        f"{path} and {other} have the same version {manifest.version} of {manifest.name!r}; mount only one of them"
    )


def _made_at(manifest: Manifest) -> float:
    return manifest.made_at.timestamp()


def bundle_paths(path: Path) -> list[Path]:
    """Return the path itself if it is a bundle, else the bundles directly inside the folder; empty for an empty folder.

    Hidden folders, which are incomplete, and folders without a manifest are ignored.

    Args:
        path: a bundle, or a folder of bundles.

    Raises:
        BundleError: the folder is missing or cannot be read; or it holds files but no manifest, as a partly copied bundle does.
    """
    if _has_manifest(path):
        return [path]
    try:
        inside = sorted(child for child in path.iterdir() if not child.name.startswith("."))
        files = [child for child in inside if child.is_file()]
    except (FileNotFoundError, NotADirectoryError) as error:
        raise BundleError(f"{path}: folder not found; give a map bundle that build-map wrote") from error
    except OSError as error:
        raise BundleError(f"{path}: cannot be read ({error.strerror}); give the service read permission") from error
    found = [child for child in inside if _has_manifest(child)]
    if files and not found:
        raise dataset_error(path) or BundleError(f"{path}: {_NO_MANIFEST}")
    return found


_NO_MANIFEST = f"not a map bundle: {MANIFEST_FILE} is missing; build the map again, or copy the whole bundle"


def _has_manifest(folder: Path) -> bool:
    try:
        return (folder / MANIFEST_FILE).exists()
    except OSError:  # such as lost+found of a new volume, which only root may read
        return False
