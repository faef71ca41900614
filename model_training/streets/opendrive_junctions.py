"""Name the junctions of an OpenDRIVE map: by their own names, by the streets that meet, or by number."""

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import shapely
from shapely.geometry.base import BaseGeometry

from model_training.streets.lanes import GRID_M
from model_training.streets.named_street import NamedStreet, in_natural_order
from model_training.streets.opendrive_road import Road

#: Names that an editor generated. The names of the streets that meet there are more useful.
_NUMBERED = re.compile(r"junction[\s_]*[0-9]*", re.IGNORECASE)


def junction_streets(
    roads: Sequence[Road], junctions: Mapping[str, str], names: Mapping[str, str]
) -> tuple[dict[str, list[BaseGeometry]], list[NamedStreet]]:
    """Collect the ground of all roads that lead through junctions.

    Args:
        roads: all roads of the file.
        junctions: names of the junctions by id, as in the file.
        names: names of the roads outside of junctions by id; only those that the file names.

    Returns:
        Ground of junctions that belong to one street, because only this street meets there, by its name; and the other
        junctions, each as a street of its own.
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
        # Ground that the lanes enclose, such as an island, belongs to the junction too.
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
        uses[name] += 1  # the same streets may meet at several junctions
        if uses[name] > 1:
            name = f"{name} ({uses[name]})"
        streets.append(NamedStreet(street=name, name=name, surface=ground, divisible=False))
    return dict(through), streets
