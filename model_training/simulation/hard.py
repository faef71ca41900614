"""Hard conditions of a query traversal by their names in the reports. Hard conditions of the survey need another dataset or map."""

from model_training.simulation.plan import QueryPlan

#: Conditions of weather and light; see ``conditions.CONDITIONS``.
WEATHER_AND_LIGHT = ("rain", "snow", "fog", "night", "low_sun")

#: Differences from a traversal on a clear day. All other settings are the defaults of ``QueryPlan``.
_CHANGES: dict[str, dict[str, float]] = {
    "cars_changed": {"parked_changed": 1.0},
    "heading_30": {"turn_deg": 30.0},
    "pitch_3": {"pitch_deg": 3.0},
    "sideways": {"turn_deg": 90.0},
    "blocked_25": {"blocked": 0.25},
    "blocked_50": {"blocked": 0.5},
    "depth_15m": {"max_depth_m": 15.0},
}

#: Names of all hard conditions.
HARD = (*WEATHER_AND_LIGHT, *_CHANGES)


def hard_query(name: str, *, traversal: int, count: int, depths: tuple[str, ...] = ("precise",)) -> QueryPlan:
    """Return the query traversal of one hard condition.

    Args:
        name: one of ``HARD``.
        traversal: number that selects vehicles and poses; another number gives another traversal.
        count: number of queries.
        depths: depth presets.

    Raises:
        KeyError: the name is not one of ``HARD``.
    """
    changed = {"condition": name} if name in WEATHER_AND_LIGHT else _CHANGES[name]
    plan = {"name": name, "traversal": traversal, "count": count, "depths": depths}
    return QueryPlan.model_validate(plan | changed)
