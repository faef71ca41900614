"""What a map of a country would need: rows of the reports times assumptions (``docs/scale.md``)."""

import math
from collections.abc import Callable

from service.maps.content import PLACE

#: Assumptions: streets, and places and views for each metre of them.
STREETS_KM, PLACES_PER_M, VIEWS_PER_PLACE = 1_000_000, 1, 24
#: Sums of voxels, kB for each metre (decision 0199).
SUMS_KB_PER_M = 27.9
#: Assumed processor time to build the map, core hours for each km.
BUILD_CORE_HOURS_PER_KM = 0.1
#: Assumptions: robots, and seconds between two queries of a robot with a prior, and without one.
ROBOTS, PRIOR_EVERY_S, NO_PRIOR_EVERY_S = 100_000, 10.0, 3600.0
#: Assumptions: used share of the processors, cores of a replica, and replicas that have each tile.
USE, CORES_PER_REPLICA, COPIES = 0.6, 8, 2
#: Assumed prices of November 2026, USD: a core for an hour and for a month of 730 hours, and a GB for a month.
CORE_HOUR_USD, CORE_MONTH_USD, STORE_GB_USD, DISK_GB_USD = 0.05, 36.50, 0.023, 0.08
#: Views of the largest search index that was measured: a hundred towns. The reports name its rows by this number.
INDEX_VIEWS = 48_900_000
#: Views of a map beyond those that were measured, and bytes of a descriptor.
MORE_VIEWS, DESCRIPTOR_BYTES = 10**8, 256
_INDEX = f"search.views_{INDEX_VIEWS}.index"

#: Returns a row of a report, by the names of both.
Row = Callable[[str, str], float]


def country_figures(row: Row) -> dict[str, float]:
    """Return all computed figures by their names.

    Args:
        row: gives rows of the reports.

    Raises:
        ValueError: a report lacks a row.
    """
    metres = STREETS_KM * 1000
    views = metres * PLACES_PER_M * VIEWS_PER_PLACE
    index_bytes, index_s = row("scale", f"{_INDEX}_bytes_per_view"), row("scale", f"{_INDEX}_build_s")
    index_ms = row("scale", f"{_INDEX}_ms")
    served_tb, sums_tb = metres * row("scale", "town.kb_per_metre") / 1e9, metres * SUMS_KB_PER_M / 1e9
    index_tb = views * index_bytes / 1e12
    regions = views / INDEX_VIEWS
    build_hours = STREETS_KM * BUILD_CORE_HOURS_PER_KM
    cores = _three_digits(ROBOTS / PRIOR_EVERY_S / row("serving", "full.answers_per_s") / USE)
    replicas = math.ceil(cores / CORES_PER_REPLICA)
    disk_tb = COPIES * (served_tb + index_tb)
    store_tb = served_tb + sums_tb + index_tb
    usd = {
        "processors": cores * CORE_MONTH_USD,
        "disks": disk_tb * 1e3 * DISK_GB_USD,
        "store": store_tb * 1e3 * STORE_GB_USD,
    }
    return {
        "served_tb": served_tb,
        "sums_tb": sums_tb,
        "index_tb": index_tb,
        "build_core_hours": build_hours,
        "build_days_of_100_cores": build_hours / 100 / 24,
        "build_usd": build_hours * CORE_HOUR_USD,
        "regions": regions,
        "index_core_hours": _three_digits(regions * index_s * 2 / 3600),
        "cores": cores,
        "replicas": replicas,
        "disk_tb": disk_tb,
        "disk_tb_per_replica": disk_tb / replicas,
        "disk_gb": _three_digits(disk_tb * 1e3),
        "store_gb": _three_digits(store_tb * 1e3),
        "usd_processors": _three_digits(usd["processors"]),
        "usd_disks": _three_digits(usd["disks"]),
        "usd_store": _three_digits(usd["store"]),
        "usd": _three_digits(sum(usd.values())),
        "usd_per_robot": sum(usd.values()) / ROBOTS,
        "whole_search_s": regions * index_ms / 1e3,
        "whole_searches_per_s": ROBOTS / NO_PRIOR_EVERY_S,
        "whole_search_cores": _three_digits(ROBOTS / NO_PRIOR_EVERY_S * regions * index_ms / 1e3),
        "places_file_gb": metres * PLACES_PER_M * PLACE.itemsize / 1e9,
        "place_bytes": PLACE.itemsize,
        "descriptors_gb_of_1000_km": 1e6 * PLACES_PER_M * VIEWS_PER_PLACE * DESCRIPTOR_BYTES / 1e9,
        "more_views_gb": MORE_VIEWS * index_bytes / 1e9,
        "more_views_minutes": MORE_VIEWS / INDEX_VIEWS * index_s / 60,
    }


def _three_digits(value: float) -> float:
    """Return a number with three significant digits."""
    return float(f"{value:.3g}")
