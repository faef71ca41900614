"""OGC GeoPose by content negotiation. Such an answer holds only the pose."""

from service.contract.schema import GeoPose, LocalizeAnswer
from service.errors import NoPoseError, NotGeoreferencedError

#: Registered with IANA for OGC 21-056r11.
GEOPOSE = "application/geopose+json"


def wants_geopose(accept: str) -> bool:
    """Return whether a caller prefers GeoPose to the JSON answer of this service.

    Args:
        accept: value of the header. The highest quality wins; the first entry breaks ties.
    """
    best, wanted = 0.0, False
    for entry in accept.split(","):
        name, *parameters = (word.strip().lower() for word in entry.split(";"))
        quality = 1.0
        for parameter in parameters:
            key, _, value = parameter.partition("=")
            if key.strip() == "q":
                try:
                    quality = float(value)
                except ValueError:
                    quality = 0.0
        if quality > best and name in (GEOPOSE, "application/json", "application/*", "*/*"):
            best, wanted = quality, name == GEOPOSE
    return wanted


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
            f"the answer is {answer.status} (confidence {answer.confidence or 0:.3f}), and GeoPose cannot say so; ask for "
            "application/json to see its hypotheses, send a prior or more frames, or look another way"
        )
    if answer.geopose is None:
        raise NotGeoreferencedError(
            f"the map {answer.map.name!r} is not georeferenced, so its poses have no place on the Earth; ask for application/json"
        )
    return answer.geopose
