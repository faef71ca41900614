import re
from collections.abc import Callable, Iterator

import httpx
import pytest

from service.runtime.engine import Engine
from service.runtime.map_registry import MapRegistry, Refused
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
    assert client.get("/readyz").json() == {"status": "ok", "refused": [], "open_tiles": 0, "cached_tiles": 0}


@pytest.fixture
def empty(client_of: Callable[[Engine], httpx.Client]) -> Iterator[tuple[Engine, httpx.Client]]:
    """Return a service without a map."""
    engine = Engine(MapRegistry(), Settings(threads=1))
    yield engine, client_of(engine)
    engine.close()


def test_a_service_without_a_map_lives_and_is_not_ready(
    empty: tuple[Engine, httpx.Client], parts_of: Callable[..., dict[str, bytes]]
) -> None:
    _, client = empty
    assert client.get("/livez").status_code == 200
    assert client.get("/v1/maps").json() == {"maps": []}
    parts = {name: (name, data) for name, data in parts_of().items()}
    for response in (
        client.get("/readyz"),
        client.post("/v1/localize", files=parts),
        client.get("/v1/maps/tiny/streets"),
        client.get("/v1/maps/tiny/places"),
        client.get("/v1/maps/tiny/cloud"),
    ):
        assert (response.status_code, response.json()["code"]) == (503, "not-ready")
        assert "no map is mounted" in response.json()["detail"]
        assert response.headers["retry-after"]


def test_readiness_names_bundles_that_are_not_mounted(
    empty: tuple[Engine, httpx.Client], engine: Engine, client: httpx.Client
) -> None:
    refused = tuple(Refused(f"m{number}", f"m{number}/places.npy: it is damaged") for number in range(25))
    engine.registry.refused = empty[0].registry.refused = refused
    named = client.get("/readyz").json()["refused"]
    assert (len(named), named[0]) == (20, {"bundle": "m0", "reason": "m0/places.npy: it is damaged"})
    assert "m0 is not mounted: m0/places.npy: it is damaged" in empty[1].get("/readyz").json()["detail"]
    engine.registry.refused = ()


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
def test_refusals_of_http_itself_are_problems_too(
    client: httpx.Client, method: str, path: str, status: int, code: str
) -> None:
    response = client.request(method, path)
    problem = response.json()
    assert (response.status_code, problem["code"]) == (status, code)
    assert response.headers["content-type"] == "application/problem+json"
    assert problem["request_id"] == response.headers["x-request-id"]
