"""``streetfix map diff``: list the differences between two bundles of one frame."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model_training.mapping.stored_map import streets_of_bundle
from service.geometry.rigid import heading_of_body
from service.maps.reader import MapBundle

#: Edge of a square in which changed surfels are counted, metres.
AREA_M = 20.0
#: Smallest translation and smallest turn of a moved place.
_MOVED_M, _TURNED_RAD = 0.02, np.deg2rad(0.5)
#: Fields of the manifest that are compared besides the parameters and the view grid.
_SAME = ("headings", "spacing_m", "georeference", "licence")
_PAPER, _KEPT, _APPEARED, _VANISHED = (246, 249, 250), (170, 168, 165), (60, 150, 40), (50, 50, 215)  # BGR
_NEW_PLACE, _OLD_PLACE = (225, 120, 40), (30, 140, 240)


def diff_of(a: MapBundle, b: MapBundle) -> dict[str, Any]:
    """Return the changes from ``a`` to ``b`` as JSON values.

    Two places are the same if each is the nearest to the other and their distance is less than half the spacing. Such a place ``moved``
    if its position changed by 2 cm or its heading by half a degree, or more. A surfel ``appeared`` (``vanished``) if the other cloud
    has none within two voxels. ``areas`` are squares of 20 m, the most changed first.

    Args:
        a: the bundle before the change.
        b: the bundle after it, in the same frame.
    """
    places = _places(a, b)
    appeared, vanished = (
        _apart(_positions(b), _positions(a), _reach_m(a, b)),
        _apart(_positions(a), _positions(b), _reach_m(a, b)),
    )
    return {
        "versions": [a.manifest.version, b.manifest.version],
        "places": places,
        "cloud": {
            "appeared": len(appeared),
            "vanished": len(vanished),
            "kept": len(_positions(b)) - len(appeared),
            "areas": _areas(appeared, vanished),
        },
        "streets": _streets(a, b),
        "parameters": _parameters(a, b),
        "encoder_changed": a.manifest.encoder_sha256 != b.manifest.encoder_sha256,
    }


def _places(a: MapBundle, b: MapBundle) -> dict[str, Any]:
    old, new = a.T_map_place[:, :3, 3], b.T_map_place[:, :3, 3]
    distance, nearest = (np.asarray(found) for found in cKDTree(new).query(old))
    back = np.asarray(cKDTree(old).query(new)[1])
    # A map of every scan has spacing 0. There, places less than 0.1 m apart count as the same.
    reach = max(0.1, min(a.manifest.spacing_m, b.manifest.spacing_m) / 2)
    same = (back[nearest] == np.arange(len(old))) & (distance < reach)
    pairs = np.c_[np.flatnonzero(same), nearest[same]]
    turned = [
        abs((heading_of_body(b.T_map_place[j]) - heading_of_body(a.T_map_place[i]) + np.pi) % (2 * np.pi) - np.pi)
        for i, j in pairs
    ]
    moved = (distance[same] >= _MOVED_M) | (np.array(turned) >= _TURNED_RAD)
    return {
        "kept": len(pairs),
        "moved": int(moved.sum()),
        "largest_move_m": round(float(distance[same].max(initial=0.0)), 4),
        "added": np.setdiff1d(np.arange(len(new)), pairs[:, 1]).tolist(),
        "removed": np.setdiff1d(np.arange(len(old)), pairs[:, 0]).tolist(),
    }


def _positions(bundle: MapBundle) -> NDArray[np.float64]:
    if bundle.cloud is None:
        return np.zeros((0, 3))
    return np.asarray(bundle.cloud.unpacked(np.s_[:])["xyz"].astype(np.float64) + bundle.cloud.origin_m)


def _reach_m(a: MapBundle, b: MapBundle) -> float:
    return 2 * max(bundle.manifest.parameters.get("voxel_m", 0.3) for bundle in (a, b))


def _apart(points: NDArray[np.float64], others: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
    """Return the points that are farther than ``reach_m`` from all others."""
    if not len(points) or not len(others):
        return points
    return np.asarray(points[cKDTree(others).query(points, distance_upper_bound=reach_m)[0] == np.inf])


def _areas(appeared: NDArray[np.float64], vanished: NDArray[np.float64]) -> list[dict[str, float]]:
    points = np.concatenate([appeared, vanished])[:, :2]
    square, of = np.unique(np.floor(points / AREA_M).astype(np.int64), axis=0, return_inverse=True)
    of = of.ravel()
    new = np.bincount(of[: len(appeared)], minlength=len(square))
    gone = np.bincount(of[len(appeared) :], minlength=len(square))
    order = np.argsort(-(new + gone), kind="stable")
    return [
        {
            "x": float((square[k, 0] + 0.5) * AREA_M),
            "y": float((square[k, 1] + 0.5) * AREA_M),
            "appeared": int(new[k]),
            "vanished": int(gone[k]),
        }
        for k in order
    ]


def _streets(a: MapBundle, b: MapBundle) -> dict[str, list[str]]:
    old, new = (
        {
            feature["properties"]["id"]: feature
            for feature in (streets_of_bundle(bundle) or {"features": []})["features"]
        }
        for bundle in (a, b)
    )
    both = sorted(old.keys() & new.keys())
    return {
        "added": sorted(new.keys() - old.keys()),
        "removed": sorted(old.keys() - new.keys()),
        "changed": [name for name in both if old[name] != new[name]],
    }


def _parameters(a: MapBundle, b: MapBundle) -> dict[str, list[Any]]:
    """Return both values of each parameter that differs, by its name."""

    def parameters_of(bundle: MapBundle) -> dict[str, Any]:
        manifest: dict[str, Any] = bundle.manifest.model_dump(mode="json")
        grid = {f"grid.{name}": value for name, value in manifest["grid"].items()}
        same = {name: manifest[name] for name in _SAME}
        return {**manifest["parameters"], **grid, **same, "rows_seen": sum(manifest["rows_seen"])}

    old, new = parameters_of(a), parameters_of(b)
    return {
        name: [old.get(name), new.get(name)]
        for name in sorted(old.keys() | new.keys())
        if old.get(name) != new.get(name)
    }


def difference_png(a: MapBundle, b: MapBundle, *, longest_px: int = 1200) -> bytes:
    """Draw the changes from above, as a PNG image.

    Surfels are grey if they stayed, green if they appeared, red if they vanished. Removed places are orange, added places are blue.

    Args:
        a: the bundle before the change.
        b: the bundle after it, in the same frame.
        longest_px: length of the longer side of the image, pixels.
    """
    old, new, reach = _positions(a), _positions(b), _reach_m(a, b)
    track = [bundle.T_map_place[:, :2, 3] for bundle in (a, b)]
    everything = np.concatenate([old[:, :2], new[:, :2], *track])
    low, high = everything.min(axis=0) - 5, everything.max(axis=0) + 5
    metre = longest_px / float((high - low).max())
    width, height = (int(x) + 1 for x in (high - low) * metre)
    picture = np.full((height, width, 3), _PAPER, np.uint8)
    for points, colour in ((new, _KEPT), (_apart(new, old, reach), _APPEARED), (_apart(old, new, reach), _VANISHED)):
        pixel = ((points[:, :2] - low) * metre).astype(int)
        picture[height - 1 - pixel[:, 1], pixel[:, 0]] = colour
    places = _places(a, b)
    for xy, colour in ((track[0][places["removed"]], _OLD_PLACE), (track[1][places["added"]], _NEW_PLACE)):
        for x, y in ((xy - low) * metre).astype(int):
            cv2.circle(picture, (int(x), int(height - 1 - y)), max(2, round(0.5 * metre)), colour, -1, cv2.LINE_AA)
    return cv2.imencode(".png", picture)[1].tobytes()
