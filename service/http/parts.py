"""Required parts of a multipart body."""

from service.contract.schema import MOST_FRAMES
from service.errors import RequestError

#: Maximum number of parts: an image pair for each frame of the longest sequence, and the JSON.
MOST_PARTS = 2 * MOST_FRAMES + 1


def require_parts(parts: dict[str, bytes], names: tuple[str, ...]) -> None:
    """Require exactly the given parts.

    Args:
        parts: content by name.
        names: required names.

    Raises:
        RequestError: a part is missing or unknown.
    """
    told = f"send the parts {', '.join(names[:-1])} and {names[-1]}"
    for name in names:
        if name not in parts:
            raise RequestError(f"the part {name!r} is missing; {told}", field=name)
    if unknown := sorted(set(parts) - set(names)):
        raise RequestError(f"the part {unknown[0]!r} is unknown; {told}", field=unknown[0])


def document_of(parts: dict[str, bytes]) -> bytes:
    """Return the JSON part.

    Args:
        parts: content by name.

    Raises:
        RequestError: the part is missing.
    """
    if "request" not in parts:
        raise RequestError(
            "the part 'request' is missing; send the JSON that says what the pictures are", field="request"
        )
    return parts["request"]


def numbered_pictures(parts: dict[str, bytes], count: int) -> list[tuple[bytes, bytes]]:
    """Return the image pairs (rgb0, depth0), (rgb1, depth1) and so on.

    Args:
        parts: content by name.
        count: number of pairs.

    Raises:
        RequestError: a part is missing or unknown.
    """
    require_parts(parts, (*(f"{kind}{k}" for k in range(count) for kind in ("rgb", "depth")), "request"))
    return [(parts[f"rgb{k}"], parts[f"depth{k}"]) for k in range(count)]
