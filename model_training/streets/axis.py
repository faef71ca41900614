"""The axis of a street: one line from its beginning to its end, along which we cut it."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree, shortest_path
from shapely.geometry.base import BaseGeometry

#: Carriageways of one street are rarely further apart, metres.
_PARALLEL_M = 25.0
#: Share of a line that lies beside longer lines. From this share on the line counts as parallel and is dropped.
_PARALLEL_SHARE = 0.8


def axis_of(surface: BaseGeometry, lines: Sequence[shapely.LineString]) -> shapely.LineString:
    """Return the line along which a street's length is measured.

    With centre lines: the longest way along them. Gaps (junctions) are bridged where they are narrowest. The axis has the
    direction of the first line. Of two carriageways only one counts. A branch belongs to where it leaves the axis.
    With a polygon only: the long axis of the smallest rectangle around it, from west to east, or from south to north if it
    runs exactly north.

    Args:
        surface: ground of the street, map frame, metres.
        lines: its centre lines, map frame, metres; empty if unknown.
    """
    if not lines:
        return _of_rectangle(surface)
    merged = shapely.line_merge(shapely.union_all(_one_carriageway(lines)))
    pieces = [part for part in shapely.get_parts(merged) if part.length > 0]
    axis = pieces[0] if len(pieces) == 1 else _longest_way(pieces)
    first = lines[0]
    start, end = (axis.project(shapely.Point(first.coords[at])) for at in (0, -1))
    return axis.reverse() if start > end else axis


def _one_carriageway(lines: Sequence[shapely.LineString]) -> list[shapely.LineString]:
    """Drop lines that run beside longer ones. Otherwise the axis would lead along both, there and back."""
    kept: list[shapely.LineString] = []
    beside: BaseGeometry = shapely.Polygon()
    for line in sorted(lines, key=lambda each: -each.length):
        if not kept or line.intersection(beside).length < _PARALLEL_SHARE * line.length:
            kept.append(line)
            beside = beside.union(line.buffer(_PARALLEL_M, cap_style="flat"))
    return kept


def _of_rectangle(surface: BaseGeometry) -> shapely.LineString:
    box = surface.minimum_rotated_rectangle
    corners = shapely.get_coordinates(box)
    sides = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)
    ring = corners[:4] if sides[0] <= sides[1] else np.roll(corners[:4], -1, axis=0)
    ends = sorted(
        [tuple((ring[0] + ring[1]) / 2), tuple((ring[2] + ring[3]) / 2)], key=lambda p: (round(p[0], 6), p[1])
    )
    return shapely.LineString(ends)


def _longest_way(pieces: Sequence[shapely.LineString]) -> shapely.LineString:
    """The longest of the shortest paths between any two ends of the pieces."""
    ends = np.array([piece.coords[at][:2] for piece in pieces for at in (0, -1)])
    nodes, node_of_end = np.unique(np.round(ends, 3), axis=0, return_inverse=True)
    starts, stops = node_of_end.reshape(-1, 2).T
    lengths = np.array([piece.length for piece in pieces])
    shortest = np.lexsort((lengths,))[::-1]  # longest first: between the same nodes the shorter piece is kept
    piece_of: dict[tuple[int, int], shapely.LineString] = {}
    for number in shortest:
        a, b = int(starts[number]), int(stops[number])
        if a != b:
            piece_of[a, b], piece_of[b, a] = pieces[number], pieces[number].reverse()
    bridges = _bridges(nodes, list(piece_of))
    pairs = [*piece_of, *bridges, *((b, a) for a, b in bridges)]
    weights = [piece_of[pair].length if pair in piece_of else _apart(nodes, pair) for pair in pairs]
    if not pairs:  # rings only
        return max(pieces, key=lambda piece: piece.length)
    a, b = np.array(pairs).T
    graph = coo_array((np.maximum(weights, 1e-9), (a, b)), shape=(len(nodes), len(nodes))).tocsr()
    distance, before = shortest_path(graph, return_predecessors=True)
    source, target = np.unravel_index(int(np.argmax(np.where(np.isfinite(distance), distance, -1.0))), distance.shape)
    way = [int(target)]
    while way[-1] != source:
        way.append(int(before[source, way[-1]]))
    way.reverse()
    points = [tuple(nodes[way[0]])]
    for pair in pairwise(way):
        points += [point[:2] for point in piece_of[pair].coords[1:]] if pair in piece_of else [tuple(nodes[pair[1]])]
    return shapely.LineString(points)


def _bridges(nodes: NDArray[np.float64], joined: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Pairs of nodes that connect all pieces, with the least total length."""
    rows, columns = np.array(joined or np.empty((0, 2)), int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(nodes), len(nodes)))
    count, group = connected_components(graph, directed=False)
    if count == 1:
        return []
    apart = np.linalg.norm(nodes[:, None] - nodes[None], axis=2)
    order = np.argsort(group, kind="stable")
    first = np.searchsorted(group[order], np.arange(count))
    sorted_apart = apart[np.ix_(order, order)]
    between = np.minimum.reduceat(np.minimum.reduceat(sorted_apart, first, axis=0), first, axis=1)
    tree = minimum_spanning_tree(np.maximum(between, 1e-9) * (1 - np.eye(count))).tocoo()
    bridges = []
    for one, other in zip(tree.row, tree.col, strict=True):
        mine, its = np.flatnonzero(group == one), np.flatnonzero(group == other)
        a, b = np.unravel_index(int(np.argmin(apart[np.ix_(mine, its)])), (len(mine), len(its)))
        bridges.append((int(mine[a]), int(its[b])))
    return bridges


def _apart(nodes: NDArray[np.float64], pair: tuple[int, int]) -> float:
    return float(np.linalg.norm(nodes[pair[0]] - nodes[pair[1]]))
