"""Logging with one line per event, as JSON for machines or as text for people.

Of a request the log holds only its id, its trace id and its figures.
"""

import json
import logging
import re
import sys
from datetime import UTC, datetime
from typing import Literal

#: W3C Trace Context: version, trace id, parent id, flags.
_TRACEPARENT = re.compile(r"[0-9a-f]{2}-(?!0{32})([0-9a-f]{32})-(?!0{16})[0-9a-f]{16}-[0-9a-f]{2}")
_log = logging.getLogger("streetfix.requests")


class JsonFormatter(logging.Formatter):
    """Formats an event as one JSON object per line. The figures of an event are top-level fields."""

    def format(self, record: logging.LogRecord) -> str:
        """Format one line.

        Args:
            record: the event.
        """
        entry: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "event": record.getMessage(),
        }
        entry |= getattr(record, "figures", {})
        if record.exc_info:
            entry["error"] = self.formatException(record.exc_info)
        return json.dumps(entry, default=str)


class TextFormatter(logging.Formatter):
    """Formats an event as text, with its figures as ``name=value``."""

    def format(self, record: logging.LogRecord) -> str:
        """Format one line, with the lines of a traceback below it.

        Args:
            record: the event.
        """
        figures = " ".join(f"{name}={value}" for name, value in getattr(record, "figures", {}).items())
        line = super().format(record)
        head, _, rest = line.partition("\n")
        return f"{head} {figures}".rstrip() + (f"\n{rest}" if rest else "")


def set_up(*, style: Literal["text", "json"], level: Literal["debug", "info", "warning", "error"]) -> None:
    """Send all loggers to stderr.

    Args:
        style: of the lines.
        level: lowest level to log.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        JsonFormatter() if style == "json" else TextFormatter("%(asctime)s %(levelname)s %(name)s %(message)s")
    )
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


def log_request(*, face: str, method: str, code: str, seconds: float, request_id: str, traceparent: str | None) -> None:
    """Log a request that was answered or refused.

    Args:
        face: request handler, ``rest`` or ``grpc``.
        method: operation or call.
        code: status code, or the code of a problem.
        seconds: duration.
        request_id: of the request.
        traceparent: W3C trace context of the request; None if it has none.
    """
    if not _log.isEnabledFor(logging.INFO):
        return
    figures: dict[str, object] = {
        "face": face,
        "method": method,
        "code": code,
        "ms": round(1e3 * seconds, 1),
        "request_id": request_id,
    }
    if (trace_id := trace_id_of(traceparent)) is not None:
        figures["trace_id"] = trace_id
    _log.info("request", extra={"figures": figures})


def trace_id_of(traceparent: str | None) -> str | None:
    """Return the trace id of a ``traceparent`` header; None if the header is missing or malformed.

    Args:
        traceparent: value of the header.
    """
    found = _TRACEPARENT.fullmatch((traceparent or "").strip())
    return None if found is None else found[1]
