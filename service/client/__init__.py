"""The robot's side of the service: numpy arrays in, typed answers out, over HTTP or gRPC."""

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
