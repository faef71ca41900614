"""The maps that a process has open, by name and version; swapped whole while requests run."""

import logging
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from service.errors import BundleError, NotReadyError, UnknownMapError
from service.localization.encoder import Provider
from service.localization.localizer import Localizer
from service.maps.manifest import FILE as MANIFEST_FILE
from service.maps.manifest import Manifest
from service.maps.reader import MapBundle
from service.runtime.serving_table import Key, MapVersion, ServingTable, Table

_log = logging.getLogger("streetfix.maps")
#: Refused bundles that are named to those who ask; the log names all.
MOST_REFUSED = 20
NO_MAP = "no map is mounted; put a map bundle into the maps folder, or ask again when the operator has done so"


@dataclass(frozen=True, slots=True)
class Refused:
    """A bundle that lies in a maps folder and is not mounted.

    Attributes:
        bundle: the folder's own name.
        reason: for people; names no folder but the bundle's.
    """

    bundle: str
    reason: str


@dataclass(frozen=True, slots=True)
class _Map:
    """Versions of one name, the newest first, and the one that serves."""

    versions: tuple[Localizer, ...]
    serving: Localizer


@dataclass(frozen=True, slots=True)
class _View:
    """A state of the serving table with the localizers of this process."""

    table: Table
    maps: Mapping[str, _Map]


