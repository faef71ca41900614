"""The version of a map that serves, and who may choose it."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.http.app import create_app
from service.maps.content import BundleContent
from service.maps.writer import write_bundle
from service.runtime.engine import Engine
from service.runtime.keys import Caller, KeyRing, hash_of
from service.runtime.settings import Settings

Parts = Callable[..., dict[str, bytes]]
ClientOf = Callable[..., httpx.Client]
KEYS = KeyRing({hash_of("robot's"): Caller("robot"), hash_of("mine"): Caller("me", operator=True)})


@pytest.fixture(scope="module")
def folder(content_of: Callable[..., BundleContent], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    for seed in range(2):
        write_bundle(folder / f"v{seed}", content_of(seed=seed))
    return folder


@pytest.fixture
def engine_of(folder: Path) -> Iterator[Callable[..., Engine]]:
    opened: list[Engine] = []

    def make(**settings: Any) -> Engine:
        opened.append(Engine.open(Settings(maps=(folder,), threads=1, **settings)))
        return opened[-1]

    yield make
    for engine in opened:
        engine.close()


def versions_of(client: httpx.Client, **headers: str) -> tuple[str, list[str]]:
    (entry,) = client.get("/v1/maps", headers=headers).json()["maps"]
    return entry["version"], entry["versions"]


def test_an_operator_rolls_back_and_forward(engine_of: Any, app_client: Any, parts_of: Parts) -> None:
    client = app_client(create_app(engine_of(), KEYS))
    mine = {"X-Api-Key": "mine"}
    newest, (same, older) = versions_of(client, **mine)
    assert same == newest
    for wanted in (older, newest, older):
        done = client.put("/v1/maps/tiny/serving", json={"version": wanted}, headers=mine)
        assert (done.status_code, done.json()["version"]) == (200, wanted)
        assert versions_of(client, **mine) == (wanted, [newest, older])
        files = {name: (name, data) for name, data in parts_of(map=f"tiny@{newest}").items()}
        assert client.post("/v1/localize", files=files, headers=mine).json()["map"]["version"] == newest


@pytest.mark.parametrize(
    ("key", "status", "code"),
    [(None, 401, "unauthorized"), ("wrong", 401, "unauthorized"), ("robot's", 403, "forbidden")],
)
def test_others_may_not(engine_of: Any, app_client: Any, key: str | None, status: int, code: str) -> None:
    client = app_client(create_app(engine_of(), KEYS))
    before = versions_of(client, **{"X-Api-Key": "mine"})
    headers = {} if key is None else {"X-Api-Key": key}
    refused = client.put("/v1/maps/tiny/serving", json={"version": before[1][1]}, headers=headers)
    assert (refused.status_code, refused.json()["code"]) == (status, code)
    assert versions_of(client, **{"X-Api-Key": "mine"}) == before


def test_without_keys_only_this_machines_users_may(engine_of: Any, app_client: Any) -> None:
    own = app_client(create_app(engine_of()))
    older = versions_of(own)[1][1]
    assert own.put("/v1/maps/tiny/serving", json={"version": older}).status_code == 200
    public = app_client(create_app(engine_of(host="0.0.0.0", insecure_public=True)))  # noqa: S104
    refused = public.put("/v1/maps/tiny/serving", json={"version": older})
    assert (refused.status_code, refused.json()["code"]) == (403, "forbidden")


@pytest.mark.parametrize(
    ("path", "body", "status", "field"),
    [
        ("tiny", {"version": "x"}, 404, "version"),
        ("west", {"version": "x"}, 404, "map"),
        ("tiny", {}, 422, "version"),
        ("tiny", {"version": "x" * 65}, 422, "version"),
        ("tiny", {"version": "x", "more": 1}, 422, "more"),
        ("tiny", {"version": "x" * 5000}, 413, None),
    ],
)
def test_a_bundle_that_cannot_serve_is_reported(
    engine_of: Any, app_client: Any, path: str, body: Any, status: int, field: str
) -> None:
    refused = app_client(create_app(engine_of())).put(f"/v1/maps/{path}/serving", json=body)
    assert (refused.status_code, refused.json()["field"]) == (status, field)
