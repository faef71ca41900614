"""How parts of a city are built."""

from dataclasses import dataclass


@dataclass(frozen=True)
class District:
    """How a part of the city is built, metres and shares; (low, high) are uniform ranges.

    Attributes:
        name: of the kind.
        width: of a house along the street.
        depth: of a house across the street.
        height: of a house.
        setback: from the pavement.
        gap: between houses that do not touch.
        joined: share of houses that touch their neighbour.
        tree_step: along the pavement.
        tree_share: of those places that have a tree.
        parked: share of parking slots that are taken.
        people: people per 100 m of pavement.
        roofs: kinds, each as likely as the others.
        wild: share of places behind the houses that have a tree or a bush.
        boundaries: kinds of what stands between garden and pavement, each as likely as the others.
        built: share of the lots that have a house; the others are car parks.
    """

    name: str
    width: tuple[float, float]
    depth: tuple[float, float]
    height: tuple[float, float]
    setback: tuple[float, float]
    gap: tuple[float, float]
    joined: float
    tree_step: float
    tree_share: float
    parked: float
    people: float
    roofs: tuple[str, ...]
    wild: float
    boundaries: tuple[str, ...] = ("fence", "hedge", "wall")
    built: float = 1.0


DISTRICTS = (
    District(
        "downtown", (9, 26), (9, 16), (9, 26), (0, 2.0), (1, 8), 0.75, 16.0, 0.5, 0.6, 2.5, ("flat", "flat", "flat", "hip"), wild=0.03
    ),
    District(
        "residential", (7, 15), (7, 12), (3.2, 8), (2, 8), (2, 12), 0.15, 15.0, 0.5, 0.35, 0.8, ("gable", "gable", "hip", "flat"), wild=0.18
    ),
    District("wooded", (6, 13), (6, 10), (3, 6.5), (4, 14), (12, 35), 0.0, 7.0, 0.8, 0.12, 0.3, ("gable", "gable", "hip"), wild=0.8),
    # An old town: narrow houses wall to wall, no gardens, hardly a tree.
    District(
        "old town", (4.5, 10), (8, 14), (8, 15), (0, 0.5), (0.5, 3), 0.93, 30.0, 0.15, 0.3, 4.0, ("gable", "gable", "hip"), wild=0.02
    ),
    # A suburb: low houses behind hedges, bushes and trees in the gardens, cars along the street.
    District(
        "suburb", (8, 14), (8, 12), (3, 7), (5, 12), (4, 14), 0.08, 12.0, 0.55, 0.45, 0.5, ("gable", "hip"), wild=0.45,
        boundaries=("hedge", "hedge", "hedge", "fence"),
    ),
    # An arterial road: few walls, far away, and rows of trees.
    District(
        "arterial", (12, 40), (12, 25), (6, 18), (12, 30), (20, 60), 0.0, 8.0, 0.9, 0.05, 0.3, ("flat", "flat", "hip"), wild=0.25,
        boundaries=("hedge", "fence"),
    ),
    # An industrial area: long, plain halls behind fences.
    District(
        "industrial", (25, 70), (20, 45), (6, 12), (8, 22), (8, 30), 0.0, 25.0, 0.15, 0.3, 0.2, ("flat",), wild=0.03,
        boundaries=("fence", "fence", "wall"),
    ),
    # Car parks, and a shop here and there.
    District(
        "car park", (25, 50), (12, 25), (4, 8), (3, 10), (3, 10), 0.0, 18.0, 0.3, 0.65, 1.0, ("flat",), wild=0.05,
        boundaries=("hedge", "fence"), built=0.25,
    ),
)  # fmt: skip
DOWNTOWN, RESIDENTIAL, WOODED = 0, 1, 2
#: Shares of a mixed city's districts, in their order.
MIXED_SHARES = (0.14, 0.14, 0.1, 0.12, 0.18, 0.12, 0.1, 0.1)
