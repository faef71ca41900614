"""Clients of the service over HTTP and gRPC. They take NumPy arrays and return typed answers."""

from service.client.asking import About, AboutSequence, Frame
from service.client.async_client import AsyncClient
from service.client.client import Client
from service.client.grpc_client import GrpcClient
from service.client.retry import RetryPolicy
from service.contract.schema import (
    LocalizeAnswer,
    MapEntry,
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
)
from service.geometry.camera import PinholeCamera

__all__ = [
    "About",
    "AboutSequence",
    "AsyncClient",
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
    "Options",
    "PinholeCamera",
    "Pose",
    "Prior",
    "PriorPosition",
    "PriorWgs84",
    "RefusedError",
    "RequestError",
    "RetryPolicy",
    "StreetfixError",
    "UnavailableError",
    "UnreachableError",
]
