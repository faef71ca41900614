"""Join two maps of one frame: check what must be equal, and combine the rest."""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from hashlib import sha256
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model_training.mapping.cloud import SURVEYED_HEIGHT
from model_training.mapping.places import streets_of, views_of
from service.errors import BundleError
from service.maps import inverted_file
from service.maps.content import BundleContent

#: Largest distance between two outlines of the same street, metres.
SAME_STREET_M = 0.1
#: Parameters that may differ between two traversals of one map.
_OF_A_DRIVE = (
    "lidar_height_m",
    "survey_scans",
    "between_m",
    "places_between",
    "passes_vote",
    "traffic_vote",
    "survey_aligned",
    "expected_lidar_height_m",
    "survey_position_std_m",
    "survey_angle_std_deg",
    SURVEYED_HEIGHT,  # measured again with the joined cloud
    inverted_file.RECALL,  # the writer measures it again
)
#: Standard deviations of which the joined map keeps the larger one.
_WORST = ("survey_position_std_m", "survey_angle_std_deg")
#: Flags that the joined map keeps only if both maps have them.
_OF_ALL = ("passes_vote", "traffic_vote", "survey_aligned")


def require_same(a: BundleContent, b: BundleContent, *, names: tuple[str, str]) -> None:
    """Refuse two maps that cannot be joined.

    Args:
        a: a map.
        b: another map.
        names: names of both maps for the error message.

    Raises:
        BundleError: an encoder, georeference, parameter, view grid or its seen rows differ. The message names the field and both values.
    """
    first, second = _comparable(a), _comparable(b)
    for what in sorted(first.keys() | second.keys()):
        if first.get(what) != second.get(what):
            raise BundleError(
                f"{what}: {names[0]} has {first.get(what)!r}, {names[1]} has {second.get(what)!r}; build "
                f"one of them again with the other's {what}",
                field=what,
            )
    if not np.array_equal(a.rows_seen, b.rows_seen):
        count = int((a.rows_seen != b.rows_seen).sum())
        raise BundleError(
            f"rows_seen: {names[0]} and {names[1]} differ in {count} of {len(a.rows_seen)} rows of "
            "the view grid: their LiDARs have different vertical fields of view; give the second "
            "survey's dataset to `streetfix map update` instead",
            field="rows_seen",
        )


def _comparable(content: BundleContent) -> dict[str, Any]:
    parameters = {f"parameters.{k}": v for k, v in content.parameters.items() if k not in _OF_A_DRIVE}
    grid = {f"grid.{k}": v for k, v in asdict(content.grid).items()}
    georeference = None if content.georeference is None else dict(content.georeference)
    return (
        parameters
        | grid
        | {
            "encoder": sha256(content.encoder).hexdigest()[:16],
            "georeference": georeference,
            "headings": content.headings,
            "spacing_m": content.spacing_m,
        }
    )


def joined(a: BundleContent, b: BundleContent, *, newer_streets: bool = False) -> BundleContent:
    """Join the places of ``a`` and the places of ``b`` that keep the spacing to all of ``a``; without a cloud.

    The spacing is reduced by a tenth because poses are noisy, as it is along a traversal. The nominal LiDAR height is the average over
    the places, and the ground under each place stays where it was. The site check of the calibration is the sum of both checks, with
    the lower, more careful offset.

    Args:
        a: a map. It may have no place left.
        b: another map that ``require_same`` accepts.
        newer_streets: take the street of ``b`` if both have a street of the same id. Otherwise these streets must be equal.

    Raises:
        BundleError: streets or calibrations contradict each other.
    """
    new = standing_apart(b.T_map_place, a.T_map_place, a.spacing_m)
    fresh = of_places(b, new)
    counts = len(a.T_map_place), len(fresh.T_map_place)
    heights = a.parameters["lidar_height_m"], b.parameters["lidar_height_m"]
    height_m = float(np.average(heights, weights=counts)) if sum(counts) else heights[0]
    T_map_place = np.concatenate(
        [_at_height(a.T_map_place, height_m - heights[0]), _at_height(fresh.T_map_place, height_m - heights[1])]
    )
    streets = joined_streets(a.streets, b.streets, newer=newer_streets)
    counted = {
        name: a.parameters.get(name, 0.0) + b.parameters.get(name, 0.0) for name in ("survey_scans", "places_between")
    }
    parameters = {**a.parameters, "lidar_height_m": height_m, **counted}
    for name in _WORST:
        stated = [of.parameters[name] for of in (a, b) if name in of.parameters]
        parameters |= {name: max(stated)} if stated else {}
    for name in _OF_ALL:
        if name not in b.parameters:
            parameters.pop(name, None)
    return replace(
        a,
        T_map_place=T_map_place,
        place_street=streets_of(streets, T_map_place),
        streets=streets,
        parameters=parameters,
        view_place=views_of(len(T_map_place), a.headings),
        descriptors=np.concatenate([a.descriptors, fresh.descriptors]),
        view_heading_rad=np.concatenate([a.view_heading_rad, fresh.view_heading_rad]),
        cloud=None,
        statistics=None,
        preview_webp=b"",
        calibration=joined_calibration(a.calibration, b.calibration),
        licence="\n".join(dict.fromkeys(text for text in (a.licence, b.licence) if text)),
    )


