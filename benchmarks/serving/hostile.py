"""Twenty-one kinds of hostile request at once: their cost, and whether other clients are still served."""

import json
import socket
import struct
import threading
import time
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from urllib.parse import urlsplit

import httpx
import numpy as np

from benchmarks.report import Report
from benchmarks.serving.fire import asking
from benchmarks.serving.machines import Server
from benchmarks.serving.ratios import Site

SECONDS, AT_ONCE = 30.0, 40
_CAMERA = {"width": 640, "height": 480, "fx": 320.0, "fy": 320.0, "cx": 319.5, "cy": 239.5}
_REQUEST = json.dumps({"camera": _CAMERA}).encode()


def hostile_rows(report: Report, site: Site, *, core: int | None) -> None:
    """Add rows of memory growth and of failed requests of other clients; note the response to each kind.

    Args:
        report: collects the rows.
        site: map and queries.
        core: core of the server; None for all.
    """
    sent = site.payloads(refine=True)
    good = {"rgb": part_of(sent[0].body, b"rgb"), "depth": part_of(sent[0].body, b"depth"), "request": _REQUEST}
    kinds = hostile_kinds(good)
    with Server(site.bundle, core=core, request_timeout_s=10) as server:
        with asking(server.url, sent[:2]) as (answers, failed):
            time.sleep(5)
            idle, peak, over = server.used.resident_mib, [0.0], threading.Event()

            def watch() -> None:
                while not over.wait(0.05):
                    peak[0] = max(peak[0], server.used.resident_mib)

            watcher = threading.Thread(target=watch)
            watcher.start()
            told: dict[str, set[str]] = {name: set() for name in kinds}
            until = time.monotonic() + SECONDS

            def attack(number: int) -> None:
                names = list(kinds)
                while time.monotonic() < until:
                    name = names[number % len(names)]
                    told[name].add(kinds[name](server.url))
                    number += AT_ONCE // 2 + 1

            with ThreadPoolExecutor(AT_ONCE) as pool:
                list(pool.map(attack, range(AT_ONCE)))
            over.set()
            watcher.join()
        lives = httpx.get(f"{server.url}/livez", timeout=10).status_code == 200
    report.notes["hostile"] = {name: sorted(each) for name, each in sorted(told.items())}
    report.row("hostile.kinds", len(kinds), "count")
    report.row("hostile.peak_mib", peak[0] - idle, "MiB", bar=200, better="lower", n=len(kinds))
    report.row(
        "hostile.healthy_requests_failed",
        len(failed) + (not lives),
        "count",
        bar=0,
        better="lower",
        n=len(answers) + len(failed),
        why=f"first: {failed[0]}" if failed else None,
    )


def hostile_kinds(good: dict[str, bytes]) -> dict[str, Callable[[str], str]]:
    """Return the kinds by name; each is a function that sends its request once and returns the response in words.

    Args:
        good: parts of a valid request by name.
    """

    def parts(**changed: bytes) -> Callable[[str], str]:
        return lambda url: _post(url, good | changed)

    deep = b"[" * 200_000
    huge = _png(60_000, 60_000, 16, 0)
    return {
        "png_bomb_depth": parts(depth=huge),
        "png_bomb_colour": parts(rgb=_png(60_000, 60_000, 8, 2)),
        "png_inflates_beyond_its_header": parts(depth=_png(64, 48, 16, 0, rows=200 * 2**20)),
        "jpeg_lies_about_size": parts(rgb=_lying_jpeg(good["rgb"])),
        "npy_lies_about_shape": parts(depth=_npy((40_000, 40_000))),
        "npy_header_without_end": parts(depth=b"\x93NUMPY\x01\x00" + b"\xff\xff" + b"{" * 60_000),
        "raw16_bomb": parts(depth=b"SFD1" + struct.pack("<II", 4096, 4096) + _zstd_bomb()),
        "raw16_lies_about_size": parts(depth=b"SFD1" + struct.pack("<II", 2**31 - 1, 2**31 - 1) + b"\x28\xb5\x2f\xfd"),
        "tiff_of_a_gigabyte": parts(depth=_tiff(16_000, 16_000)),
        "tiff_directory_loop": parts(depth=b"II*\x00\x08\x00\x00\x00" + b"\xff\xff" + bytes(200)),
        "deep_json": parts(request=deep),
        "long_numbers": parts(request=b'{"camera": {"width": ' + b"9" * 300_000 + b"}}"),
        "many_fields": parts(request=json.dumps({f"k{n}": n for n in range(50_000)}).encode()),
        "thousand_parts": lambda url: _post(url, {f"p{n}": b"x" for n in range(5000)}),
        "half_a_multipart": lambda url: _raw(url, b"--b\r\n" + b"x" * 2**20, "multipart/form-data; boundary=b"),
        "boundary_everywhere": lambda url: _raw(url, b"--b\r\n" * 200_000, "multipart/form-data; boundary=b"),
        "too_many_bytes": lambda url: _announce(url, 2**40),
        "slow_sender": _slow,
        "body_never_comes": lambda url: _announce(url, 1000, wait_s=3.0),
        "headers_without_end": _endless_headers,
        "noise": lambda url: _raw(url, np.random.default_rng(0).bytes(2**20), "multipart/form-data; boundary=b"),
    }


