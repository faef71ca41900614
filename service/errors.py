"""The exceptions of Streetfix. The lowest layer: it imports nothing of ours.

StreetfixError                     code            kind
├── RequestError                   request         invalid      a field of the request is missing or makes no sense
│   ├── DecodeError                undecodable     invalid      a part is not the picture it says it is
│   ├── ImageSizeError             image-size      invalid      a picture's size does not fit the camera
│   ├── NoDepthError               no-depth        invalid      the depth picture holds no usable measurement
│   └── NotYetSupportedError       not-yet         invalid      a field of the contract that this release cannot use
├── UnsupportedFormatError         format          unsupported  a format that we do not read
├── TooLargeError                  too-large       too_large    a part is beyond a limit
├── UnknownMapError                unknown-map     not_found    no map of that name is mounted
├── UnknownSampleError              unknown-sample  not_found    no sample pair of that name lies beside the maps
├── NoPoseError                    no-pose         not_found    no sure pose, asked for in a format that has no word for doubt
├── NotLocalizedError              not-localized   not_found    a pose is wanted of an answer that is not LOCALIZED
├── NotGeoreferencedError          no-georeference invalid      a place on the Earth is asked of a map that has none
├── UnauthorizedError              unauthorized    unauthorized no API key, or not one of the service's
├── ForbiddenError                 forbidden       forbidden    the caller may ask, but not change what the service does
├── ForbiddenHostError             forbidden-host  forbidden    the request names a host that is not this service
├── ForbiddenOriginError           forbidden-origin forbidden   a web page of another origin sent the request
├── BusyError                      busy            busy         the queue, or the memory for requests, is full
├── NotReadyError                  not-ready       not_ready    no map is mounted, or the service is leaving
├── DeadlineError                  deadline        deadline     a request took longer than the service allows
├── BundleError                    bundle          not_ready    a map bundle is missing, damaged or of another version
├── DatasetError                   dataset         invalid      a dataset folder is incomplete or contradicts itself
├── EncoderError                   encoder         not_ready    an encoder file is missing or is not an encoder of ours
├── UnreachableError               unreachable     not_ready    a service does not answer
│   ├── NoAnswerInTimeError        no-answer       not_ready    a service was asked, and the caller's time ended
│   ├── ForeignServiceError        foreign         not_ready    what answers speaks another language
│   └── HandshakeError             handshake       not_ready    a service and its client do not agree on TLS
├── RefusedError                   refused         invalid      a service refused a request (seen by its client)
│   └── UnavailableError           unavailable     not_ready    it refused for now, and still did when patience ended
├── AddressError                   address         not_ready    the service cannot listen where it was told to
├── KeysError                      keys            not_ready    the file of API keys, or a certificate, cannot be used
├── ExtraMissingError              extra-missing   unsupported  a command or a class needs packages of an extra
└── UnsupportedPlatformError       platform        unsupported  the service does not run on this operating system or processor

No number of HTTP or gRPC stands here: each face has one table over ``kind``.

``NotFiniteError`` stands outside the tree: the service is at fault, not the request. Both faces answer such errors with 500 or INTERNAL
and the request id, and log the story.
"""

from typing import Any, ClassVar, Literal

Kind = Literal[
    "invalid", "unsupported", "too_large", "not_found", "unauthorized", "forbidden", "busy", "deadline", "not_ready"
]


