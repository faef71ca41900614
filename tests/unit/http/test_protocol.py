"""Limits that httptools lacks, over real sockets: uvicorn with our protocol and an application that reads the body."""

import asyncio
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import uvicorn

from service.http import protocol
from service.http.protocol import HEAD_BYTES, PIPELINED, BoundedHttp

Connect = Callable[[], socket.socket]


async def length_of_body(scope: Any, receive: Any, send: Any) -> None:
    length, more = 0, scope["path"] != "/refused"
    while more:
        message = await receive()
        length, more = length + len(message.get("body", b"")), message.get("more_body", False)
    if scope["path"] == "/slow":
        await asyncio.sleep(0.5)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"8")]})
    await send({"type": "http.response.body", "body": b"%8d" % length})


@pytest.fixture
def connect(monkeypatch: pytest.MonkeyPatch) -> Iterator[Connect]:
    monkeypatch.setattr(protocol, "HEAD_SECONDS", 0.5)
    monkeypatch.setattr(protocol, "LINGER_SECONDS", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = uvicorn.Server(uvicorn.Config(length_of_body, http=BoundedHttp, lifespan="off", log_config=None))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        opened: list[socket.socket] = []

        def open_one() -> socket.socket:
            opened.append(socket.create_connection(listener.getsockname(), timeout=10))
            return opened[-1]

        yield open_one
        for each in opened:
            each.close()
        server.should_exit = True
        thread.join()


def told(connection: socket.socket) -> bytes:
    """Return all bytes until the service closes the connection."""
    found = b""
    try:
        while piece := connection.recv(65536):
            found += piece
    except ConnectionResetError:
        pass
    return found


def answers(connection: socket.socket, count: int) -> list[bytes]:
    """Return status and body of each of the next answers."""
    found = b""
    while len(each := found.split(b"HTTP/1.1 ")[1:]) < count or len(each[-1].partition(b"\r\n\r\n")[2]) < 8:
        piece = connection.recv(65536)
        assert piece, found
        found += piece
    return [answer[:3] + b" " + answer.partition(b"\r\n\r\n")[2].strip() for answer in each]


def first(connection: socket.socket) -> bytes:
    """Return the next answer."""
    return answers(connection, 1)[0]


def send_endlessly(connection: socket.socket, piece: bytes, times: int) -> None:
    try:
        for _ in range(times):
            connection.sendall(piece)
    except OSError:  # it has been closed, as it should
        pass


def test_bodies_come_whole_and_connections_are_kept(connect: Connect) -> None:
    connection = connect()
    for size in (0, 3, 300_000, 200_000, 1, 0, 300_000):
        connection.sendall(b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % size + bytes(size))
        assert first(connection) == b"200 %d" % size


def test_a_chunked_body_of_many_small_chunks_is_a_body(connect: Connect) -> None:
    connection, chunk = connect(), b"40\r\n" + bytes(64) + b"\r\n"
    connection.sendall(
        b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n" + 3000 * chunk + b"0\r\n\r\n"
    )
    assert first(connection) == b"200 192000"


@pytest.mark.parametrize("piece", [b"X-A: a\r\n", b"a" * 1000, b"\r\n"], ids=["headers", "one header", "empty lines"])
def test_a_head_without_end_is_refused(connect: Connect, piece: bytes) -> None:
    connection = connect()
    connection.sendall(b"" if piece == b"\r\n" else b"GET / HTTP/1.1\r\nHost: x\r\nX-B: ")
    send_endlessly(connection, piece, 20 * HEAD_BYTES // len(piece))
    assert told(connection)[:12] in {b"HTTP/1.1 400", b""}  # what it still had to read may have cut the answer off
    assert first_of_another(connect) == b"200 0"


def first_of_another(connect: Connect) -> bytes:
    connection = connect()
    connection.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
    return first(connection)


def test_a_head_just_within_the_limit_is_read(connect: Connect) -> None:
    connection, head = connect(), b"GET / HTTP/1.1\r\nHost: x\r\nX-A: "
    filler = HEAD_BYTES - len(head) - 4
    connection.sendall(head + b"a" * filler + b"\r\n\r\n")
    assert first(connection) == b"200 0"


@pytest.mark.parametrize("piece", [b"0" * 100, b"X-T: " + b"a" * 95], ids=["chunk size", "trailer"])
def test_frames_of_a_chunked_body_without_end_close_it(connect: Connect, piece: bytes) -> None:
    connection = connect()
    start = b"" if piece.startswith(b"0") else b"0\r\n"
    connection.sendall(b"POST / HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n" + start)
    began = time.monotonic()
    send_endlessly(connection, piece, 100_000)
    assert b" 200 " not in told(connection)
    assert time.monotonic() - began < 60
    assert first_of_another(connect) == b"200 0"


def test_requests_sent_ahead_are_answered_in_order_up_to_a_number(
    connect: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    one = b"POST /slow HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n%s"
    few, many = connect(), connect()
    few.sendall(b"".join(one % (length, bytes(length)) for length in (1, 2, 3)))
    assert answers(few, 3) == [b"200 1", b"200 2", b"200 3"]
    many.sendall((PIPELINED + 2) * (one % (3, b"abc")))
    assert b" 200 " not in told(many)
    assert first_of_another(connect) == b"200 0"
    assert not [record for record in caplog.records if record.levelname == "ERROR"]


@pytest.mark.parametrize("sent", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: x\r\n"], ids=["nothing", "line", "half"])
def test_a_head_that_does_not_come_ends_the_connection(connect: Connect, sent: bytes) -> None:
    connection = connect()
    connection.sendall(sent)
    assert told(connection) == b""


def test_a_slow_answer_is_not_cut_off_by_the_heads_timer(connect: Connect) -> None:
    connection = connect()
    for _ in range(2):
        connection.sendall(b"GET /slow HTTP/1.1\r\nHost: x\r\n\r\n")
        time.sleep(0.1)
        connection.sendall(b"GET /slow HT")  # the next one's head begins while this one is answered
        assert first(connection) == b"200 0"
        connection.sendall(b"TP/1.1\r\nHost: x\r\n\r\n")
        assert first(connection) == b"200 0"


def test_the_rest_of_a_small_body_that_was_answered_early_is_read_and_the_connection_goes_on(connect: Connect) -> None:
    connection, size = connect(), 2**19
    connection.sendall(b"POST /refused HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % size)
    assert first(connection) == b"200 0"
    connection.sendall(bytes(size))
    connection.sendall(b"POST / HTTP/1.1\r\nHost: x\r\nContent-Length: 3\r\n\r\nabc")
    assert first(connection) == b"200 3"


def test_a_large_body_that_was_answered_early_is_not_read_and_its_sender_still_gets_the_answer(
    connect: Connect,
) -> None:
    connection, size = connect(), 2**28
    connection.settimeout(30)
    connection.sendall(b"POST /refused HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % size)
    sent = 0
    try:
        for _ in range(2**8):
            connection.sendall(bytes(2**20))
            sent += 2**20
    except OSError:
        pass
    assert sent < size / 4
    assert b"HTTP/1.1 200 OK" in told(connection)
