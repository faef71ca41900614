"""The street network: centre lines with widths, divided into the classes of the paper's Table I."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

Line = NDArray[np.float64]

#: Grid of the polygons' coordinates, metres. Rounding them later instead would make some polygons self-intersect.
GRID_M = 0.01
#: Width on either side of the carriageway that belongs to the street's polygon, metres.
PAVEMENT_M = 3.0

#: Table I of the paper: street, section and number of test images of each class, in the paper's order.
TABLE_I = (
    ("1", "beginning", 56), ("1", "end", 54), ("2", "beginning", 22), ("2", "end", 67), ("3", None, 11),
    ("4", "beginning", 38), ("4", "end", 25), ("5", "beginning", 76), ("5", "end", 37), ("6", None, 34),
    ("7", "beginning", 53), ("7", "end", 32), ("8", None, 49), ("9", "beginning", 20), ("9", "end", 21),
    ("between", None, 31),
)  # fmt: skip


@dataclass(frozen=True)
class Street:
    """One street.

    Attributes:
        street: name of the street.
        lines: centre lines, each (n, 2), map frame, metres, about 3 m between points.
        half_width_m: half the width of the carriageway, metres.
        sections: whether the street is divided into a beginning and an end.
    """

    street: str
    lines: tuple[Line, ...]
    half_width_m: float
    sections: bool

    def classes(self) -> list[tuple[str | None, tuple[Line, ...]]]:
        """Return the section name (None without sections) and the centre lines of each class."""
        if not self.sections:
            return [(None, self.lines)]
        (line,) = self.lines
        travelled = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
        half = int(np.argmin(np.abs(travelled - travelled[-1] / 2)))
        return [("beginning", (line[: half + 1],)), ("end", (line[half:],))]


def class_name(street: str, section: str | None) -> str:
    """Return the name of a class as in the paper's Table I.

    Args:
        street: name of the street.
        section: ``beginning``, ``end``, or None for the whole street.
    """
    if street == "between":
        return "Between"
    if section is None:
        return f"Street {street}"
    return f"{section.capitalize()} of street {street}"


def smooth_line(points: list[tuple[float, float]], bend_m: float, rng: np.random.Generator) -> Line:
    """Return a gently bent polyline (n, 2) near the given points, metres, with about 3 m between its points.

    It contains the first and the last point exactly.

    Args:
        points: positions, map frame, metres.
        bend_m: standard deviation of the bend in the middle, metres.
        rng: random generator.
    """
    corners = np.array(points, float)
    length = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    steps = max(8, int(length[-1] / 3.0))
    at = np.linspace(0, length[-1], steps + 1)
    line = np.stack([np.interp(at, length, corners[:, k]) for k in (0, 1)], axis=1)
    share = at / length[-1]
    bend = rng.normal(0, bend_m) * np.sin(np.pi * share) + rng.normal(0, 0.4 * bend_m) * np.sin(2 * np.pi * share)
    direction = line[-1] - line[0]
    direction = direction / np.linalg.norm(direction)
    bent: Line = line + bend[:, None] * np.array([-direction[1], direction[0]])
    return bent


def paper_streets(rng: np.random.Generator) -> list[Street]:
    """Return nine streets and the ways between them on about 300 m x 400 m, similar to the paper's Figure 8.

    Args:
        rng: random generator.
    """

    def line(*points: tuple[float, float]) -> Line:
        return smooth_line(list(points), 2.5, rng)

    return [
        Street("1", (line((-122, -172), (-118, 0), (-124, 172)),), 4.5, True),
        Street("2", (line((-38, -172), (-42, 10), (-36, 172)),), 4.2, True),
        Street("3", (line((44, -168), (47, -84)),), 3.6, False),
        Street("4", (line((121, -172), (117, 0), (123, 172)),), 4.8, True),
        Street("5", (line((-122, -172), (0, -164), (121, -172)),), 4.6, True),
        Street("6", (line((-119, -62), (-41, -58)),), 3.5, False),
        Street("7", (line((-121, 62), (-40, 70), (119, 60)),), 4.2, True),
        Street("8", (line((-41, -86), (47, -84), (118, -76)),), 3.8, False),
        Street("9", (line((-124, 172), (0, 165), (123, 172)),), 4.4, True),
        Street("between", (line((-41, -14), (118, -8)), line((42, 65), (46, 167))), 3.4, False),
    ]


def random_streets(rng: np.random.Generator, size_m: tuple[float, float]) -> list[Street]:
    """Return a bent grid of streets with gaps and one diagonal.

    Args:
        rng: random generator.
        size_m: approximate extent in x and y, metres.
    """
    counts = [max(2, round(size / 88.0) + 1) for size in size_m]
    grids = []
    for count, size in zip(counts, size_m, strict=True):
        steps = rng.uniform(65, 110, count - 1)
        positions = np.r_[0.0, np.cumsum(steps * size / steps.sum())] if count > 2 else np.array([0.0, size])
        grids.append(positions - positions.mean())
    nx, ny = counts
    nodes = np.stack(np.meshgrid(*grids, indexing="ij"), axis=-1) + rng.uniform(-12, 12, (nx, ny, 2))
    streets: list[Street] = []

    def add(points: list[NDArray[np.float64]]) -> None:
        corners = [(float(p[0]), float(p[1])) for p in points]
        line = smooth_line(corners, 2.5, rng)
        long = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) > 150.0
        streets.append(Street(str(len(streets) + 1), (line,), rng.uniform(3.2, 5.2), long))

    for along, across in ((0, 1), (1, 0)):
        for k in range(counts[across]):
            run: list[NDArray[np.float64]] = []
            for i in range(counts[along]):
                node = nodes[i, k] if along == 0 else nodes[k, i]
                run.append(node)
                if i + 1 < counts[along] and rng.random() < 0.12:  # the street is missing along this block
                    if len(run) > 1:
                        add(run)
                    run = []
            if len(run) > 1:
                add(run)
    i, j = int(rng.integers(nx - 1)), int(rng.integers(ny - 1))
    add([nodes[i, j], nodes[i + 1, j + 1]])
    return streets


def streets_geojson(streets: list[Street]) -> dict[str, Any]:
    """Return the polygons of all classes as GeoJSON, map frame, metres.

    Where two classes overlap, the first one keeps the area. So no point belongs to two classes.

    Args:
        streets: the street network.
    """
    features = []
    taken: shapely.Geometry = shapely.Polygon()
    index = 0
    for street in streets:
        polygons: list[shapely.Geometry] = []
        for section, lines in street.classes():
            corridor = shapely.union_all(
                [shapely.LineString(line).buffer(street.half_width_m + PAVEMENT_M, cap_style="flat") for line in lines]
            )
            own = _areas(shapely.difference(corridor, shapely.union_all([taken, *polygons]), grid_size=GRID_M))
            polygons.append(own)
            features.append(
                {
                    "type": "Feature",
                    "properties": {
                        "id": f"{street.street}-{section}" if section else street.street,
                        "street": street.street,
                        "section": section,
                        "name": class_name(street.street, section),
                        "class_index": index,
                    },
                    "geometry": _geometry(own),
                }
            )
            index += 1
        taken = _areas(shapely.union_all([taken, *polygons], grid_size=GRID_M))
    return {"type": "FeatureCollection", "features": features}


def _areas(shape: shapely.Geometry) -> shapely.Geometry:
    """Return only the polygons of a shape.

    On the grid, slivers collapse to lines. GEOS refuses a collection with lines as an operand.
    """
    if isinstance(shape, shapely.Polygon | shapely.MultiPolygon):
        return shape
    parts = shapely.get_parts(shapely.get_parts(shape))  # a collection may contain multi-polygons
    return shapely.MultiPolygon([part for part in parts if isinstance(part, shapely.Polygon)])


def _geometry(shape: shapely.Geometry) -> dict[str, Any]:
    """Return the GeoJSON geometry without slivers below 1 m2. The points lie on the grid, so rounding only shortens the digits."""
    parts = [p for p in shapely.get_parts(shape) if isinstance(p, shapely.Polygon) and p.area > 1.0]
    polygons = [
        [[[round(x, 2), round(y, 2)] for x, y in ring.coords] for ring in (p.exterior, *p.interiors)] for p in parts
    ]
    if len(polygons) == 1:
        return {"type": "Polygon", "coordinates": polygons[0]}
    return {"type": "MultiPolygon", "coordinates": polygons}