def _post(url: str, parts: dict[str, bytes]) -> str:
    return _told(lambda: httpx.post(f"{url}/v1/localize", files={n: (n, d) for n, d in parts.items()}, timeout=60))


def _raw(url: str, body: bytes, content_type: str) -> str:
    return _told(
        lambda: httpx.post(f"{url}/v1/localize", content=body, headers={"Content-Type": content_type}, timeout=60)
    )


def _told(ask: Callable[[], httpx.Response]) -> str:
    try:
        found = ask()
    except httpx.HTTPError as error:
        return type(error).__name__
    problem = found.json().get("code", "") if "problem" in found.headers.get("content-type", "") else ""
    return f"{found.status_code} {problem}".strip()


def _connected(url: str) -> socket.socket:
    at = urlsplit(url)
    return socket.create_connection((at.hostname, at.port), timeout=60)


def _first_line(connection: socket.socket) -> str:
    try:
        return connection.recv(200).split(b"\r\n")[0].decode("ascii", "replace").removeprefix("HTTP/1.1 ")
    except OSError as error:
        return type(error).__name__


def _announce(url: str, length: int, *, wait_s: float = 0.0) -> str:
    with _connected(url) as connection:
        connection.sendall(
            b"POST /v1/localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
            + f"Content-Length: {length}\r\n\r\n".encode()
        )
        if wait_s:
            time.sleep(wait_s)
            return "left"
        return _first_line(connection)


def _slow(url: str) -> str:
    """Send a byte per second until the service refuses."""
    with _connected(url) as connection:
        connection.sendall(
            b"POST /v1/localize HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=b\r\n"
            b"Content-Length: 1000\r\n\r\n"
        )
        connection.settimeout(1.0)
        for _ in range(15):
            try:
                if told := connection.recv(200):
                    return told.split(b"\r\n")[0].decode("ascii", "replace").removeprefix("HTTP/1.1 ")
                return "closed"
            except TimeoutError:
                try:
                    connection.sendall(b"-")
                except OSError as error:
                    return type(error).__name__
            except OSError as error:
                return type(error).__name__
    return "left"


def _endless_headers(url: str) -> str:
    with _connected(url) as connection:
        try:
            connection.sendall(b"GET /livez HTTP/1.1\r\nHost: localhost\r\n")
            for _ in range(64):
                connection.sendall(b"X-A: " + b"a" * 65_536 + b"\r\n")
        except OSError:
            pass
        return _first_line(connection)


def part_of(body: bytes, name: bytes) -> bytes:
    """Return the content of a part of a body that we made.

    Args:
        body: multipart body.
        name: name of the part.
    """
    start = body.index(b"\r\n\r\n", body.index(b'name="' + name + b'"')) + 4
    boundary = body[: body.index(b"\r\n")]
    return body[start : body.index(b"\r\n" + boundary, start)]


def _png(width: int, height: int, bits: int, colour: int, *, rows: int = 2**22) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer = zlib.compressobj(9)
    packed = b"".join(packer.compress(bytes(2**20)) for _ in range(rows // 2**20)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def _lying_jpeg(data: bytes) -> bytes:
    at = max(data.find(b"\xff\xc0"), data.find(b"\xff\xc2"))
    return data[: at + 5] + struct.pack(">HH", 65_000, 65_000) + data[at + 9 :]


def _npy(shape: tuple[int, int]) -> bytes:
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}".ljust(117).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(1000)


def _zstd_bomb() -> bytes:
    import zstandard

    return zstandard.ZstdCompressor(level=19).compress(bytes(2**30))


def _tiff(width: int, height: int) -> bytes:
    tags = [
        (256, 4, width),
        (257, 4, height),
        (258, 3, 32),
        (259, 3, 1),
        (262, 3, 1),
        (273, 4, 200),
        (277, 3, 1),
        (278, 4, height),
        (279, 4, 4 * width * height),
        (339, 3, 3),
    ]
    entries = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in tags)
    return b"II*\x00\x08\x00\x00\x00" + struct.pack("<H", len(tags)) + entries + bytes(200)
