"""The names that most programs need: the clients of a service, and the localizer to run in your own process.

Each name is imported from its module when it is first used. So a program that only needs a client does not load the localizer.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from service.client import (
        AsyncClient,
        Client,
        Frame,
        GrpcClient,
        NotLocalizedError,
        Options,
        PinholeCamera,
        Pose,
        Prior,
        PriorPosition,
        PriorWgs84,
        RefusedError,
        StreetfixError,
    )
    from service.localization.localizer import Localizer
    from service.localization.query import Query
    from service.maps.reader import MapBundle

__all__ = [
    "AsyncClient",
    "Client",
    "Frame",
    "GrpcClient",
    "Localizer",
    "MapBundle",
    "NotLocalizedError",
    "Options",
    "PinholeCamera",
    "Pose",
    "Prior",
    "PriorPosition",
    "PriorWgs84",
    "Query",
    "RefusedError",
    "StreetfixError",
]
#: Modules of the names that are not in ``service.client``.
_MODULES = {
    "Localizer": "service.localization.localizer",
    "MapBundle": "service.maps.reader",
    "NotLocalizedError": "service.errors",
    "PinholeCamera": "service.geometry.camera",
    "Query": "service.localization.query",
    "RefusedError": "service.errors",
    "StreetfixError": "service.errors",
}


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562).

    Args:
        name: one of ``__all__``.

    Raises:
        AttributeError: there is no such name.
    """
    if name not in __all__:
        raise AttributeError(f"module 'streetfix' has no attribute {name!r}; it has {', '.join(__all__)}")
    found = getattr(import_module(_MODULES.get(name, "service.client")), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The names of ``__all__``."""
    return __all__
