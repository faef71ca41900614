"""OGC GeoPose as the whole answer."""

from service.contract.schema import GeoPose, LocalizeAnswer
from service.errors import NoPoseError, NotGeoreferencedError

#: Registered with IANA for OGC 21-056r11.
GEOPOSE = "application/geopose+json"


def sure_geopose(answer: LocalizeAnswer) -> GeoPose:
    """Return the GeoPose of an accepted answer. GeoPose has no field for the status or the confidence.

    Args:
        answer: of the service.

    Raises:
        NoPoseError: the answer is not LOCALIZED.
        NotGeoreferencedError: the map is not georeferenced.
    """
    if answer.status != "LOCALIZED":
        raise NoPoseError(
            f"the answer is {answer.status} (confidence {answer.confidence or 0:.3f}), and GeoPose cannot express uncertainty; request "
            "application/json to see the hypotheses, send a prior or more frames, or turn the camera"
        )
    if answer.geopose is None:
        raise NotGeoreferencedError(
            f"the map {answer.map.name!r} is not georeferenced; request application/json, or build the map with a georeference"
        )
    return answer.geopose
