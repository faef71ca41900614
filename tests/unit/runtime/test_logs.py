import json
import logging

import pytest

from service.runtime.logs import JsonFormatter, TextFormatter, log_request, trace_id_of

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        (f"00-{TRACE}-00f067aa0ba902b7-01", TRACE),
        (f" 00-{TRACE}-00f067aa0ba902b7-01 ", TRACE),
        (None, None),
        ("", None),
        (f"00-{TRACE}-00f067aa0ba902b7", None),
        (f"00-{TRACE.upper()}-00f067aa0ba902b7-01", None),
        (f"00-{'0' * 32}-00f067aa0ba902b7-01", None),
        (f"00-{TRACE}-{'0' * 16}-01", None),
        (f"00-{TRACE[:-1]}-00f067aa0ba902b7-01", None),
    ],
)
def test_a_trace_is_known_by_a_well_formed_header_alone(header, expected):
    """The example of the W3C recommendation, and damaged forms of it."""
    assert trace_id_of(header) == expected


@pytest.fixture
def request_record(caplog):
    with caplog.at_level(logging.INFO, "streetfix.requests"):
        log_request(
            face="rest",
            method="localize",
            code="200",
            seconds=0.01234,
            request_id="r1",
            traceparent=f"00-{TRACE}-00f067aa0ba902b7-01",
        )
    (record,) = caplog.records
    return record


def test_a_request_is_one_json_object_a_line(request_record):
    line = JsonFormatter().format(request_record)
    assert "\n" not in line
    told = json.loads(line)
    assert told.pop("time").endswith("+00:00")
    assert told == {
        "level": "info",
        "logger": "streetfix.requests",
        "event": "request",
        "face": "rest",
        "method": "localize",
        "code": "200",
        "ms": 12.3,
        "request_id": "r1",
        "trace_id": TRACE,
    }


def test_or_one_line_of_text(request_record):
    assert (
        TextFormatter("%(message)s").format(request_record)
        == f"request face=rest method=localize code=200 ms=12.3 request_id=r1 trace_id={TRACE}"
    )


def test_an_error_keeps_its_traceback_in_the_object(caplog):
    try:
        raise ValueError("why\nin two lines")
    except ValueError as error:
        logging.getLogger("x").error("failed", exc_info=error)
    line = JsonFormatter().format(caplog.records[0])
    assert "\n" not in line
    assert "in two lines" in json.loads(line)["error"]


def test_below_its_level_nothing_is_written(caplog):
    with caplog.at_level(logging.WARNING, "streetfix.requests"):
        log_request(face="grpc", method="Localize", code="OK", seconds=0, request_id="r", traceparent=None)
    assert caplog.records == []
