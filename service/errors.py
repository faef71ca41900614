"""The exceptions of Streetfix. The lowest layer: it imports nothing of ours.

StreetfixError                     code             kind
├── RequestError                   request          invalid      a field of the request is missing or invalid
│   ├── DecodeError                undecodable      invalid      a part cannot be decoded as an image
│   ├── ImageSizeError             image-size       invalid      the image size does not match the camera intrinsics
│   ├── NoDepthError               no-depth         invalid      the depth image has no usable measurement
│   └── NotYetSupportedError       not-yet          invalid      this release does not support the field
├── UnsupportedFormatError         format           unsupported  the format is not supported
├── TooLargeError                  too-large        too_large    a part exceeds a limit
├── UnknownMapError                unknown-map      not_found    no mounted map matches the request
├── UnknownSampleError             unknown-sample   not_found    the sample pair was not found
├── NoPoseError                    no-pose          not_found    not LOCALIZED, and GeoPose cannot express uncertainty
├── NotLocalizedError              not-localized    not_found    the answer is not LOCALIZED, so it has no pose
├── NotGeoreferencedError          no-georeference  invalid      the map is not georeferenced
├── UnauthorizedError              unauthorized     unauthorized the API key is missing or unknown
├── ForbiddenError                 forbidden        forbidden    the caller has no operator rights
├── ForbiddenHostError             forbidden-host   forbidden    the Host header does not name this service
├── ForbiddenOriginError           forbidden-origin forbidden    a web page of another origin sent the request
├── BusyError                      busy             busy         the queue or the memory for requests is full
├── NotReadyError                  not-ready        not_ready    no map is mounted, or the service is stopping
├── DeadlineError                  deadline         deadline     a request took longer than the service allows
├── BundleError                    bundle           not_ready    a map bundle is missing, damaged or of another version
├── SearchError                    search           not_ready    the search server does not answer, or lacks views of a map
├── DatasetError                   dataset          invalid      a dataset folder is incomplete or inconsistent
├── EncoderError                   encoder          not_ready    an encoder file is missing or is not a Streetfix encoder
├── UnreachableError               unreachable      not_ready    the service does not answer
│   ├── NoAnswerInTimeError        no-answer        not_ready    the client timed out before the answer arrived
│   ├── ForeignServiceError        foreign          not_ready    the program at the address is not a compatible Streetfix service
│   └── HandshakeError             handshake        not_ready    the TLS handshake failed
├── RefusedError                   refused          invalid      the service refused a request (raised by the client)
│   └── UnavailableError           unavailable      not_ready    the service still refused after the last retry
├── AddressError                   address          not_ready    the service cannot listen on the given address
├── KeysError                      keys             not_ready    the file of API keys, or a certificate, cannot be used
├── ExtraMissingError              extra-missing    unsupported  a command or a class needs packages of an extra
└── UnsupportedPlatformError       platform         unsupported  the service does not run on this operating system or processor

This module defines no status code of HTTP or gRPC. Each interface has one table that maps ``kind`` to its status codes.

``NotFiniteError`` is outside the tree, because the service is at fault and not the request. Both interfaces answer such errors with
500 or INTERNAL and the request id, and log the traceback.
"""

from pathlib import Path
from typing import Any, ClassVar, Literal

Kind = Literal[
    "invalid", "unsupported", "too_large", "not_found", "unauthorized", "forbidden", "busy", "deadline", "not_ready"
]


