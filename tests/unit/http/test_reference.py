"""``/docs``: the contract as a page that loads nothing from other hosts."""

import re
from collections.abc import Callable

import httpx
import pytest
from fastapi import FastAPI

from service.http.app import create_app
from service.http.reference import page_of
from service.runtime.engine import Engine
from service.runtime.keys import Caller, KeyRing, hash_of

DOCUMENT = {
    "info": {"title": "A <service>", "version": "1", "description": "First.\n\nSecond."},
    "paths": {
        "/v1/ask": {
            "post": {
                "operationId": "ask",
                "summary": "Ask",
                "parameters": [
                    {
                        "name": "map",
                        "in": "query",
                        "required": True,
                        "schema": {"type": "string", "maxLength": 64},
                        "description": "of <b>",
                    }
                ],
                "requestBody": {"content": {"application/json": {"schema": {"$ref": "#/components/schemas/Question"}}}},
                "responses": {
                    "200": {
                        "description": "Good",
                        "content": {"application/json": {"schema": {"type": "array", "items": {"type": "number"}}}},
                    }
                },
            }
        }
    },
    "components": {
        "schemas": {
            "Question": {
                "examples": [{"k": 5}],
                "properties": {
                    "k": {"type": "integer", "minimum": 1, "maximum": 9, "default": 5, "description": "how many"},
                    "kind": {"enum": ["z", "range"]},
                    "near": {"anyOf": [{"$ref": "#/components/schemas/Question"}, {"type": "null"}], "default": None},
                },
                "required": ["kind"],
            }
        }
    },
}


@pytest.fixture(scope="module")
def page(client: httpx.Client) -> httpx.Response:
    return client.get("/docs")


def test_a_document_becomes_tables_whose_text_is_escaped() -> None:
    text = page_of(DOCUMENT)
    assert "<h1>A &lt;service&gt; 1</h1><p>First.</p><p>Second.</p>" in text
    assert '<a href="#ask"><code>POST /v1/ask</code></a> Ask' in text
    assert (
        "<td><code>map</code> (query)</td><td>string</td><td>of &lt;b&gt;; <code>length &lt;= 64</code>; required</td>"
        in text
    )
    assert '<p>Body: <code>application/json</code> <a href="#Question">Question</a></p>' in text
    assert "<td>200</td><td><code>application/json</code> list of number</td><td>Good</td>" in text
    assert "<td>integer</td><td>how many; <code>&gt;= 1, &lt;= 9</code>; default <code>5</code></td>" in text
    assert "<td><code>&quot;z&quot;</code>, <code>&quot;range&quot;</code></td><td>required</td>" in text
    assert '<a href="#Question">Question</a> or null' in text
    assert "<pre>{\n &quot;k&quot;: 5\n}</pre>" in text


def test_the_page_has_every_operation_and_type_of_the_contract(page: httpx.Response, client: httpx.Client) -> None:
    assert page.status_code == 200
    document = client.get("/openapi.json").json()
    operations = [each["operationId"] for methods in document["paths"].values() for each in methods.values()]
    anchors = set(re.findall(r'id="([^"]+)"', page.text))
    assert anchors == {*operations, *document["components"]["schemas"]}
    assert set(re.findall(r'href="#([^"]+)"', page.text)) <= anchors


def test_the_page_loads_nothing_and_runs_nothing(page: httpx.Response) -> None:
    assert page.headers["content-security-policy"].startswith("default-src 'none'")
    assert not re.findall(r"<script|<link|<img|\bsrc=|\son\w+=", page.text)


def test_the_page_needs_no_key(engine: Engine, app_client: Callable[[FastAPI], httpx.Client]) -> None:
    keys = KeyRing({hash_of("plain"): Caller("robot")})
    guarded = app_client(create_app(engine, keys))
    assert guarded.get("/docs").status_code == 200
    assert guarded.get("/openapi.json").status_code == 401
