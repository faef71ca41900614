"""The cell of a request: a value that is the same for nearby positions. A load balancer sends the requests of a cell to one instance."""

import math
import uuid
from urllib.parse import quote

from service.contract import schema

#: Header of the cell.
HEADER = "X-Streetfix-Cell"
#: Edge of a cell, metres of the map frame and degrees on the Earth.
CELL_M, CELL_DEG = 1_000.0, 0.01


def cell_of(prior: schema.Prior | None, map_name: str | None) -> str:
    """Return the cell of a request.

    An instance of the service needs only the tiles of the cells that it answers. The cell does not change an answer.

    Args:
        prior: prior of the camera pose; None or one without a position gives a random cell, so such requests spread over all instances.
        map_name: name of the map; None if the request names none.
    """
    place = uuid.uuid4().hex[:8]
    if prior is not None and prior.wgs84 is not None:
        place = "earth-" + "-".join(
            str(math.floor(each / CELL_DEG)) for each in (prior.wgs84.latitude_deg, prior.wgs84.longitude_deg)
        )
    elif prior is not None and prior.position is not None:
        place = "map-" + "-".join(str(math.floor(each / CELL_M)) for each in (prior.position.x, prior.position.y))
    return place if map_name is None else f"{quote(map_name.partition('@')[0], safe='')[:64]}-{place}"
