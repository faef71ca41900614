"""The maps that a service has open, by name."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from service.errors import BundleError, UnknownMapError
from service.localization.localizer import Localizer
from service.maps.manifest import FILE as MANIFEST_FILE
from service.maps.reader import MapBundle


class MapRegistry:
    """Open maps; names are unique."""

    def __init__(self, localizers: Sequence[Localizer] = ()) -> None:
        self._by_name: dict[str, Localizer] = {}
        for localizer in localizers:
            bundle = localizer.bundle
            if bundle.name in self._by_name:
                other = self._by_name[bundle.name].bundle.path
                raise BundleError(
                    f"{bundle.path} and {other} are both called {bundle.name!r}: mount one of them, or build the other "
                    "under another name"
                )
            self._by_name[bundle.name] = localizer

    @classmethod
    def open(cls, paths: Sequence[Path]) -> "MapRegistry":
        """Open and verify every bundle.

        Args:
            paths: bundles, or folders that hold some.

        Raises:
            BundleError: one is missing, damaged or mismatched, two share a name, or there is none at all.
        """
        bundles = [bundle for path in paths for bundle in bundle_paths(path)]
        if not bundles:
            raise BundleError("there is no map to serve: give a folder that build-map wrote")
        return cls([Localizer.open(MapBundle.open(path)) for path in bundles])

    def __len__(self) -> int:
        return len(self._by_name)

    def __iter__(self) -> Iterator[Localizer]:
        return iter(self._by_name.values())

    def get(self, name: str | None) -> Localizer:
        """The map of a name; without a name, the only one.

        Raises:
            UnknownMapError: no map has that name, or none is named and there are several.
        """
        if name is None and len(self._by_name) == 1:
            return next(iter(self))
        if name is not None and name in self._by_name:
            return self._by_name[name]
        mounted = ", ".join(self._by_name) or "none"
        what = "several maps are mounted and the request names none" if name is None else f"there is no map {name!r}"
        raise UnknownMapError(f"{what}; mounted: {mounted}", field="map")


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
