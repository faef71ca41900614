import io
import json
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from rich.console import Console

from service.cli.answer_text import print_answer
from service.cli.localize import localize
from service.errors import RefusedError, RequestError, UnreachableError

ANSWER: dict[str, Any] = {
    "status": "LOCALIZED",
    "confidence": None,
    "street": {"id": "s2", "name": "End of street 4", "street": "4", "section": "end", "class_index": 6, "vote": 0.8},
    "pose": {"position": {"x": 1.234, "y": 5, "z": 1.5}, "orientation": {}, "heading_deg": 90.4, "covariance": None},
    "vehicle_pose": None,
    "geopose": None,
    "neighbours": [
        {"place": 8, "distance": 0.1, "similarity": 0.995, "street": None, "position": {"x": 1, "y": 2, "z": 3},
         "heading_deg": 90.0},
    ],
    "map": {"name": "tiny", "version": "0123456789abcdef"},
    "timings_ms": {"decode": 1.0, "total": 2.0},
}  # fmt: skip


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    for name, data in {"rgb": b"r", "depth": b"d", "camera": b'{"camera": {}, "map": "a"}'}.items():
        (tmp_path / name).write_bytes(data)
    return {name: tmp_path / name for name in ("rgb", "depth", "camera")}


@pytest.fixture
def answering(monkeypatch: pytest.MonkeyPatch) -> Callable[[httpx.Response], list[dict[str, Any]]]:
    """Answer every post with a response; what was posted is in the list."""

    def put(response: httpx.Response) -> list[dict[str, Any]]:
        posted: list[dict[str, Any]] = []

        def post(_client: httpx.Client, url: str, **given: Any) -> httpx.Response:
            posted.append({"url": url} | given)
            return response

        monkeypatch.setattr(httpx.Client, "post", post)
        return posted

    return put


def test_the_parts_are_posted_with_the_map_of_the_flag(files: dict[str, Path], answering: Callable[..., Any]) -> None:
    posted = answering(httpx.Response(200, json=ANSWER))
    assert localize("http://x:1/", **files, map_name="b") == ANSWER
    assert posted[0]["url"] == "http://x:1/v1/localize"
    assert json.loads(posted[0]["files"]["request"][1]) == {"camera": {}, "map": "b"}


def test_a_problem_is_told_with_field_and_request_id(files: dict[str, Path], answering: Callable[..., Any]) -> None:
    problem = {"title": "T.", "detail": "what and why", "field": "camera.fx", "request_id": "r1"}
    answering(httpx.Response(422, json=problem))
    with pytest.raises(RefusedError) as caught:
        localize("http://x", **files)
    assert caught.value.message == "the service refused: T.\n  what and why [field camera.fx]\n  request id r1"


@pytest.mark.parametrize(
    "response", [httpx.Response(200, text="<html>"), httpx.Response(200, json=[]), httpx.Response(200, json={})]
)
def test_something_else_at_the_address_is_told_so(
    files: dict[str, Path], answering: Callable[..., Any], response: httpx.Response
) -> None:
    answering(response)
    with pytest.raises(UnreachableError, match="no Streetfix; check --url"):
        localize("http://x", **files)


def test_nobody_at_the_address_is_told_with_the_remedy(files: dict[str, Path]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(UnreachableError, match="streetfix serve BUNDLE"):
        localize(f"http://127.0.0.1:{port}", **files)


@pytest.mark.parametrize("url", ["", "localhost:8000", "http://[", "ftp://x"])
def test_an_address_that_is_none_is_told_so(files: dict[str, Path], url: str) -> None:
    with pytest.raises(UnreachableError):
        localize(url, **files)


def test_a_file_that_is_missing_is_named(files: dict[str, Path]) -> None:
    files["depth"].unlink()
    with pytest.raises(RequestError, match=r"depth: it cannot be read .*check --depth"):
        localize("http://x", **files)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"fx": 1}'])
def test_a_camera_file_that_is_none_is_refused(files: dict[str, Path], text: str) -> None:
    files["camera"].write_text(text)
    with pytest.raises(RequestError, match="camera"):
        localize("http://x", **files)


def test_people_read_street_position_and_neighbours() -> None:
    stream = io.StringIO()
    print_answer(ANSWER, Console(file=stream, width=120))
    text = stream.getvalue()
    for wanted in (
        "LOCALIZED",
        "End of street 4 (80% of the votes)",
        "x 1.23  y 5.00  z 1.50 m",
        "90.4 degrees",
        "0.995",
    ):
        assert wanted in text
