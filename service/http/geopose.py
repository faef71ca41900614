"""OGC GeoPose by content negotiation: an answer that says nothing but where."""

from service.contract.schema import GeoPose, LocalizeAnswer
from service.errors import NoPoseError, NotGeoreferencedError

#: Registered with IANA for OGC 21-056r11.
GEOPOSE = "application/geopose+json"


def wants_geopose(accept: str) -> bool:
    """Whether a caller takes GeoPose and has not asked for our own answer before it.

    Args:
        accept: the header; qualities decide, and of equal ones the first.
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
    """The pose, if it may be given without a word of doubt, which GeoPose has none for.

    Raises:
        NoPoseError: the answer is not LOCALIZED.
        NotGeoreferencedError: the map does not say where on the Earth it lies.
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