class StreetfixError(Exception):
    """The root: what happened, the offending value, what to do.

    Args:
        message: for people, in three parts: what, the value, the remedy.
        field: dotted path of the request's or file's field at fault, e.g. ``camera.fx``; empty if none is.
    """

    code: ClassVar[str] = "error"
    kind: ClassVar[Kind] = "invalid"

    def __init__(self, message: str, *, field: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.field = field


class RequestError(StreetfixError):
    """A field of the request is missing or makes no sense."""

    code = "request"


class DecodeError(RequestError):
    """A part is not the picture it says it is."""

    code = "undecodable"


class ImageSizeError(RequestError):
    """A picture's size or aspect does not fit the camera's intrinsics."""

    code = "image-size"


class NoDepthError(RequestError):
    """The depth picture holds no usable measurement."""

    code = "no-depth"


class NotYetSupportedError(RequestError):
    """A field of the contract that this release cannot use; ignoring it would be a silent lie."""

    code = "not-yet"


class UnsupportedFormatError(StreetfixError):
    """A format that we do not read."""

    code = "format"
    kind = "unsupported"


class TooLargeError(StreetfixError):
    """A part is beyond a limit of bytes, pixels or parts."""

    code = "too-large"
    kind = "too_large"


class UnknownMapError(StreetfixError):
    """No map of that name is mounted."""

    code = "unknown-map"
    kind = "not_found"


class UnknownSampleError(StreetfixError):
    """No sample pair of that name lies beside the maps."""

    code = "unknown-sample"
    kind = "not_found"


class NoPoseError(StreetfixError):
    """The pictures do not say where they were taken, and the format that was asked for has no word for doubt."""

    code = "no-pose"
    kind = "not_found"


class NotLocalizedError(StreetfixError):
    """A pose is wanted of an answer that is not LOCALIZED, so that it has none.

    Args:
        message: for people.
        answer: the whole answer, a ``service.contract.schema.LocalizeAnswer``; its hypotheses are not confirmed.
    """

    code = "not-localized"
    kind = "not_found"

    def __init__(self, message: str, *, answer: Any) -> None:
        super().__init__(message)
        self.answer = answer


class NotGeoreferencedError(StreetfixError):
    """A place on the Earth is asked of a map that has none."""

    code = "no-georeference"


class UnauthorizedError(StreetfixError):
    """The service asks for an API key, and got none or not one of its own."""

    code = "unauthorized"
    kind = "unauthorized"


class ForbiddenError(StreetfixError):
    """The caller may ask, but not change what the service does."""

    code = "forbidden"
    kind = "forbidden"


class ForbiddenHostError(StreetfixError):
    """The request's `Host` is not a name of this service, as when a web page's name was made to point here."""

    code = "forbidden-host"
    kind = "forbidden"


class ForbiddenOriginError(StreetfixError):
    """A web page of another origin sent a request that changes something or costs work."""

    code = "forbidden-origin"
    kind = "forbidden"


class BusyError(StreetfixError):
    """The queue or the memory for requests is full; try again shortly."""

    code = "busy"
    kind = "busy"


class NotReadyError(StreetfixError):
    """No map is mounted, or the service is leaving."""

    code = "not-ready"
    kind = "not_ready"


class DeadlineError(StreetfixError):
    """A request took longer than the service allows."""

    code = "deadline"
    kind = "deadline"


class BundleError(StreetfixError):
    """A map bundle is missing, damaged, or of a version that this program does not read."""

    code = "bundle"
    kind = "not_ready"


class DatasetError(StreetfixError):
    """A dataset folder is incomplete or contradicts itself."""

    code = "dataset"


class EncoderError(StreetfixError):
    """An encoder file is missing, or is not an encoder of ours."""

    code = "encoder"
    kind = "not_ready"


class UnreachableError(StreetfixError):
    """A service does not answer."""

    code = "unreachable"
    kind = "not_ready"


class NoAnswerInTimeError(UnreachableError):
    """A service was asked, and the time that its caller gave it ended before the answer came."""

    code = "no-answer"


class ForeignServiceError(UnreachableError):
    """What answers at an address is no Streetfix, or one of another contract."""

    code = "foreign"


class HandshakeError(UnreachableError):
    """A service and its client do not agree on TLS: an unknown authority, another name, a missing client certificate."""

    code = "handshake"


class RefusedError(StreetfixError):
    """A service refused a request; the message carries the problem it answered with.

    Args:
        message: for people.
        field: dotted path of the request's field at fault.
        problem: code of the service's problem, as ``image-size`` (docs/problems.md); empty where it named none.
        detail: what the service said.
        status: as the face spelled it, ``422`` or ``INVALID_ARGUMENT``.
        request_id: by which the service's operator finds it in the log.
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
    """A service refused for now, as when its queue is full, and still did when its client's patience ended.

    Attributes:
        retry_after_s: when to come back, by the service's last advice; None where it gave none.
    """

    code = "unavailable"
    kind = "not_ready"

    retry_after_s: float | None = None


class AddressError(StreetfixError):
    """The service cannot listen on the address it was given."""

    code = "address"
    kind = "not_ready"


class KeysError(StreetfixError):
    """The file of API keys, or a certificate, cannot be used."""

    code = "keys"
    kind = "not_ready"


class NotFiniteError(ArithmeticError):
    """A number of an answer is not finite; no such number may leave the core.

    Args:
        path: of the number in the answer.
    """

    def __init__(self, path: str) -> None:
        super().__init__(f"{path} of the answer is not finite")
        self.path = path


def how_to_install(extra: str | None) -> str:
    """The remedy for a missing extra. Streetfix is not on PyPI, so pip needs a clone.

    Args:
        extra: of ``pyproject.toml``; None for the package without extras.
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
    """The error for a package that is not installed.

    Args:
        needed_by: command, class or argument that needs the package.
        extra: extra of ``pyproject.toml`` that brings the package; None if the package without extras does.
        error: of the import.

    Raises:
        ModuleNotFoundError: the missing module is one of ours, so no extra brings it.
    """
    package = (error.name or "").partition(".")[0]
    if package in ("", "service", "streetfix"):
        raise error
    return ExtraMissingError(f"{needed_by} needs the package {package!r}: {how_to_install(extra)}", field=needed_by)


class UnsupportedPlatformError(StreetfixError):
    """The service does not run on this operating system or processor."""

    code = "platform"
    kind = "unsupported"
