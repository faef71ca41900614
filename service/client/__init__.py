"""Clients of the service over HTTP and gRPC. They take NumPy arrays or image files and return typed answers.

``GrpcClient`` needs the extra ``grpc``, so its module is imported on first use. The others need no extra.
"""

from typing import TYPE_CHECKING, Any

from service.client.async_client import AsyncClient
from service.client.client import Client
from service.client.prepare import (
    BatchOptions,
    Frame,
    RequestOptions,
    SequenceOptions,
    StreamFrame,
    StreamOptions,
    Track,
)
from service.client.retry import RetryPolicy
from service.client.stream_answer import StreamAnswer
from service.contract.schema import (
    LocalizeAnswer,
    MapEntry,
    OdometryStd,
    Options,
    Pose,
    Prior,
    PriorPosition,
    PriorWgs84,
)
from service.errors import (
    ForeignServiceError,
    HandshakeError,
    KeysError,
    NoAnswerInTimeError,
    NotLocalizedError,
    RefusedError,
    RequestError,
    StreetfixError,
    UnavailableError,
    UnreachableError,
    extra_missing,
)
from service.geometry.camera import PinholeCamera

if TYPE_CHECKING:
    from service.client.grpc_client import GrpcClient

__all__ = [
    "AsyncClient",
    "BatchOptions",
    "Client",
    "ForeignServiceError",
    "Frame",
    "GrpcClient",
    "HandshakeError",
    "KeysError",
    "LocalizeAnswer",
    "MapEntry",
    "NoAnswerInTimeError",
    "NotLocalizedError",
    "OdometryStd",
    "Options",
    "PinholeCamera",
    "Pose",
    "Prior",
    "PriorPosition",
    "PriorWgs84",
    "RefusedError",
    "RequestError",
    "RequestOptions",
    "RetryPolicy",
    "SequenceOptions",
    "StreamAnswer",
    "StreamFrame",
    "StreamOptions",
    "StreetfixError",
    "Track",
    "UnavailableError",
    "UnreachableError",
]


def __getattr__(name: str) -> Any:
    """Import ``GrpcClient`` on first use (PEP 562).

    Args:
        name: name of the attribute.

    Raises:
        AttributeError: there is no such name.
        ExtraMissingError: the extra ``grpc`` is not installed.
    """
    if name != "GrpcClient":
        raise AttributeError(f"module 'service.client' has no attribute {name!r}")
    try:
        from service.client.grpc_client import GrpcClient
    except ModuleNotFoundError as error:
        raise extra_missing("GrpcClient", "grpc", error) from error
    globals()[name] = GrpcClient
    return GrpcClient
