"""The cell of a request: a value that is the same for nearby positions. A load balancer sends the requests of a cell to one instance."""

import math
import uuid
from urllib.parse import quote

from service.contract import schema

#: Header of the cell.
HEADER = "X-Streetfix-Cell"
#: Edge of a cell, metres of the map frame and degrees on the Earth.
CELL_M, CELL_DEG = 1_000.0, 0.01


def cell_of(prior: schema.Prior | None, map_name: str | None, before: schema.LocalizeAnswer | None = None) -> str:
    """Return the cell of a request.

    An instance of the service needs only the tiles of the cells that it answers. The cell does not change an answer.

    Args:
        prior: prior of the camera pose. Its position counts first.
        map_name: name of the map; None if the request names none.
        before: answer to the query before of the same track; None without one. Its pose counts, or else the likeliest pose of its belief.
            Without any position the cell is random, so such requests spread over all instances.
    """
    place, last = uuid.uuid4().hex[:8], None if before is None else _position_of(before)
    if prior is not None and prior.wgs84 is not None:
        place = "earth-" + "-".join(
            str(math.floor(each / CELL_DEG)) for each in (prior.wgs84.latitude_deg, prior.wgs84.longitude_deg)
        )
    elif prior is not None and prior.position is not None:
        place = _in_map(prior.position.x, prior.position.y)
    elif last is not None:
        place = _in_map(last.x, last.y)
    return place if map_name is None else f"{quote(map_name.partition('@')[0], safe='')[:64]}-{place}"


def _in_map(x: float, y: float) -> str:
    return f"map-{math.floor(x / CELL_M)}-{math.floor(y / CELL_M)}"


def _position_of(answer: schema.LocalizeAnswer) -> schema.Vector | None:
    """Return the position of the camera at an answer of a track, map frame, m; None if the answer has none."""
    if answer.pose is not None:
        return answer.pose.position
    modes = [] if answer.belief is None else answer.belief.modes
    return modes[0].pose.position if modes else None
