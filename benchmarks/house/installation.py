"""Count the distributions that an installation of requirements brings."""

from collections.abc import Iterable
from importlib.metadata import distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def distributions_of(requirements: Iterable[str]) -> set[str]:
    """Return the names of the distributions that the requirements bring on this machine, by the metadata of what is installed.

    Args:
        requirements: requirements as in ``pyproject.toml``. Their distributions must be installed.

    Raises:
        importlib.metadata.PackageNotFoundError: a distribution is not installed.
    """
    found: set[str] = set()
    seen: set[tuple[str, frozenset[str]]] = set()
    wanted = [Requirement(each) for each in requirements]
    while wanted:
        requirement = wanted.pop()
        name, extras = canonicalize_name(requirement.name), frozenset(requirement.extras)
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        found.add(name)
        for each in map(Requirement, distribution(name).requires or ()):
            if each.marker is None or any(each.marker.evaluate({"extra": extra}) for extra in (*extras, "")):
                wanted.append(each)
    return found
