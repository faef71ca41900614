"""Kinds of city districts and how they are built."""

from dataclasses import dataclass


@dataclass(frozen=True)
class District:
    """How a part of the city is built. Lengths in metres; (low, high) are uniform ranges.

    Attributes:
        name: name of the kind.
        width: size of a house along the street.
        depth: size of a house across the street.
        height: height of a house.
        setback: distance of a house from the pavement.
        gap: distance between detached houses.
        joined: share of houses that touch their neighbour.
        tree_step: distance between places for trees along the pavement.
        tree_share: share of these places that have a tree.
        parked: share of parking slots that are occupied.
        people: people per 100 m of pavement.
        roofs: kinds of roofs, all equally likely.
        wild: share of places behind the houses that have a tree or a bush.
        boundaries: kinds of boundaries between garden and pavement, all equally likely.
        built: share of the lots that have a house. The others are car parks.
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


#: All kinds of districts.
DISTRICTS = (
    District(
        "downtown", (9, 26), (9, 16), (9, 26), (0, 2.0), (1, 8), 0.75, 16.0, 0.5, 0.6, 2.5, ("flat", "flat", "flat", "hip"), wild=0.03
    ),
    District(
        "residential", (7, 15), (7, 12), (3.2, 8), (2, 8), (2, 12), 0.15, 15.0, 0.5, 0.35, 0.8, ("gable", "gable", "hip", "flat"), wild=0.18
    ),
    District("wooded", (6, 13), (6, 10), (3, 6.5), (4, 14), (12, 35), 0.0, 7.0, 0.8, 0.12, 0.3, ("gable", "gable", "hip"), wild=0.8),
    # An old town: narrow houses wall to wall, no gardens, few trees.
    District(
        "old town", (4.5, 10), (8, 14), (8, 15), (0, 0.5), (0.5, 3), 0.93, 30.0, 0.15, 0.3, 4.0, ("gable", "gable", "hip"), wild=0.02
    ),
    # A suburb: low houses behind hedges, bushes and trees in the gardens, cars along the street.
    District(
        "suburb", (8, 14), (8, 12), (3, 7), (5, 12), (4, 14), 0.08, 12.0, 0.55, 0.45, 0.5, ("gable", "hip"), wild=0.45,
        boundaries=("hedge", "hedge", "hedge", "fence"),
    ),
    # An arterial road: few and distant walls, rows of trees.
    District(
        "arterial", (12, 40), (12, 25), (6, 18), (12, 30), (20, 60), 0.0, 8.0, 0.9, 0.05, 0.3, ("flat", "flat", "hip"), wild=0.25,
        boundaries=("hedge", "fence"),
    ),
    # An industrial area: long, plain halls behind fences.
    District(
        "industrial", (25, 70), (20, 45), (6, 12), (8, 22), (8, 30), 0.0, 25.0, 0.15, 0.3, 0.2, ("flat",), wild=0.03,
        boundaries=("fence", "fence", "wall"),
    ),
    # Car parks and a few shops.
    District(
        "car park", (25, 50), (12, 25), (4, 8), (3, 10), (3, 10), 0.0, 18.0, 0.3, 0.65, 1.0, ("flat",), wild=0.05,
        boundaries=("hedge", "fence"), built=0.25,
    ),
)  # fmt: skip
#: Indices in ``DISTRICTS``.
DOWNTOWN, RESIDENTIAL, WOODED = 0, 1, 2
#: Shares of the districts in a mixed city, in the order of ``DISTRICTS``.
MIXED_SHARES = (0.14, 0.14, 0.1, 0.12, 0.18, 0.12, 0.1, 0.1)
