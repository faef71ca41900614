"""The load that needs the most memory, under a real memory limit: the service must refuse and must not be killed.

The load sends 66 REST bodies and 114 gRPC messages of 40 MiB at once. The service would admit as many if it counted
requests instead of bytes. It also sends such messages to other gRPC services, sequences with small files of many
pixels, and the hostile kinds.
"""

import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

import cv2
import httpx
import numpy as np

from benchmarks.report import Report
from benchmarks.serving.fire import asking
from benchmarks.serving.hostile import hostile_kinds
from benchmarks.serving.http2 import call
from benchmarks.serving.limited import Limited
from benchmarks.serving.machines import Server
from benchmarks.serving.ratios import Site
from model_training.loadtest.payloads import Payload
from service.grpc.generated.streetfix.v1 import localization_pb2 as pb

LIMIT_MIB = 2048
SECONDS = 30.0
BODIES, MESSAGES, OF_OTHERS, SEQUENCES, HOSTILE = 66, 114, 16, 4, 20
LARGE_BYTES = 40 * 2**20
#: Number of requests of well-behaved clients after the load.
AFTERWARDS = 20
_BOUNDARY = b"memory"
_SERVICE = "/streetfix.v1.LocalizationService"
_SIDE = 3200
_CAMERA = {"width": _SIDE, "height": _SIDE, "fx": 1600.0, "fy": 1600.0, "cx": 1599.5, "cy": 1599.5}
_TIMEOUT_S = 40.0


