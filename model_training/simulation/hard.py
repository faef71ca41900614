"""Hard conditions of a query drive, each by its name in the reports; the survey's own are other datasets or other maps."""

from model_training.simulation.plan import QueryPlan

WEATHER_AND_LIGHT = ("rain", "snow", "fog", "night", "low_sun")

#: What differs from a clear day's drive; everything else is a ``QueryPlan``'s default.
_CHANGES: dict[str, dict[str, float]] = {
    "cars_changed": {"parked_changed": 1.0},
    "heading_30": {"turn_deg": 30.0},
    "pitch_3": {"pitch_deg": 3.0},
    "sideways": {"turn_deg": 90.0},
    "blocked_25": {"blocked": 0.25},
    "blocked_50": {"blocked": 0.5},
    "depth_15m": {"max_depth_m": 15.0},
}

HARD = (*WEATHER_AND_LIGHT, *_CHANGES)


def hard_query(name: str, *, traversal: int, count: int, depths: tuple[str, ...] = ("precise",)) -> QueryPlan:
    """The drive of one hard condition.

    Args:
        name: one of ``HARD``.
        traversal: its vehicles and poses; another number, another drive.
        count: of queries.
        depths: presets.
    """
    changed = {"condition": name} if name in WEATHER_AND_LIGHT else _CHANGES[name]
    plan = {"name": name, "traversal": traversal, "count": count, "depths": depths}
    return QueryPlan.model_validate(plan | changed)
