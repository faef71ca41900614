import re
from collections.abc import Callable

import httpx
import pytest

from service.runtime.engine import Engine
from service.runtime.map_registry import MapRegistry
from service.runtime.settings import Settings


def test_maps_are_listed_with_version_and_counts(client: httpx.Client, engine: Engine) -> None:
    (entry,) = client.get("/v1/maps").json()["maps"]
    assert entry["version"] == engine.registry.get("tiny").bundle.manifest.version
    assert (entry["name"], entry["places"], entry["views"], entry["streets"]) == ("tiny", 12, 48, 3)


def test_streets_are_geojson(client: httpx.Client) -> None:
    response = client.get("/v1/maps/tiny/streets")
    assert response.headers["content-type"] == "application/geo+json"
    assert [feature["properties"]["id"] for feature in response.json()["features"]] == ["s0", "s1", "s2"]


@pytest.mark.parametrize("name", ["west", "..%2f..%2fetc%2fpasswd", "%00"])
def test_streets_of_an_unknown_map_are_a_problem(client: httpx.Client, name: str) -> None:
    response = client.get(f"/v1/maps/{name}/streets")
    assert response.status_code == 404
    assert response.headers["content-type"] == "application/problem+json"


def test_the_version_says_which_maps_are_served(client: httpx.Client) -> None:
    version = client.get("/v1/version").json()
    assert (version["api"], version["threads"], version["maps"][0]["name"]) == ("v1", 1, "tiny")


def test_a_service_with_a_map_lives_and_is_ready(client: httpx.Client) -> None:
    assert client.get("/livez").json() == {"status": "ok"}
    assert client.get("/readyz").json() == {"status": "ok", "refused": []}


def test_a_service_without_a_map_lives_and_is_not_ready(client_of: Callable[[Engine], httpx.Client]) -> None:
    engine = Engine(MapRegistry(), Settings(threads=1))
    client = client_of(engine)
    assert client.get("/livez").status_code == 200
    response = client.get("/readyz")
    assert (response.status_code, response.json()["code"]) == (503, "not-ready")
    engine.close()


def test_the_contract_is_served(client: httpx.Client) -> None:
    contract = client.get("/openapi.json")
    assert (contract.headers["content-type"], contract.json()["info"]["title"]) == ("application/json", "Streetfix")


def test_no_page_mentions_another_host(client: httpx.Client) -> None:
    known = [path.replace("{name}", "tiny") for path in client.get("/openapi.json").json()["paths"]]
    usual = ["/", "/docs", "/docs/oauth2-redirect", "/redoc", "/console", "/index.html", "/nowhere"]
    pages = {path: client.get(path) for path in [*known, *usual]}
    html = {path: page.text for path, page in pages.items() if "html" in page.headers.get("content-type", "")}
    assert {path: hosts for path, text in html.items() if (hosts := re.findall(r"//[\w.-]+", text))} == {}


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [("GET", "/nowhere", 404, "not-found"), ("GET", "/v1/localize", 405, "method-not-allowed")],
)
def test_what_http_refuses_is_a_problem_too(
    client: httpx.Client, method: str, path: str, status: int, code: str
) -> None:
    response = client.request(method, path)
    problem = response.json()
    assert (response.status_code, problem["code"]) == (status, code)
    assert response.headers["content-type"] == "application/problem+json"
    assert problem["request_id"] == response.headers["x-request-id"]