def standing_apart(
    T_map_place: NDArray[np.float64], others: NDArray[np.float64], spacing_m: float
) -> NDArray[np.bool_]:
    """Return for each place (P,) whether it is at least 0.9 times the spacing away from all others.

    Args:
        T_map_place: poses of the places (P, 4, 4).
        others: poses of the other places (Q, 4, 4), same frame.
        spacing_m: distance between places, metres.
    """
    if not len(others) or not len(T_map_place):
        return np.ones(len(T_map_place), np.bool_)
    distance = cKDTree(others[:, :3, 3]).query(T_map_place[:, :3, 3])[0]
    return np.asarray(distance >= 0.9 * spacing_m)


def of_places(content: BundleContent, keep: NDArray[np.bool_]) -> BundleContent:
    """Return the map with some of its places and their views.

    Args:
        content: the map.
        keep: True for the places to keep (P,).
    """
    views = keep[content.view_place]
    return replace(
        content,
        T_map_place=content.T_map_place[keep],
        place_street=content.place_street[keep],
        view_place=views_of(int(keep.sum()), content.headings),
        view_heading_rad=content.view_heading_rad[views],
        descriptors=content.descriptors[views],
    )


def _at_height(T_map_place: NDArray[np.float64], up_m: float) -> NDArray[np.float64]:
    moved = T_map_place.copy()
    moved[:, 2, 3] += up_m
    return moved


def joined_streets(
    a: Mapping[str, Any] | None, b: Mapping[str, Any] | None, *, newer: bool = False
) -> dict[str, Any] | None:
    """Join two GeoJSON collections of streets, those of ``a`` first, with one feature per id.

    Two features of one id are the same if their properties are equal and no point of an outline lies farther than ``SAME_STREET_M`` from
    the other outline: a survey that was moved into another frame has other roundings. Then that of ``a`` stays.

    Args:
        a: a FeatureCollection; None for no streets.
        b: another one.
        newer: take the feature of ``b`` if both have the same id.

    Raises:
        BundleError: both have different features of the same id, and ``newer`` is False.
    """
    if a is None or b is None:
        only = b if a is None else a
        return None if only is None else dict(only)
    features = {feature["properties"]["id"]: feature for feature in a["features"]}
    for feature in b["features"]:
        name = feature["properties"]["id"]
        known = None if newer else features.get(name)
        if known is not None and not _same_street(known, feature):
            raise BundleError(
                f"streets: both maps have a street {name!r}, but the two differ; give one of them another id, or the "
                "same streets.geojson",
                field="streets.geojson",
            )
        features[name] = known or feature
    return {**a, "features": list(features.values())}


def _same_street(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    if a == b or a["properties"] != b["properties"]:
        return a == b
    try:
        first, second = (shapely.boundary(shapely.geometry.shape(each["geometry"])) for each in (a, b))
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, shapely.errors.ShapelyError):
        return False  # one of them is no street, so they differ
    # A Hausdorff distance of shapely compares corners only, and two outlines may connect the same corners otherwise.
    return all(bool(one.buffer(SAME_STREET_M).covers(other)) for one, other in ((first, second), (second, first)))


def joined_calibration(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
    """Join two calibrations with their site checks; the result is uncalibrated if one of them is.

    A correction for a rig stays only if both have the same one. Any other was learned on one of the maps only.

    Args:
        a: content of ``calibration.json``.
        b: content of another one.

    Raises:
        BundleError: they differ in more than their site checks and corrections for a rig.
    """
    if not a["calibrated"] or not b["calibrated"]:
        return dict(b if a["calibrated"] else a)
    own = {"site": None, "rig": None, "rigs": None}
    if json.dumps({**a, **own}, sort_keys=True) != json.dumps({**b, **own}, sort_keys=True):
        raise BundleError(
            "calibration: the maps have different ones; build one of them again with the other's --calibration",
            field="calibration",
        )
    both = [each for each in a.get("rigs", ()) if each in b.get("rigs", ())]
    a = {name: value for name, value in a.items() if name != "rigs"} | ({"rigs": both} if both else {})
    a = {**a, "rig": a.get("rig") if a.get("rig") == b.get("rig") else None}
    sites = [site for site in (a.get("site"), b.get("site")) if site is not None]
    if len(sites) < 2:
        return {**a, "site": sites[0] if sites else None}
    queries = sum(site["queries"] for site in sites)
    error = sum(site["expected_calibration_error"] * site["queries"] for site in sites) / max(1, queries)
    return {
        **a,
        "site": {
            "offset": min(site["offset"] for site in sites),
            "queries": queries,
            "right": sum(site["right"] for site in sites),
            "expected_calibration_error": error,
        },
    }
