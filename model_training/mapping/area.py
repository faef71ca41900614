"""Select the part of a map that a new traversal replaces: the ground that it covered, or a polygon."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from service.errors import DatasetError

#: Returns for each of some positions (n, 2), metres, map frame, whether it lies inside the area (n,).
Area = Callable[[NDArray[np.float64]], NDArray[np.bool_]]

#: Edge of a cell of the ground plan, metres.
CELL_M = 2.0
#: Largest distance of a covered cell from the places of the traversal, metres. Farther away the points are too sparse.
COVERED_M = 25.0
#: Radius around a place that always counts as covered, metres. The vehicle hides the ground there.
_OWN_M = 4.0
#: Bits of a cell's number along each axis, in its key. Cells up to 1 million km from the origin have keys of their own.
_KEY_BITS = 30
#: Steps from a cell to itself and to its eight neighbours.
_AROUND = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)


def covered_by(points: NDArray[np.float64], places: NDArray[np.float64]) -> Area:
    """Return the area that a traversal covered: the cells of the ground plan with points.

    Gaps of one or two cells are filled. Ground without new points is not covered and stays in the map, for example behind a new wall or
    inside a block. Only covered cells take memory.

    Args:
        points: means of the traversal's voxels, metres, map frame, (n, 2) or (n, 3).
        places: positions of its places, metres, map frame, (P, 2) or (P, 3).
    """
    track = cKDTree(places[:, :2])
    near = points[track.query(points[:, :2], distance_upper_bound=COVERED_M)[0] < np.inf, :2]
    seen = np.concatenate([near, places[:, :2]])
    covered = _closed(np.unique(_keys(np.floor(seen / CELL_M).astype(np.int64))))

    def inside(xy: NDArray[np.float64]) -> NDArray[np.bool_]:
        own = track.query(xy[:, :2], distance_upper_bound=_OWN_M)[0] < np.inf
        return np.asarray(own | np.isin(_keys(np.floor(xy[:, :2] / CELL_M).astype(np.int64)), covered))

    return inside


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.asarray((cells[..., 0] << _KEY_BITS) + cells[..., 1])


def _closed(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Close a set of cells with a square of 3 x 3 cells (dilation, then erosion); return the keys, ascending.

    Args:
        keys: keys of the cells, ascending, each once (n,).
    """
    steps = _keys(_AROUND)
    dilated = np.unique(keys[:, None] + steps)
    return np.asarray(dilated[np.isin(dilated[:, None] + steps, dilated).all(axis=1)])


def polygon_of(path: Path) -> Area:
    """Read an area, rim included, from a GeoJSON file.

    Args:
        path: Polygon, MultiPolygon, or a Feature or FeatureCollection of them; coordinates in metres, map frame.

    Raises:
        DatasetError: the file is missing or holds no valid polygon.
    """
    try:
        document = json.loads(path.read_bytes())
    except OSError as error:
        raise DatasetError(f"{path} cannot be read ({error.strerror}); give a GeoJSON file", field="area") from error
    except (ValueError, RecursionError) as error:
        raise DatasetError(
            f"{path} is not valid JSON; give a GeoJSON file of a polygon in map metres", field="area"
        ) from error
    try:
        shapes = [shapely.geometry.shape(geometry) for geometry in _geometries(document)]
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, shapely.errors.ShapelyError) as error:
        raise DatasetError(
            f"{path}: not a valid geometry ({error}); give a polygon in map metres", field="area"
        ) from error
    if not shapes or any(shape.geom_type not in ("Polygon", "MultiPolygon") or shape.is_empty for shape in shapes):
        kinds = ", ".join(shape.geom_type for shape in shapes) or "nothing"
        raise DatasetError(f"{path} contains {kinds}, not a polygon; give one in map metres", field="area")
    if not all(shape.is_valid for shape in shapes):
        raise DatasetError(f"{path}: the polygon's boundary crosses itself; correct it", field="area")
    whole = shapely.union_all(shapes)
    shapely.prepare(whole)
    return lambda xy: np.asarray(shapely.intersects_xy(whole, xy[:, 0], xy[:, 1]))


def _geometries(document: Any) -> list[Any]:
    if document["type"] == "FeatureCollection":
        return [feature["geometry"] for feature in document["features"]]
    return [document["geometry"] if document["type"] == "Feature" else document]