def memory_rows(report: Report, site: Site) -> None:
    """Add rows: survival, peak memory, and the requests of well-behaved clients during and after the load.

    Args:
        report: collects the rows.
        site: map and queries.
    """
    sent = site.payloads(refine=True)
    good = _good_parts(sent[0].body, sent[0].content_type)
    with Limited(LIMIT_MIB) as limited:
        # Without a control group the service sees the machine's memory, so it gets the value that the limit would have
        # left.
        told: dict[str, Any] = {} if limited.enter else {"request_memory_mib": LIMIT_MIB // 2}
        told["limits__max_message_bytes"] = LARGE_BYTES  # with the default, gRPC refuses such messages by their length
        with Server(site.bundle, core=None, enter=limited.enter, **told) as server:
            limited.watch(server.process.pid)
            ends: dict[str, Counter[str]] = {}
            with asking(server.url, sent[:2]) as (answers, refused):
                _until_over(_attackers(server, good), ends)
            afterwards = [_asked(server.url, sent[number % len(sent)]) for number in range(AFTERWARDS)]
            lives = server.process.poll() is None
        killed = limited.killed + (not lives and limited.killed == 0)
    busy = [each for each in refused if each.startswith("503")]
    report.notes["memory"] = {
        "limit": limited.how,
        "ends": {name: dict(each.most_common(6)) for name, each in sorted(ends.items())},
    }
    report.row("memory.limit_mib", LIMIT_MIB, "MiB", bar=LIMIT_MIB, better="lower", why=limited.how)
    report.row("memory.killed", killed, "count", bar=0, better="lower")
    report.row("memory.peak_mib", limited.peak_mib, "MiB", bar=LIMIT_MIB, better="lower")
    report.row("memory.sent_requests", sum(sum(each.values()) for each in ends.values()), "count")
    report.row("memory.healthy_answered", len(answers), "count", n=len(answers) + len(refused))
    broken = len(refused) - len(busy)
    first = next((each for each in refused if each not in busy), None)
    report.row(
        "memory.healthy_neither_answered_nor_refused",
        broken,
        "count",
        bar=0,
        better="lower",
        n=len(answers) + len(refused),
        why=f"first: {first}" if first else None,
    )
    report.row(
        "memory.failed_afterwards",
        sum(each != "200" for each in afterwards),
        "count",
        bar=0,
        better="lower",
        n=AFTERWARDS,
        why=None if set(afterwards) == {"200"} else f"answers: {Counter(afterwards)}",
    )


def _until_over(attackers: list[tuple[str, Callable[[], str]]], ends: dict[str, Counter[str]]) -> None:
    """Run all attackers at once, each repeatedly."""
    until, begin = time.monotonic() + SECONDS, threading.Barrier(len(attackers))
    for name, _ in attackers:
        ends.setdefault(name, Counter())

    def attack(name: str, once: Callable[[], str]) -> None:
        begin.wait()
        while time.monotonic() < until:
            ends[name][once()] += 1

    threads = [threading.Thread(target=attack, args=each) for each in attackers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def _attackers(server: Server, good: dict[str, bytes]) -> list[tuple[str, Callable[[], str]]]:
    large = memoryview(_large_body())
    message = memoryview(_large_message())
    frame = memoryview(_as_frame(message))
    sequence = memoryview(_sequence())
    kinds = list(hostile_kinds(good).values())
    found: list[tuple[str, Callable[[], str]]] = []
    found += BODIES * [("body", lambda: _sent(server.url, "/v1/localize", large, chunked=False))]
    found += BODIES // 3 * [("chunked body", lambda: _sent(server.url, "/v1/localize", large, chunked=True))]
    found += MESSAGES * [("message", lambda: call(server.grpc, f"{_SERVICE}/Localize", message, timeout_s=_TIMEOUT_S))]
    for path, sent in (
        ("/grpc.health.v1.Health/Check", message),
        ("/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo", message),
        (f"{_SERVICE}/LocalizeStream", frame),
    ):
        found += OF_OTHERS * [(path.rsplit("/", 1)[-1], _message_to(server.grpc, path, sent))]
    found += SEQUENCES * [
        ("sequence of large images", lambda: _sent(server.url, "/v1/localize/sequence", sequence, chunked=False))
    ]
    found += [("hostile", _against(kinds[number % len(kinds)], server.url)) for number in range(HOSTILE)]
    return found


def _message_to(address: str, path: str, message: memoryview) -> Callable[[], str]:
    return lambda: call(address, path, message, timeout_s=_TIMEOUT_S)


def _against(kind: Callable[[str], str], url: str) -> Callable[[], str]:
    return lambda: kind(url)


def _sent(url: str, path: str, body: memoryview, *, chunked: bool) -> str:
    """Send a POST whose body continues even after an early answer."""
    at = urlsplit(url)
    head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary={_BOUNDARY.decode()}\r\n"
    head += "Transfer-Encoding: chunked\r\n\r\n" if chunked else f"Content-Length: {len(body)}\r\n\r\n"
    try:
        with socket.create_connection((at.hostname, at.port), timeout=_TIMEOUT_S) as connection:
            connection.sendall(head.encode())
            with suppress(ConnectionResetError, BrokenPipeError):  # the request was refused; the answer says so
                _send_body(connection, body, chunked=chunked)
            return (
                connection.recv(200).split(b"\r\n")[0].decode("ascii", "replace").removeprefix("HTTP/1.1 ") or "closed"
            )
    except OSError as error:
        return type(error).__name__


def _send_body(connection: socket.socket, body: memoryview, *, chunked: bool) -> None:
    if not chunked:
        connection.sendall(body)
        return
    for start in range(0, len(body), 2**20):
        piece = body[start : start + 2**20]
        connection.sendall(f"{len(piece):x}\r\n".encode())
        connection.sendall(piece)
        connection.sendall(b"\r\n")
    connection.sendall(b"0\r\n\r\n")


def _asked(url: str, payload: Payload) -> str:
    try:
        found = httpx.post(
            f"{url}/v1/localize", content=payload.body, headers={"Content-Type": payload.content_type}, timeout=60
        )
    except httpx.HTTPError as error:
        return type(error).__name__
    return str(found.status_code)


def _large_body() -> bytes:
    """Make a body of the largest size with complete images: 3200 x 3200 pixels of noise, which does not compress."""
    rng = np.random.default_rng(0)
    rgb = _png(rng.integers(0, 256, (_SIDE, _SIDE, 3), np.uint8))
    depth = _png(rng.integers(2000, 20_000, (_SIDE // 2, _SIDE // 2), np.uint16))
    parts = {"rgb": rgb, "depth": depth, "request": json.dumps({"camera": _CAMERA}).encode()}
    body = _multipart(parts)
    return _multipart(parts | {"request": parts["request"] + b" " * (LARGE_BYTES - len(body))})


def _large_message() -> bytes:
    """Make the same for gRPC, padded with bytes of an unknown field."""
    rng = np.random.default_rng(0)
    message = pb.LocalizeRequest(
        rgb=_png(rng.integers(0, 256, (_SIDE, _SIDE, 3), np.uint8)),
        depth=_png(rng.integers(2000, 20_000, (_SIDE // 2, _SIDE // 2), np.uint16)),
    )
    for name, value in _CAMERA.items():
        setattr(message.camera, name, value)
    written = message.SerializeToString()
    left = LARGE_BYTES - 32 - len(written)
    return written + b"\xfa\x7f" + _varint(left) + bytes(left)  # field 2047, type bytes


def _as_frame(message: memoryview) -> bytes:
    """Wrap a message as the frame of a stream's message, which the service answers."""
    number = pb.LocalizeStreamRequest.DESCRIPTOR.fields_by_name["frame"].number
    return _varint(number << 3 | 2) + _varint(len(message)) + message


def _sequence() -> bytes:
    """Make sixteen frames of 24 million pixels each with one colour and one depth: 4 KiB to 100 KiB as files."""
    width, height = 6000, 4000
    rgb, depth = _png(np.full((height, width, 3), 90, np.uint8), 9), _png(np.full((height, width), 5000, np.uint16), 9)
    camera = {"width": width, "height": height, "fx": 3000.0, "fy": 3000.0, "cx": 2999.5, "cy": 1999.5}
    moved = {"position": {"x": 0, "y": 0, "z": 1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}
    frames = [{"camera": camera} | ({"T_reference_camera": moved} if number else {}) for number in range(16)]
    parts = {"request": json.dumps({"frames": frames}).encode()}
    for number in range(16):
        parts |= {f"rgb{number}": rgb, f"depth{number}": depth}
    return _multipart(parts)


def _multipart(parts: dict[str, bytes]) -> bytes:
    head = b'--%s\r\nContent-Disposition: form-data; name="%s"; filename="%s"\r\n\r\n'
    pieces = [head % (_BOUNDARY, name.encode(), name.encode()) + content + b"\r\n" for name, content in parts.items()]
    return b"".join(pieces) + b"--" + _BOUNDARY + b"--\r\n"


def _png(pixels: np.ndarray, level: int = 0) -> bytes:
    return bytes(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, level])[1])


def _varint(value: int) -> bytes:
    found = bytearray()
    while value >= 0x80:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def _good_parts(body: bytes, content_type: str) -> dict[str, bytes]:
    """Return the parts of a request that the service answers."""
    delimiter = b"--" + content_type.partition("boundary=")[2].encode()
    found: dict[str, bytes] = {}
    for piece in body.split(delimiter)[1:-1]:
        head, _, content = piece.partition(b"\r\n\r\n")
        found[head.partition(b'name="')[2].partition(b'"')[0].decode()] = content[:-2]
    return found
