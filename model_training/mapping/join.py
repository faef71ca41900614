"""Two maps of one frame become one: what must be the same, and how the rest adds up."""

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from model_training.mapping.places import streets_of, views_of
from service.errors import BundleError
from service.maps.content import BundleContent

#: Parameters that two drives of one map may differ in.
_OF_A_DRIVE = (
    "lidar_height_m",
    "survey_scans",
    "passes_vote",
    "traffic_vote",
    "survey_aligned",
    "expected_lidar_height_m",
)
#: Those of them that are said of a map where they hold of all of its drives.
_OF_ALL = ("passes_vote", "traffic_vote", "survey_aligned")


def require_same(a: BundleContent, b: BundleContent, *, names: tuple[str, str]) -> None:
    """Refuse maps that cannot become one.

    Raises:
        BundleError: another encoder, georeference or parameter; it is named with both values.
    """
    first, second = _comparable(a), _comparable(b)
    for what in sorted(first.keys() | second.keys()):
        if first.get(what) != second.get(what):
            raise BundleError(
                f"{what}: {names[0]} has {first.get(what)!r}, {names[1]} has {second.get(what)!r}; "
                f"build one of them again to the other's {what}", field=what,
            )  # fmt: skip
    if not np.array_equal(a.rows_seen, b.rows_seen):
        count = int((a.rows_seen != b.rows_seen).sum())
        raise BundleError(
            f"rows_seen: {names[0]} and {names[1]} differ in {count} of {len(a.rows_seen)} rows of the view grid: their LiDARs look up "
            "and down differently; give the second survey's dataset to `streetfix map update` instead", field="rows_seen",
        )  # fmt: skip


def _comparable(content: BundleContent) -> dict[str, Any]:
    parameters = {f"parameters.{k}": v for k, v in content.parameters.items() if k not in _OF_A_DRIVE}
    grid = {f"grid.{k}": v for k, v in asdict(content.grid).items()}
    georeference = None if content.georeference is None else dict(content.georeference)
    return parameters | grid | {
        "encoder": sha256(content.encoder).hexdigest()[:16], "georeference": georeference, "headings": content.headings,
        "spacing_m": content.spacing_m,
    }  # fmt: skip


def joined(a: BundleContent, b: BundleContent, *, newer_streets: bool = False) -> BundleContent:
    """The places of ``a``, then those of ``b`` that stand the spacing or more away from all of ``a``; without a cloud.

    The spacing is less a tenth for noisy poses, as it is along a drive. Nominal LiDAR heights are averaged over the places; the
    ground under each place stays where it was. The calibration's site check is the sum of both, with the lower, more careful
    correction.

    Args:
        a: a map; it may have no place left.
        b: another that ``require_same`` lets pass.
        newer_streets: where both have a street of the same id, take that of ``b``; else they must be the same.

    Raises:
        BundleError: streets or calibrations contradict each other.
    """
    new = standing_apart(b.T_map_place, a.T_map_place, a.spacing_m)
    fresh = of_places(b, new)
    counts = len(a.T_map_place), len(fresh.T_map_place)
    heights = a.parameters["lidar_height_m"], b.parameters["lidar_height_m"]
    height_m = float(np.average(heights, weights=counts)) if sum(counts) else heights[0]
    T_map_place = np.concatenate([
        _at_height(a.T_map_place, height_m - heights[0]), _at_height(fresh.T_map_place, height_m - heights[1])
    ])  # fmt: skip
    streets = joined_streets(a.streets, b.streets, newer=newer_streets)
    scans = a.parameters.get("survey_scans", 0.0) + b.parameters.get("survey_scans", 0.0)
    parameters = {**a.parameters, "lidar_height_m": height_m, "survey_scans": scans}
    for name in _OF_ALL:
        if name not in b.parameters:
            parameters.pop(name, None)
    return replace(
        a, T_map_place=T_map_place, place_street=streets_of(streets, T_map_place), streets=streets, parameters=parameters,
        view_place=views_of(len(T_map_place), a.headings), descriptors=np.concatenate([a.descriptors, fresh.descriptors]),
        view_heading_rad=np.concatenate([a.view_heading_rad, fresh.view_heading_rad]), cloud=None, statistics=None, preview_webp=b"",
        calibration=joined_calibration(a.calibration, b.calibration),
        licence="\n".join(dict.fromkeys(text for text in (a.licence, b.licence) if text)),
    )  # fmt: skip


def standing_apart(
    T_map_place: NDArray[np.float64], others: NDArray[np.float64], spacing_m: float
) -> NDArray[np.bool_]:
    """Which places (P, 4, 4) are no closer to any of the others (Q, 4, 4) than the spacing, less a tenth."""
    if not len(others) or not len(T_map_place):
        return np.ones(len(T_map_place), np.bool_)
    distance = cKDTree(others[:, :3, 3]).query(T_map_place[:, :3, 3])[0]
    return np.asarray(distance >= 0.9 * spacing_m)


def of_places(content: BundleContent, keep: NDArray[np.bool_]) -> BundleContent:
    """The map with these of its places and their views."""
    views = keep[content.view_place]
    return replace(
        content, T_map_place=content.T_map_place[keep], place_street=content.place_street[keep],
        view_place=views_of(int(keep.sum()), content.headings), view_heading_rad=content.view_heading_rad[views],
        descriptors=content.descriptors[views],
    )  # fmt: skip


def _at_height(T_map_place: NDArray[np.float64], up_m: float) -> NDArray[np.float64]:
    moved = T_map_place.copy()
    moved[:, 2, 3] += up_m
    return moved


def joined_streets(
    a: Mapping[str, Any] | None, b: Mapping[str, Any] | None, *, newer: bool = False
) -> dict[str, Any] | None:
    """All features of two collections, those of ``a`` first, one of each id.

    Raises:
        BundleError: a street of both is not the same in both, and ``newer`` does not say that that of ``b`` holds.
    """
    if a is None or b is None:
        only = b if a is None else a
        return None if only is None else dict(only)
    features = {feature["properties"]["id"]: feature for feature in a["features"]}
    for feature in b["features"]:
        name = feature["properties"]["id"]
        if not newer and name in features and features[name] != feature:
            raise BundleError(
                f"streets: both have a street {name!r}, but not the same; give one of them another id, or the same streets.geojson",
                field="streets.geojson",
            )  # fmt: skip
        features[name] = feature
    return {**a, "features": list(features.values())}


def joined_calibration(a: Mapping[str, Any], b: Mapping[str, Any]) -> dict[str, Any]:
    """The calibration of both; none where one has none.

    Raises:
        BundleError: they are not the same but for the check of their sites.
    """
    if not a["calibrated"] or not b["calibrated"]:
        return dict(b if a["calibrated"] else a)
    if json.dumps({**a, "site": None}, sort_keys=True) != json.dumps({**b, "site": None}, sort_keys=True):
        raise BundleError(
            "calibration: the maps have different ones; build one of them again with the other's --calibration", field="calibration"
        )  # fmt: skip
    sites = [site for site in (a.get("site"), b.get("site")) if site is not None]
    if len(sites) < 2:
        return {**a, "site": sites[0] if sites else None}
    queries = sum(site["queries"] for site in sites)
    error = sum(site["expected_calibration_error"] * site["queries"] for site in sites) / max(1, queries)
    return {**a, "site": {
        "offset": min(site["offset"] for site in sites), "queries": queries, "right": sum(site["right"] for site in sites),
        "expected_calibration_error": error,
    }}  # fmt: skip
