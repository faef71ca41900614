"""Allowed hosts and origins: DNS rebinding and foreign pages are refused."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from fastapi.routing import APIRoute

from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.keys import Caller, KeyRing, hash_of
from service.runtime.settings import Settings

AppClient = Callable[[FastAPI], httpx.Client]
OPEN = {"/livez", "/readyz"}


@pytest.fixture
def client_with(bundle_path: Path, app_client: AppClient) -> Iterator[Callable[..., httpx.Client]]:
    opened: list[Engine] = []

    def make(keys: KeyRing | None = None, **settings: Any) -> httpx.Client:
        opened.append(Engine.open(Settings(maps=(bundle_path,), threads=1, **settings)))
        return app_client(create_app(opened[-1], keys))

    yield make
    for engine in opened:
        engine.close()


@pytest.fixture(scope="module")
def listed(bundle_path: Path, app_client: AppClient) -> Iterator[httpx.Client]:
    """A client of a service that lists a name. One is enough: to open a map takes longer than what is asked here."""
    engine = Engine.open(Settings(maps=(bundle_path,), threads=1, allowed_hosts=("maps.example",)))
    yield app_client(create_app(engine))
    engine.close()


def routes_of(app: FastAPI) -> set[tuple[str, str]]:
    """Return method and path of all routes, in the contract and beside it."""
    document = app.openapi()
    found = {(method.upper(), path) for path, methods in document["paths"].items() for method in methods}
    hidden = {("GET", "/console"), ("GET", "/console/"), ("GET", "/openapi.json"), ("POST", "/nowhere")}
    for route in app.routes:
        if isinstance(route, APIRoute):
            found |= {(method, route.path) for method in route.methods or ()}
    return found | hidden


def test_a_foreign_host_is_refused_on_every_route_but_those_of_orchestrators(
    engine: Engine, app_client: AppClient
) -> None:
    app = create_app(engine)
    client, asked = app_client(app), routes_of(app)
    assert {("PUT", "/v1/maps/{map}/serving"), ("GET", "/v1/answers"), ("GET", "/metrics")} <= asked
    for method, path in asked:
        answer = client.request(method, path, headers={"Host": "evil.example:8000"})
        if path in OPEN:
            assert answer.status_code == 200
            continue
        assert (answer.status_code, answer.headers["content-type"]) == (403, "application/problem+json"), path
        assert answer.json()["code"] == "forbidden-host"
        assert answer.json()["request_id"] == answer.headers["x-request-id"]


def test_a_page_whose_name_was_made_to_point_here_changes_nothing(client_with: Any) -> None:
    """With DNS rebinding, page and service have the same origin. The browser sends equal names and no CORS request."""
    client = client_with()
    (entry,) = client.get("/v1/maps").json()["maps"]
    page = {"Host": "evil.example:8000", "Origin": "http://evil.example:8000", "Sec-Fetch-Site": "same-origin"}
    refused = client.put("/v1/maps/tiny/serving", json={"version": entry["version"]}, headers=page)
    assert (refused.status_code, refused.json()["code"]) == (403, "forbidden-host")
    assert client.get("/v1/answers", headers=page).status_code == 403


@pytest.mark.parametrize(
    "host",
    [
        "127.0.0.1",
        "127.0.0.1:8000",
        "localhost",
        "LOCALHOST:8000",
        "localhost.",
        "a.localhost",
        "[::1]:8000",
        "[::1]",
        "192.0.2.7:8000",
    ],
)
def test_addresses_and_loopback_names_are_always_ours(engine: Engine, app_client: AppClient, host: str) -> None:
    assert app_client(create_app(engine)).get("/v1/maps", headers={"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "host",
    [
        "",
        "evil.example",
        "127.0.0.1.evil.example",
        "localhost.evil.example",
        "evil.example:127.0.0.1",
        "[::1].evil.example",
        "127.0.0.1@evil.example",
        "evil.example/127.0.0.1",
        "notlocalhost",
        "::1",
        "[evil.example]",
        "localhost:8000:8000",
    ],
)
def test_a_name_that_looks_like_loopback_is_refused(engine: Engine, app_client: AppClient, host: str) -> None:
    assert app_client(create_app(engine)).get("/v1/maps", headers={"Host": host}).status_code == 403


def test_there_must_be_one_host(engine: Engine, app_client: AppClient) -> None:
    client = app_client(create_app(engine))
    two = client.get("/v1/maps", headers=[("Host", "localhost"), ("Host", "evil.example")])
    assert two.status_code == 403
    none = client.build_request("GET", "/v1/maps")
    del none.headers["host"]
    assert client.send(none).status_code == 403


def test_listed_names_are_ours_at_any_port(client_with: Any) -> None:
    client = client_with(allowed_hosts=("maps.example", "*.robots.example"))
    for host, status in (
        ("maps.example", 200),
        ("Maps.Example:443", 200),
        ("a.b.robots.example", 200),
        ("127.0.0.1", 200),
        ("robots.example", 403),
        ("evilrobots.example", 403),
        ("x.maps.example", 403),
    ):
        assert client.get("/v1/maps", headers={"Host": host}).status_code == status, host


def test_with_keys_any_name_will_do_until_names_are_listed(client_with: Any, tmp_path: Path) -> None:
    keys = KeyRing({hash_of("mine"): Caller("me", operator=True)})
    headers = {"Host": "streetfix.cluster.local", "X-Api-Key": "mine"}
    public = {"host": "0.0.0.0", "api_keys": tmp_path / "keys"}  # noqa: S104
    assert client_with(keys, **public).get("/v1/maps", headers=headers).status_code == 200
    assert (
        client_with(keys, **public, allowed_hosts=("maps.example",)).get("/v1/maps", headers=headers).status_code == 403
    )


def test_without_keys_beyond_loopback_names_must_be_listed(client_with: Any) -> None:
    public = {"host": "0.0.0.0", "insecure_public": True}  # noqa: S104
    headers = {"Host": "streetfix:8000"}
    assert client_with(**public).get("/v1/maps", headers=headers).status_code == 403
    assert client_with(**public, allowed_hosts=("streetfix",)).get("/v1/maps", headers=headers).status_code == 200
    assert client_with(**public, allowed_hosts=("*",)).get("/v1/maps", headers=headers).status_code == 200


@pytest.mark.parametrize(
    ("origin", "host", "allowed"),
    [
        ("http://localhost:8000", "localhost:8000", True),
        ("http://[::1]:8000", "[::1]:8000", True),
        ("https://maps.example", "maps.example", True),  # a proxy that speaks TLS and hands the name on
        ("https://maps.example:443", "maps.example", True),
        ("https://maps.example", "127.0.0.1:8000", True),  # a proxy that does not: the name is listed
        ("http://localhost:3000", "localhost:8000", False),
        ("http://127.0.0.1:8000", "localhost:8000", False),
        ("https://evil.example", "localhost:8000", False),
        ("https://maps.example.evil.example", "maps.example", False),
        ("null", "localhost:8000", False),
        ("", "localhost:8000", False),
        ("file://", "localhost:8000", False),
        ("chrome-extension://localhost:8000", "localhost:8000", False),
    ],
)
@pytest.mark.parametrize(
    ("method", "path"),
    [("PUT", "/v1/maps/tiny/serving"), ("POST", "/v1/localize"), ("POST", "/geopose"), ("DELETE", "/v1/maps")],
)
def test_only_pages_of_the_same_origin_or_a_listed_name_may_send_more_than_get(
    listed: httpx.Client, origin: str, host: str, allowed: bool, method: str, path: str
) -> None:
    answer = listed.request(method, path, headers={"Host": host, "Origin": origin}, content=b"{}")
    assert (answer.json()["code"] != "forbidden-origin") == allowed
    assert listed.get("/v1/maps", headers={"Host": host, "Origin": origin}).status_code == 200


def test_the_name_that_a_service_listens_on_is_no_listed_origin(client_with: Any) -> None:
    """A page on another port of this machine belongs to another program."""
    client = client_with(host="localhost")
    headers = {"Host": "localhost:8000", "Origin": "http://localhost:9999"}
    assert (
        client.put("/v1/maps/tiny/serving", headers=headers, json={"version": "x"}).json()["code"] == "forbidden-origin"
    )


def test_a_program_sends_no_origin_and_is_answered(client_with: Any) -> None:
    client = client_with()
    (entry,) = client.get("/v1/maps").json()["maps"]
    assert client.put("/v1/maps/tiny/serving", json={"version": entry["version"]}).status_code == 200
