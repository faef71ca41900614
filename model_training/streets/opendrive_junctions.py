"""What an OpenDRIVE map calls its junctions: by their own names, by the streets that meet, or by number."""

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import shapely
from shapely.geometry.base import BaseGeometry

from model_training.streets.lanes import GRID_M
from model_training.streets.named_street import NamedStreet, in_natural_order
from model_training.streets.opendrive_road import Road

#: Editors number their junctions; such a name says less than the streets that meet there.
_NUMBERED = re.compile(r"junction[\s_]*[0-9]*", re.IGNORECASE)


def junction_streets(
    roads: Sequence[Road], junctions: Mapping[str, str], names: Mapping[str, str]
) -> tuple[dict[str, list[BaseGeometry]], list[NamedStreet]]:
    """The ground of all roads that lead through junctions.

    Args:
        roads: of the file.
        junctions: their names by id, as the file has them.
        names: of the roads outside of junctions, by id; only those that the file names.

    Returns:
        By street, the ground of junctions where no other named street meets it, which are a part of it; and the other
        junctions, each a street of its own.
    """
    surfaces: dict[str, list[BaseGeometry]] = defaultdict(list)
    meeting: dict[str, set[str]] = defaultdict(set)
    for road in roads:
        if road.junction is not None and not road.surface.is_empty:
            surfaces[road.junction].append(road.surface)
            meeting[road.junction] |= set(road.linked)
    through: dict[str, list[BaseGeometry]] = defaultdict(list)
    streets = []
    uses: Counter[str] = Counter()
    for identity in sorted(surfaces, key=in_natural_order):
        own = junctions.get(identity, "")
        met = sorted({names[road] for road in meeting[identity] if road in names}, key=in_natural_order)
        # What its lanes lead around, between kerbs or on an island, belongs to a junction as well.
        parts = shapely.get_parts(shapely.union_all(surfaces[identity], grid_size=GRID_M))
        ground = shapely.union_all(
            [shapely.Polygon(part.exterior) for part in parts if isinstance(part, shapely.Polygon)]
        )
        if own and not _NUMBERED.fullmatch(own):
            name = own
        elif len(met) == 1 and all(road in names for road in meeting[identity]):
            through[met[0]].append(ground)
            continue
        else:
            name = " / ".join(met) if len(met) > 1 else f"Junction {identity}"
        uses[name] += 1  # two streets may meet twice
        if uses[name] > 1:
            name = f"{name} ({uses[name]})"
        streets.append(NamedStreet(street=name, name=name, surface=ground, divisible=False))
    return dict(through), streets
