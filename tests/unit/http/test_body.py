from collections.abc import Callable

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.errors import RequestError, StreetfixError, TooLargeError, UnsupportedFormatError
from service.http.body import split_multipart

TYPE = "multipart/form-data; boundary=XX"


def split(body: bytes, content_type: str = TYPE, *, max_parts: int = 8) -> dict[str, bytes]:
    return split_multipart(bytearray(body), content_type, max_parts=max_parts)


def part(name: str, content: bytes) -> bytes:
    return f'--XX\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n'.encode() + content + b"\r\n"


@given(st.dictionaries(st.sampled_from(["rgb", "depth", "request", "more"]), st.binary(max_size=300), min_size=1))
def test_a_body_from_httpx_is_read_back(parts: dict[str, bytes]) -> None:
    request = httpx.Request("POST", "http://x", files={name: (name, data) for name, data in parts.items()})
    assert split(request.read(), request.headers["content-type"]) == parts


def test_a_part_may_be_empty() -> None:
    assert split(part("a", b"") + b"--XX--\r\n") == {"a": b""}


def test_a_preamble_is_passed_over() -> None:
    assert split(b"hello\r\n" + part("a", b"1") + b"--XX--") == {"a": b"1"}


def test_a_quoted_boundary_is_read() -> None:
    assert split(part("a", b"1") + b"--XX--", 'multipart/form-data; boundary="XX"') == {"a": b"1"}


def test_a_boundary_inside_a_line_is_content() -> None:
    assert split(part("a", b"1--XX2") + b"--XX--") == {"a": b"1--XX2"}


@pytest.mark.parametrize("content_type", ["", "application/json", "multipart/mixed; boundary=XX"])
def test_another_content_type_is_unsupported(content_type: str) -> None:
    with pytest.raises(UnsupportedFormatError, match="send multipart/form-data"):
        split(b"", content_type)


@pytest.mark.parametrize(
    "content_type",
    [
        "multipart/form-data",
        "multipart/form-data; boundary=",
        f"multipart/form-data; boundary={'x' * 71}",
        "multipart/form-data; boundary*=utf-8''XX",
    ],
)
def test_a_content_type_without_a_valid_boundary_is_refused(content_type: str) -> None:
    with pytest.raises(RequestError, match="no valid boundary"):
        split(part("a", b"1") + b"--XX--", content_type)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (b"", "ends before"),
        (b"no boundary at all", "ends before"),
        (part("a", b"1"), "ends before"),
        (b"--XX", "ends before"),
        (b"--XXsurplus\r\n\r\n\r\n--XX--", "a boundary must end its line, but text follows"),
        (b"--XX\r\nno headers\r\n--XX--", "no headers"),
        (b"--XX\r\nContent-Type: x\r\n\r\n1\r\n--XX--", "no header Content-Disposition"),
        (b"--XX\r\nContent-Disposition: form-data\r\n\r\n1\r\n--XX--", "'form-data' is not form-data with a name"),
        (b'--XX\r\nContent-Disposition: attachment; name="a"\r\n\r\n1\r\n--XX--', "is not form-data with a name"),
        (b"--XX\r\nX: " + b"x" * 5000 + b"\r\n\r\n1\r\n--XX--", "no headers"),
        (part("a", b"1") + part("a", b"2") + b"--XX--", "occurs twice"),
    ],
)
def test_a_malformed_body_is_refused(body: bytes, message: str) -> None:
    with pytest.raises(RequestError, match=message):
        split(body)


def test_more_parts_than_the_limit_are_refused() -> None:
    body = b"".join(part(f"p{n}", b"") for n in range(5)) + b"--XX--"
    with pytest.raises(TooLargeError, match="more than 4 parts"):
        split(body, max_parts=4)


@given(st.binary(max_size=200), st.integers(0, 250))
def test_no_body_raises_anything_but_our_errors(noise: bytes, at: int) -> None:
    good = part("a", b"1") + part("b", b"2") + b"--XX--\r\n"
    spoiled: Callable[[], dict[str, bytes]] = lambda: split(good[:at] + noise + good[at:])  # noqa: E731
    try:
        spoiled()
    except StreetfixError:
        return
