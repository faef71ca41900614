"""One gRPC call in raw HTTP/2 frames of shared bytes, so that a hundred callers with large messages need little memory."""

import socket
import struct

_PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
_DATA, _HEADERS, _RST, _SETTINGS, _PING, _GOAWAY, _WINDOW = 0, 1, 3, 4, 6, 7, 8
_END_STREAM, _END_HEADERS, _ACK = 1, 4, 1
_FRAME = 16_384


def call(address: str, path: str, message: memoryview, *, timeout_s: float) -> str:
    """Send a message as fast as the server's windows allow.

    Args:
        address: ``host:port``.
        path: path of the call, ``/package.Service/Method``.
        message: bytes of the message; they need not be valid protobuf.
        timeout_s: limit of the whole call, seconds.

    Returns:
        How it ended: ``answered`` (with whatever status), ``reset``, ``closed`` or ``late``, and the MiB that were
            sent.
    """
    host, _, port = address.rpartition(":")
    sent = 0
    try:
        with socket.create_connection((host, int(port)), timeout=timeout_s) as connection:
            connection.settimeout(timeout_s)
            headers = b"".join(
                _literal(name, value)
                for name, value in (
                    (b":method", b"POST"),
                    (b":scheme", b"http"),
                    (b":path", path.encode()),
                    (b":authority", b"localhost"),
                    (b"te", b"trailers"),
                    (b"content-type", b"application/grpc"),
                )
            )
            connection.sendall(_PREFACE + _frame(_SETTINGS, 0, 0, b"") + _frame(_HEADERS, _END_HEADERS, 1, headers))
            windows = {0: 65_535, 1: 65_535}
            body = [memoryview(b"\x00" + struct.pack(">I", len(message))), message]
            while body:
                room = min(*windows.values(), _FRAME, len(body[0]))
                if room <= 0 or _waiting(connection):
                    if ended := _read(connection, windows):
                        return f"{ended} after {sent >> 20} MiB"
                    continue
                piece, body[0] = body[0][:room], body[0][room:]
                if not body[0]:
                    body.pop(0)
                flags = 0 if body else _END_STREAM
                connection.sendall(_head(_DATA, flags, 1, len(piece)))
                connection.sendall(piece)
                sent += len(piece)
                for stream in windows:
                    windows[stream] -= len(piece)
            while True:
                if ended := _read(connection, windows):
                    return f"{ended} after {sent >> 20} MiB"
    except TimeoutError:
        return f"late after {sent >> 20} MiB"
    except OSError:
        return f"closed after {sent >> 20} MiB"


def _read(connection: socket.socket, windows: dict[int, int]) -> str:
    """Read one frame; return how the call ended, or nothing."""
    length, kind, flags, stream = struct.unpack(">IBBI", b"\x00" + _exactly(connection, 9))
    payload = _exactly(connection, length)
    if kind == _WINDOW and stream in windows:
        windows[stream] += struct.unpack(">I", payload)[0] & 0x7FFFFFFF
    elif kind == _SETTINGS and not flags & _ACK:
        for at in range(0, length, 6):
            name, value = struct.unpack_from(">HI", payload, at)
            if name == 4:  # applies to existing streams too
                windows[1] += value - 65_535
        connection.sendall(_frame(_SETTINGS, _ACK, 0, b""))
    elif kind == _PING and not flags & _ACK:
        connection.sendall(_frame(_PING, _ACK, 0, payload))
    elif kind in (_DATA, _HEADERS) and flags & _END_STREAM:
        return "answered"
    elif kind in (_RST, _GOAWAY):
        return "reset"
    return ""


def _waiting(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        return bool(connection.recv(1, socket.MSG_PEEK))
    except BlockingIOError:
        return False
    finally:
        connection.settimeout(30)


def _exactly(connection: socket.socket, count: int) -> bytes:
    found = bytearray()
    while len(found) < count:
        piece = connection.recv(count - len(found))
        if not piece:
            raise ConnectionResetError("closed")
        found += piece
    return bytes(found)


def _literal(name: bytes, value: bytes) -> bytes:
    """Encode a header as an HPACK literal that no table holds."""
    return b"\x00" + bytes([len(name)]) + name + bytes([len(value)]) + value


def _head(kind: int, flags: int, stream: int, length: int) -> bytes:
    return struct.pack(">IBBI", length, kind, flags, stream)[1:]


def _frame(kind: int, flags: int, stream: int, payload: bytes) -> bytes:
    return _head(kind, flags, stream, len(payload)) + payload