class MapRegistry:
    """Open maps. What may be asked, and which version serves, says the serving table, which all workers of a service share.

    Reading takes no lock: what is mounted is one value that a change replaces whole. A request keeps the localizer that it got; a
    version that was taken out lives as long as a request has it.

    Args:
        localizers: to mount at once.
        provider: what runs the encoders of maps that are opened later.
        table: None makes one for this process alone.

    Attributes:
        refused: bundles that are not mounted, as this process found them.
    """

    def __init__(
        self, localizers: Sequence[Localizer] = (), *, provider: Provider = "cpu", table: ServingTable | None = None
    ) -> None:
        self.provider = provider
        self.table = table or ServingTable()
        self.refused: tuple[Refused, ...] = ()
        self._open: dict[Key, Localizer] = {}
        self._changing = threading.Lock()
        self._view = _View(Table(), {})
        for localizer in localizers:
            bundle = localizer.bundle
            for other in self.versions(bundle.name):
                if other.bundle.manifest.version == bundle.manifest.version:
                    raise twin_error(bundle.path, other.bundle.path, bundle.manifest)
            self.mount(localizer)

    @classmethod
    def open(cls, paths: Sequence[Path], *, provider: Provider = "cpu") -> "MapRegistry":
        """Open and verify every bundle, or fail.

        Args:
            paths: bundles, or folders that hold some.
            provider: what runs their encoders.

        Raises:
            EncoderError: the provider is not installed.
            BundleError: one is missing, damaged or mismatched, two are the same version of a map, or there is none at all.
        """
        bundles = [bundle for path in paths for bundle in bundle_paths(path)]
        if not bundles:
            where = ", ".join(map(str, paths))
            raise BundleError(
                f"{where}: {_NO_MANIFEST}" if paths else "there is no map to serve: give a folder that build-map wrote"
            )
        return cls([Localizer.open(MapBundle.open(path), provider=provider) for path in bundles], provider=provider)

    def __len__(self) -> int:
        return len(self._maps())

    def __iter__(self) -> Iterator[Localizer]:
        """The version that serves of each map."""
        return iter([each.serving for each in self._maps().values()])

    @property
    def has_open(self) -> bool:
        """Whether this process has any map open, mounted or not."""
        return bool(self._open)

    def get(self, name: str | None) -> Localizer:
        """The map of a name, or one version of it as ``name@version``; without a name, the only one.

        Raises:
            NotReadyError: no map is mounted at all.
            UnknownMapError: no map has that name, or none is named and there are several.
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
        mounted = ", ".join(maps)
        what = (
            "several maps are mounted and the request names none" if name is None else f"there is no map {name[:100]!r}"
        )
        raise UnknownMapError(f"{what}; mounted: {mounted}", field="map")

    def versions(self, name: str) -> tuple[Localizer, ...]:
        """Every mounted version of a map, the newest first; none of an unknown one."""
        known = self._maps().get(name)
        return () if known is None else known.versions

    def mount(self, localizer: Localizer) -> None:
        """Add a version, in place of the same one. It is mounted once every worker has it, and serves if no mounted version is newer.

        Of more than ``MOST_VERSIONS`` the oldest that does not serve is dropped.
        """
        version = version_of(localizer.bundle.manifest)
        with self._changing:
            self._open[version.key] = localizer
            self.table.offer(version)
            self._renew()

    def join(self, given_up: Collection[Key] = ()) -> frozenset[MapVersion]:
        """Agree with the other workers, as ``ServingTable.join`` says: mounted versions that must be opened, or given up, first."""
        with self._changing:
            lacking = self.table.join([version_of(each.bundle.manifest) for each in self._open.values()], given_up)
            self._renew()
            return lacking

    def wants(self, version: MapVersion) -> bool:
        """Whether a version should be opened here: it is mounted, or would be if every worker had it, and is not open yet."""
        self._maps()  # lets go of what was taken out meanwhile
        if (known := self._open.get(version.key)) is not None and _made_at(known.bundle.manifest) >= version.made_at:
            return False
        table = self.table.read()
        if table.is_mounted(version.key) and known is None:
            return True
        mine = [version_of(each.bundle.manifest) for key, each in self._open.items() if not table.is_mounted(key)]
        return table.wants(version, mine)

    def serve(self, name: str, version: str) -> Localizer:
        """Let another mounted version of a map serve, in all workers: roll back, or forward again.

        Raises:
            UnknownMapError: no such map or version is mounted.
        """
        self.table.choose(name, version)
        return self.get(f"{name}@{version}")

    def unmount(self, name: str, version: str) -> None:
        """Take a version out of all workers; if it served, the newest of the others does. Nothing happens if it is not there."""
        self.table.remove([(name, version)])

    def _maps(self) -> Mapping[str, _Map]:
        if self._view.table is not self.table.read():
            with self._changing:
                self._renew()
        return self._view.maps

    def _renew(self) -> None:
        """Make the view that of the table, and let go of what is neither mounted nor offered; the caller holds the lock."""
        table = self.table.read()
        offers = table.offers.get(self.table.number)
        if offers is not None:
            offered = {each.key for each in offers}
            self._open = {key: each for key, each in self._open.items() if table.is_mounted(key) or key in offered}
        maps = {}
        for name, known in table.maps.items():
            versions = {each.version: self._open[each.key] for each in known.versions if each.key in self._open}
            if known.serving in versions:
                maps[name] = _Map(tuple(versions.values()), versions[known.serving])
            elif offers is not None:  # a worker joins only when it has all of them
                _log.error("map_lacking name=%s version=%s", name, known.serving)
        self._view = _View(table, maps)


def version_of(manifest: Manifest) -> MapVersion:
    """What the serving table knows of a bundle."""
    return MapVersion(manifest.name, manifest.version, _made_at(manifest))


def twin_error(path: Path, other: Path, manifest: Manifest) -> BundleError:
    """Two bundles are the same version of a map."""
    return BundleError(
        f"{path} and {other} are both version {manifest.version} of {manifest.name!r}: mount one of them"
    )


def _made_at(manifest: Manifest) -> float:
    return manifest.made_at.timestamp()


def bundle_paths(path: Path) -> list[Path]:
    """A bundle itself, or the bundles right inside a folder; none of a folder of maps that is empty as yet.

    Hidden folders, which are half written, and folders without a manifest are passed over.

    Raises:
        BundleError: the folder is not there or cannot be read, or holds files but no manifest, as a bundle that was copied in part does.
    """
    if _has_manifest(path):
        return [path]
    try:
        inside = sorted(child for child in path.iterdir() if not child.name.startswith("."))
        files = [child for child in inside if child.is_file()]
    except (FileNotFoundError, NotADirectoryError) as error:
        raise BundleError(f"{path}: there is no such folder; give a map bundle that build-map wrote") from error
    except OSError as error:
        raise BundleError(f"{path}: it cannot be read ({error.strerror}); let the service read it") from error
    found = [child for child in inside if _has_manifest(child)]
    if files and not found:
        raise BundleError(f"{path}: {_NO_MANIFEST}")
    return found


_NO_MANIFEST = f"there is no {MANIFEST_FILE} in it: it is no map bundle, or its build was cut off"


def _has_manifest(folder: Path) -> bool:
    try:
        return (folder / MANIFEST_FILE).exists()
    except OSError:  # as lost+found of a fresh volume, which nobody but root may look into
        return False
