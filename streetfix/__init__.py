"""The names that most programs need: the clients of a service, and the localizer to run in your own process.

Each name is imported from its module when it is first used. So a program that only needs a client does not load the localizer.
The package without extras has the clients over HTTP. ``GrpcClient`` needs the extra ``grpc``, and ``Localizer``, ``MapBundle``,
``Query`` and ``GivenHeight`` need the extra ``server``.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from service.errors import extra_missing

if TYPE_CHECKING:
    from service.client import (
        AsyncClient,
        Client,
        Frame,
        GrpcClient,
        NotLocalizedError,
        OdometryStd,
        Options,
        PinholeCamera,
        Pose,
        Prior,
        PriorPosition,
        PriorWgs84,
        RefusedError,
        StreamFrame,
        StreetfixError,
        Track,
    )
    from service.imaging.level import GivenHeight
    from service.localization.localizer import Localizer
    from service.maps.reader import MapBundle
    from service.retrieval.query import Query

__all__ = [
    "AsyncClient",
    "Client",
    "Frame",
    "GivenHeight",
    "GrpcClient",
    "Localizer",
    "MapBundle",
    "NotLocalizedError",
    "OdometryStd",
    "Options",
    "PinholeCamera",
    "Pose",
    "Prior",
    "PriorPosition",
    "PriorWgs84",
    "Query",
    "RefusedError",
    "StreamFrame",
    "StreetfixError",
    "Track",
]
#: Modules of the names that are not in ``service.client``.
_MODULES = {
    "GivenHeight": "service.imaging.level",
    "Localizer": "service.localization.localizer",
    "MapBundle": "service.maps.reader",
    "NotLocalizedError": "service.errors",
    "PinholeCamera": "service.geometry.camera",
    "Query": "service.retrieval.query",
    "RefusedError": "service.errors",
    "StreetfixError": "service.errors",
}
#: Names of the core, and the extra that they need.
_EXTRAS = {"GivenHeight": "server", "Localizer": "server", "MapBundle": "server", "Query": "server"}


def __getattr__(name: str) -> Any:
    """Import a name on first use (PEP 562).

    Args:
        name: one of ``__all__``.

    Raises:
        AttributeError: there is no such name.
        ExtraMissingError: the name needs an extra that is not installed.
    """
    if name not in __all__:
        raise AttributeError(f"module 'streetfix' has no attribute {name!r}; it has {', '.join(__all__)}")
    try:
        found = getattr(import_module(_MODULES.get(name, "service.client")), name)
    except ModuleNotFoundError as error:
        raise extra_missing(f"streetfix.{name}", _EXTRAS.get(name), error) from error
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    """The names of ``__all__``."""
    return __all__
