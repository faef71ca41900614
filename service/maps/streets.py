"""Street polygons of a map. A polygon has a street, a section and a class of the paper's Table I."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from numpy.typing import NDArray

from service.errors import BundleError

FILE = "streets.geojson"
#: Margin of the box of a street, metres. It is much more than the rounding of a crossing.
_SLACK_M = 1.0
#: A ring of a polygon. ``_`` because the rings of one street differ in length.
Ring = Float64[NDArray[np.float64], "_ 2"]


@dataclass(frozen=True, slots=True)
class Street:
    """One feature of ``streets.geojson``: a street or a section of a street.

    Attributes:
        id: id of the feature.
        street: id of the street that the feature belongs to.
        section: section of the street. None for a whole street.
        name: name for people.
        class_index: class of the paper's Table I. The default is the feature's index in the file.
        polygons: rings of each polygon, x and y in the coordinates of the file.
    """

    id: str
    street: str
    section: Literal["beginning", "end"] | None
    name: str
    class_index: int
    polygons: tuple[tuple[Ring, ...], ...]
    _box: tuple[float, float, float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Find the box of the polygons. Most points lie outside of it, and need no further check."""
        points = np.concatenate([np.zeros((0, 2)), *(ring for rings in self.polygons for ring in rings)])
        low, high = points.min(axis=0, initial=np.inf) - _SLACK_M, points.max(axis=0, initial=-np.inf) + _SLACK_M
        object.__setattr__(self, "_box", (*low.tolist(), *high.tolist()))

    def contains(self, position: Float64[NDArray[np.float64], "2"]) -> bool:
        """Check whether a point lies inside a polygon. Holes are outside.

        Args:
            position: x, y in the coordinates of the polygons (map metres in a bundle).
        """
        x0, y0, x1, y1 = self._box
        if not (x0 <= position[0] <= x1 and y0 <= position[1] <= y1):
            return False
        return any(sum(_inside(ring, position) for ring in rings) % 2 == 1 for rings in self.polygons)


class Streets:
    """The streets of a map in the order of the file. Other files refer to a street by its index.

    Args:
        features: the streets.

    Attributes:
        features: the streets.
    """

    def __init__(self, features: tuple[Street, ...]) -> None:
        self.features = features

    def __len__(self) -> int:
        return len(self.features)

    def __getitem__(self, index: int) -> Street:
        return self.features[index]

    @classmethod
    def from_geojson(cls, document: object) -> "Streets":
        """Read a FeatureCollection of Polygon and MultiPolygon features.

        Args:
            document: the parsed GeoJSON.

        Raises:
            BundleError: the document is no FeatureCollection, or a feature is invalid. The message names the feature's index.
        """
        if not isinstance(document, dict) or document.get("type") != "FeatureCollection":
            raise _defect("not a GeoJSON FeatureCollection")
        features = document.get("features")
        if not isinstance(features, list):
            raise _defect("the list of features is missing")
        return cls(tuple(_street_from(feature, number) for number, feature in enumerate(features)))

    def index_at(self, position: Float64[NDArray[np.float64], "2"]) -> int:
        """Return the index of the first street that contains a point, or -1 if there is none.

        Args:
            position: x, y in the coordinates of the polygons (map metres in a bundle).
        """
        return next((index for index, street in enumerate(self.features) if street.contains(position)), -1)


@dataclass(frozen=True, slots=True, eq=False)
class StreetsFile:
    """A ``streets.geojson`` that was read.

    Attributes:
        sha256: hash of the file, as the manifest lists it.
        document: content of the file.
        streets: its streets.
    """

    sha256: str
    document: bytes
    streets: Streets


def _inside(ring: Ring, position: Float64[NDArray[np.float64], "2"]) -> bool:
    """Check whether a point lies inside a ring by the even-odd rule, with a ray towards positive x."""
    start, end = ring, np.roll(ring, -1, axis=0)
    spans = (start[:, 1] > position[1]) != (end[:, 1] > position[1])
    rise = np.where(spans, end[:, 1] - start[:, 1], 1.0)
    crossing = start[:, 0] + (position[1] - start[:, 1]) * (end[:, 0] - start[:, 0]) / rise
    return bool(np.count_nonzero(spans & (position[0] < crossing)) % 2)


def _street_from(feature: Any, number: int) -> Street:
    try:
        properties, geometry = feature["properties"], feature["geometry"]
        kind, coordinates = geometry["type"], geometry["coordinates"]
        identity, street, section = properties["id"], properties["street"], properties["section"]
        name, class_index = properties["name"], properties.get("class_index", number)
    except (KeyError, TypeError) as missing:
        raise _defect(f"feature {number} lacks {missing}") from missing
    if section not in ("beginning", "end", None):
        raise _defect(f"feature {number} has the section {section!r}, not beginning, end or null")
    if not all(isinstance(text, str) for text in (identity, street, name)) or type(class_index) is not int:
        raise _defect(
            f"feature {number} has an id, street or name that is not text, or a class_index that is not an integer"
        )
    if kind not in ("Polygon", "MultiPolygon"):
        raise _defect(f"feature {number} is a {kind}, not a Polygon or MultiPolygon")
    polygons = [coordinates] if kind == "Polygon" else coordinates
    try:
        rings = tuple(tuple(np.array(ring, np.float64)[:, :2].copy() for ring in rings) for rings in polygons)
    except (TypeError, ValueError, IndexError) as error:
        raise _defect(f"the coordinates of feature {number} are not rings of points") from error
    if any(len(ring) < 4 or not np.isfinite(ring).all() for polygon in rings for ring in polygon):
        raise _defect(f"a ring of feature {number} has fewer than four points, or one that is not finite")
    return Street(identity, street, section, name, class_index, rings)


def _defect(what: str) -> BundleError:
    return BundleError(f"{FILE}: {what}; build the map again from a valid streets.geojson", field=FILE)
