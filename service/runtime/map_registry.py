"""The maps that a service has open, by name and version; swapped whole while requests run."""

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from service.errors import BundleError, UnknownMapError
from service.localization.encoder import Provider
from service.localization.localizer import Localizer
from service.maps.manifest import FILE as MANIFEST_FILE
from service.maps.reader import MapBundle

#: Versions of one map that stay open: the one that serves, and what may be rolled back to.
MOST_VERSIONS = 3


@dataclass(frozen=True, slots=True)
class _Map:
    """Versions of one name, the newest first, and the one that serves."""

    versions: tuple[Localizer, ...]
    serving: Localizer


class MapRegistry:
    """Open maps. Reading takes no lock: what is mounted is one value that a change replaces whole.

    A request keeps the localizer it got; a version that was taken out lives as long as a request has it.
    """

    def __init__(self, localizers: Sequence[Localizer] = (), *, provider: Provider = "cpu") -> None:
        self.provider = provider
        self._maps: dict[str, _Map] = {}
        self._changing = threading.Lock()
        for localizer in localizers:
            bundle = localizer.bundle
            for other in self.versions(bundle.name):
                if other.bundle.manifest.version == bundle.manifest.version:
                    raise BundleError(
                        f"{bundle.path} and {other.bundle.path} are both version {bundle.manifest.version} of {bundle.name!r}: "
                        "mount one of them"
                    )
            self.mount(localizer)

    @classmethod
    def open(cls, paths: Sequence[Path], *, provider: Provider = "cpu") -> "MapRegistry":
        """Open and verify every bundle.

        Args:
            paths: bundles, or folders that hold some.
            provider: what runs their encoders.

        Raises:
            EncoderError: the provider is not installed.
            BundleError: one is missing, damaged or mismatched, two are the same version of a map, or there is none at all.
        """
        bundles = [bundle for path in paths for bundle in bundle_paths(path)]
        if not bundles:
            raise BundleError("there is no map to serve: give a folder that build-map wrote")
        return cls([Localizer.open(MapBundle.open(path), provider=provider) for path in bundles], provider=provider)

    def __len__(self) -> int:
        return len(self._maps)

    def __iter__(self) -> Iterator[Localizer]:
        """The version that serves of each map."""
        return iter([each.serving for each in self._maps.values()])

    def get(self, name: str | None) -> Localizer:
        """The map of a name, or one version of it as ``name@version``; without a name, the only one.

        Raises:
            UnknownMapError: no map has that name, or none is named and there are several.
        """
        maps = self._maps
        if name is None and len(maps) == 1:
            return next(iter(maps.values())).serving
        if name is not None:
            plain, _, version = name.partition("@")
            if plain in maps and not version:
                return maps[plain].serving
            for localizer in maps[plain].versions if plain in maps else ():
                if localizer.bundle.manifest.version == version:
                    return localizer
        mounted = ", ".join(maps) or "none"
        what = (
            "several maps are mounted and the request names none" if name is None else f"there is no map {name[:100]!r}"
        )
        raise UnknownMapError(f"{what}; mounted: {mounted}", field="map")

    def versions(self, name: str) -> tuple[Localizer, ...]:
        """Every open version of a map, the newest first; none of an unknown one."""
        known = self._maps.get(name)
        return () if known is None else known.versions

    def mount(self, localizer: Localizer) -> None:
        """Add a version, in place of the same one; it serves from now on if no open version is newer.

        Of more than ``MOST_VERSIONS`` the oldest that does not serve is dropped.
        """
        with self._changing:
            name, version = localizer.bundle.name, localizer.bundle.manifest.version
            before = self._maps.get(name)
            others = [] if before is None else [o for o in before.versions if o.bundle.manifest.version != version]
            versions = sorted([localizer, *others], key=_made_at, reverse=True)
            serving = versions[0] if before is None or versions[0] is localizer else before.serving
            if serving not in versions:  # the same version again, from another folder
                serving = localizer
            while len(versions) > MOST_VERSIONS:
                versions.remove([each for each in versions if each is not serving][-1])
            self._maps = self._maps | {name: _Map(tuple(versions), serving)}

    def serve(self, name: str, version: str) -> Localizer:
        """Let another open version of a map serve: roll back, or forward again.

        Raises:
            UnknownMapError: no such map or version is open.
        """
        with self._changing:
            if name not in self._maps:
                raise UnknownMapError(
                    f"there is no map {name!r}; mounted: {', '.join(self._maps) or 'none'}", field="map"
                )
            known = self._maps[name]
            for localizer in known.versions:
                if localizer.bundle.manifest.version == version:
                    self._maps = self._maps | {name: _Map(known.versions, localizer)}
                    return localizer
            there = ", ".join(each.bundle.manifest.version for each in known.versions)
            raise UnknownMapError(f"there is no version {version!r} of {name!r}; open: {there}", field="version")

    def unmount(self, name: str, version: str) -> None:
        """Take a version out; if it served, the newest of the others does. Nothing happens if it is not there."""
        with self._changing:
            if name not in self._maps:
                return
            left = tuple(each for each in self._maps[name].versions if each.bundle.manifest.version != version)
            serving = self._maps[name].serving
            maps = {each: known for each, known in self._maps.items() if each != name}
            if left:
                maps[name] = _Map(left, serving if serving in left else left[0])
            self._maps = maps


def _made_at(localizer: Localizer) -> float:
    return localizer.bundle.manifest.made_at.timestamp()


def bundle_paths(path: Path) -> list[Path]:
    """A bundle itself, or the bundles right inside a folder (hidden ones, half written, are passed over).

    Raises:
        BundleError: the folder is not there, or is neither a bundle nor holds one.
    """
    if not path.is_dir():
        raise BundleError(f"{path}: there is no such folder; give a map bundle that build-map wrote")
    if (path / MANIFEST_FILE).exists():
        return [path]
    inside = sorted(child for child in path.iterdir() if not child.name.startswith("."))
    found = [child for child in inside if (child / MANIFEST_FILE).exists()]
    if not found:
        raise BundleError(f"{path}: there is no {MANIFEST_FILE} in it: it is no map bundle, or its build was cut off")
    return found