class StreetfixError(Exception):
    """Root of all errors. The first line of each subclass's docstring is the title of its problem.

    Args:
        message: readable text in three parts: what happened, the wrong value, and the remedy.
        field: dotted path of the invalid field of the request or file, e.g. ``camera.fx``. Empty if there is none.
    """

    code: ClassVar[str] = "error"
    kind: ClassVar[Kind] = "invalid"

    def __init__(self, message: str, *, field: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.field = field


class RequestError(StreetfixError):
    """A field of the request is missing or invalid."""

    code = "request"


class DecodeError(RequestError):
    """A part cannot be decoded as an image."""

    code = "undecodable"


class ImageSizeError(RequestError):
    """The image size does not match the camera intrinsics."""

    code = "image-size"


class NoDepthError(RequestError):
    """The depth image has no usable measurement."""

    code = "no-depth"


class NotYetSupportedError(RequestError):
    """This release does not support the field."""

    code = "not-yet"


class UnsupportedFormatError(StreetfixError):
    """The format is not supported."""

    code = "format"
    kind = "unsupported"


class TooLargeError(StreetfixError):
    """The request exceeds a limit of bytes, pixels or parts."""

    code = "too-large"
    kind = "too_large"


class UnknownMapError(StreetfixError):
    """No mounted map matches the request."""

    code = "unknown-map"
    kind = "not_found"


class UnknownSampleError(StreetfixError):
    """The sample pair was not found."""

    code = "unknown-sample"
    kind = "not_found"


class NoPoseError(StreetfixError):
    """The answer is not LOCALIZED, and GeoPose cannot express uncertainty."""

    code = "no-pose"
    kind = "not_found"


class NotLocalizedError(StreetfixError):
    """The answer is not LOCALIZED, so it has no pose.

    Args:
        message: readable text.
        answer: the whole answer, a ``service.contract.schema.LocalizeAnswer``; its hypotheses are not confirmed.
    """

    code = "not-localized"
    kind = "not_found"

    def __init__(self, message: str, *, answer: Any) -> None:
        super().__init__(message)
        self.answer = answer


class NotGeoreferencedError(StreetfixError):
    """The map is not georeferenced."""

    code = "no-georeference"


class UnauthorizedError(StreetfixError):
    """The API key is missing or unknown."""

    code = "unauthorized"
    kind = "unauthorized"


class ForbiddenError(StreetfixError):
    """The caller has no operator rights."""

    code = "forbidden"
    kind = "forbidden"


class ForbiddenHostError(StreetfixError):
    """The Host header does not name this service."""

    code = "forbidden-host"
    kind = "forbidden"


class ForbiddenOriginError(StreetfixError):
    """A web page of another origin sent the request."""

    code = "forbidden-origin"
    kind = "forbidden"


class BusyError(StreetfixError):
    """The queue or the memory for requests is full; try again shortly."""

    code = "busy"
    kind = "busy"


class NotReadyError(StreetfixError):
    """No map is mounted, or the service is stopping."""

    code = "not-ready"
    kind = "not_ready"


class DeadlineError(StreetfixError):
    """The request took longer than the service allows."""

    code = "deadline"
    kind = "deadline"


class BundleError(StreetfixError):
    """A map bundle is missing, damaged, or of a version that this release does not support."""

    code = "bundle"
    kind = "not_ready"


def damaged_file(path: Path, what: str) -> BundleError:
    """Return the error for a damaged file of a map bundle.

    Args:
        path: the file.
        what: what is wrong.
    """
    return BundleError(f"{path}: {what}; copy or build the bundle again", field=path.name)


class SearchError(StreetfixError):
    """The search server (Qdrant) does not answer, or lacks views of a map."""

    code = "search"
    kind = "not_ready"


class DatasetError(StreetfixError):
    """A dataset folder is incomplete or inconsistent."""

    code = "dataset"


class EncoderError(StreetfixError):
    """An encoder file is missing or is not a Streetfix encoder."""

    code = "encoder"
    kind = "not_ready"


class UnreachableError(StreetfixError):
    """The service does not answer."""

    code = "unreachable"
    kind = "not_ready"


class NoAnswerInTimeError(UnreachableError):
    """The client timed out before the answer arrived."""

    code = "no-answer"


class ForeignServiceError(UnreachableError):
    """The program at this address is not a compatible Streetfix service."""

    code = "foreign"


class HandshakeError(UnreachableError):
    """The TLS handshake failed: an unknown authority, another host name, or a missing client certificate."""

    code = "handshake"


class RefusedError(StreetfixError):
    """The service refused the request. The message has the problem that the service reported.

    Args:
        message: readable text.
        field: dotted path of the invalid field of the request.
        problem: code of the problem, such as ``image-size`` (docs/problems.md). Empty if the service named none.
        detail: detail of the problem.
        status: status code of the interface, such as ``422`` or ``INVALID_ARGUMENT``.
        request_id: id of the request in the log of the service.
    """

    code = "refused"

    def __init__(
        self,
        message: str,
        *,
        field: str = "",
        problem: str = "",
        detail: str = "",
        status: str = "",
        request_id: str = "",
    ) -> None:
        super().__init__(message, field=field)
        self.problem = problem
        self.detail = detail
        self.status = status
        self.request_id = request_id


class UnavailableError(RefusedError):
    """The service still refused after the last retry.

    Attributes:
        retry_after_s: wait that the service advised last, seconds. None without advice.
    """

    code = "unavailable"
    kind = "not_ready"

    retry_after_s: float | None = None


class AddressError(StreetfixError):
    """The service cannot listen on the given address."""

    code = "address"
    kind = "not_ready"


class KeysError(StreetfixError):
    """The file of API keys, or a certificate, cannot be used."""

    code = "keys"
    kind = "not_ready"


class NotFiniteError(ArithmeticError):
    """A number of an answer is not finite, so the answer must not be sent.

    Args:
        path: path of the number in the answer.
    """

    def __init__(self, path: str) -> None:
        super().__init__(f"{path} of the answer is not finite")
        self.path = path


def how_to_install(extra: str | None) -> str:
    """Return the remedy for a missing extra. Streetfix is not on PyPI, so pip needs a clone.

    Args:
        extra: extra of ``pyproject.toml``; None for the package without extras.
    """
    return (
        f'in a clone of Streetfix run pip install ".[{extra}]"'
        if extra
        else "in a clone of Streetfix run pip install ."
    )


class ExtraMissingError(StreetfixError):
    """A command or a class needs packages of an extra that is not installed."""

    code = "extra-missing"
    kind = "unsupported"


def extra_missing(needed_by: str, extra: str | None, error: ModuleNotFoundError) -> ExtraMissingError:
    """Return the error for a package that is not installed.

    Args:
        needed_by: command, class or argument that needs the package.
        extra: extra of ``pyproject.toml`` that brings the package; None if the package without extras does.
        error: error of the import.

    Raises:
        ModuleNotFoundError: the missing module belongs to Streetfix, so no extra provides it.
    """
    package = (error.name or "").partition(".")[0]
    if package in ("", "service", "streetfix"):
        raise error
    return ExtraMissingError(f"{needed_by} needs the package {package!r}: {how_to_install(extra)}", field=needed_by)


class UnsupportedPlatformError(StreetfixError):
    """The service does not run on this operating system or processor."""

    code = "platform"
    kind = "unsupported"
