"""The routes of the console: their answers, their access rules, and the setting that disables them."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.keys import Caller, KeyRing, hash_of
from service.runtime.settings import Settings

Parts = Callable[..., dict[str, bytes]]


@pytest.fixture(scope="module")
def samples(parts_of: Parts, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("samples")
    parts = parts_of()
    (folder / "one").mkdir()
    for name, part in {"rgb.png": "rgb", "depth.npy": "depth", "request.json": "request"}.items():
        (folder / "one" / name).write_bytes(parts[part])
    return folder


@pytest.fixture(scope="module")
def engine(bundle_path: Path, samples: Path) -> Iterator[Engine]:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, samples=samples))
    yield engine
    engine.close()


@pytest.fixture(scope="module")
def client(engine: Engine, client_of: Callable[[Engine], httpx.Client]) -> httpx.Client:
    return client_of(engine)


@pytest.fixture(scope="module")
def guarded(engine: Engine, app_client: Callable[[FastAPI], httpx.Client]) -> httpx.Client:
    keys = KeyRing({hash_of("plain"): Caller("robot"), hash_of("high"): Caller("chief", operator=True)})
    return app_client(create_app(engine, keys))


def test_the_page_comes_with_a_strict_policy(client: httpx.Client) -> None:
    page = client.get("/console/")
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    assert page.headers["content-security-policy"].startswith("default-src 'none'; script-src 'self';")
    assert (page.headers["x-content-type-options"], page.headers["cache-control"]) == ("nosniff", "no-cache")


def test_the_address_without_a_slash_leads_to_the_page_whatever_lies_before_it(client: httpx.Client) -> None:
    moved = client.get("/console")
    assert (moved.status_code, moved.headers["location"]) == (308, "console/")


def test_the_root_leads_to_the_page(client: httpx.Client, guarded: httpx.Client) -> None:
    for each in (client, guarded):
        moved = each.get("/")
        assert (moved.status_code, moved.headers["location"]) == (307, "console/")


def test_a_file_that_was_not_changed_is_not_sent_again(client: httpx.Client) -> None:
    etag = client.get("/console/").headers["etag"]
    again = client.get("/console/", headers={"If-None-Match": etag})
    assert (again.status_code, again.content) == (304, b"")


def test_files_are_sent_compressed_to_those_who_take_it(client: httpx.Client) -> None:
    plain = client.get("/console/", headers={"Accept-Encoding": "identity"})
    small = client.get("/console/", headers={"Accept-Encoding": "gzip"})
    assert (small.headers["content-encoding"], "content-encoding" in plain.headers) == ("gzip", False)
    assert small.content == plain.content


@pytest.mark.parametrize("name", ["nowhere.js", "..%2f..%2fpyproject.toml", "%2e%2e/page.py", "assets/", "built.json"])
def test_nothing_but_the_built_files_is_there(client: httpx.Client, name: str) -> None:
    response = client.get(f"/console/{name}")
    assert (response.status_code, response.json()["code"]) == (404, "not-found")


def test_cloud_and_places_are_binary(client: httpx.Client) -> None:
    cloud, places = client.get("/v1/maps/tiny/cloud?points=50000"), client.get("/v1/maps/tiny/places")
    assert (cloud.content[:4], places.content[:4]) == (b"SFC1", b"SFP1")
    assert cloud.headers["content-type"] == "application/octet-stream"


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/v1/maps/west/cloud", 404),
        ("/v1/maps/west/places", 404),
        ("/v1/maps/tiny/cloud?points=0", 422),
        ("/v1/maps/tiny/cloud?points=9999999", 422),
        ("/v1/samples/two/rgb", 404),
        ("/v1/samples/one/request", 422),
        ("/v1/answers?most=0", 422),
    ],
)
def test_an_invalid_path_or_parameter_is_a_problem(client: httpx.Client, path: str, status: int) -> None:
    response = client.get(path)
    assert (response.status_code, response.headers["content-type"]) == (status, "application/problem+json")


def test_samples_are_listed_and_sent(client: httpx.Client, parts_of: Parts) -> None:
    (sample,) = client.get("/v1/samples").json()["samples"]
    rgb, depth = (client.get(f"/v1/{sample[part]}") for part in ("rgb", "depth"))
    assert (rgb.headers["content-type"], rgb.content) == ("image/png", parts_of()["rgb"])
    files = {"rgb": rgb.content, "depth": depth.content, "request": json.dumps(sample["request"]).encode()}
    explained = client.post("/v1/explain", files=files).json()
    assert explained["answer"]["neighbours"][0]["place"] == 8
    assert explained["points"]["count"] > 1000


def test_an_explanation_is_refused_as_an_answer_is(client: httpx.Client, parts_of: Parts) -> None:
    parts = parts_of() | {"depth": b"no picture"}
    refused = client.post("/v1/explain", files=parts)
    assert (refused.status_code, refused.json()["field"]) == (415, "depth")


def test_the_last_answers_hold_figures_alone(client: httpx.Client, parts_of: Parts) -> None:
    client.post("/v1/localize", files=parts_of())
    newest = client.get("/v1/answers?most=1").json()["answers"]
    assert len(newest) == 1
    assert set(newest[0]) == {
        "number",
        "at",
        "map",
        "status",
        "confidence",
        "street",
        "position",
        "heading_deg",
        "frames",
        "total_ms",
    }
    assert newest[0]["street"] == "End of street 2"


def test_the_page_needs_no_key_and_what_it_shows_does(guarded: httpx.Client) -> None:
    assert guarded.get("/console/").status_code == 200
    for path in ("/v1/maps", "/v1/maps/tiny/cloud", "/v1/maps/tiny/places", "/v1/samples", "/v1/answers", "/consoles"):
        assert guarded.get(path).status_code == 401, path
    assert guarded.post("/v1/explain").status_code == 401
    assert guarded.get("/v1/maps/tiny/cloud", headers={"X-Api-Key": "plain"}).status_code == 200


def test_where_robots_are_is_for_operators(guarded: httpx.Client) -> None:
    refused = guarded.get("/v1/answers", headers={"X-Api-Key": "plain"})
    assert (refused.status_code, refused.json()["code"]) == (403, "forbidden")
    assert guarded.get("/v1/answers", headers={"X-Api-Key": "high"}).status_code == 200


def test_switched_off_nothing_of_it_is_there_and_no_answer_is_kept(
    bundle_path: Path, client_of: Callable[[Engine], httpx.Client], parts_of: Parts
) -> None:
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, console=False))
    client = client_of(engine)
    for path in ("/console", "/console/", "/v1/maps/tiny/cloud", "/v1/samples", "/v1/answers"):
        assert client.get(path).status_code == 404, path
    moved = client.get("/")
    assert (moved.status_code, moved.headers["location"]) == (307, "docs")
    assert client.get("/docs").status_code == 200
    assert client.post("/v1/localize", files=parts_of()).status_code == 200
    assert engine.last_answers.newest(5) == []
    engine.close()
