"""``/docs``: the OpenAPI document as one page of HTML, without scripts and without files of other hosts.

The pages that FastAPI offers load scripts from a content delivery network. A robot's network often has no Internet.
"""

import json
from functools import cache
from html import escape
from typing import Any

from fastapi import APIRouter, FastAPI
from starlette.responses import HTMLResponse, RedirectResponse

#: A page without scripts: styles are inline, nothing else is loaded.
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
}
_METHODS = ("get", "put", "post", "delete", "patch")
_LIMITS = (
    ("minimum", ">="),
    ("exclusiveMinimum", ">"),
    ("maximum", "<="),
    ("exclusiveMaximum", "<"),
    ("minLength", "length >="),
    ("maxLength", "length <="),
    ("minItems", "items >="),
    ("maxItems", "items <="),
    ("pattern", "pattern"),
)
_STYLE = """
:root { color-scheme: light dark; font: 16px/1.5 system-ui, sans-serif }
body { max-width: 62rem; margin: 2rem auto; padding: 0 1rem }
h2 { margin-top: 2.5rem; border-top: 1px solid; padding-top: 1rem; font-size: 1.2rem }
code, pre { font: 0.875rem/1.4 ui-monospace, monospace }
pre { overflow-x: auto; padding: 0.75rem; border: 1px solid }
table { border-collapse: collapse; width: 100%; margin: 0.5rem 0 }
th, td { text-align: left; vertical-align: top; padding: 0.25rem 0.75rem 0.25rem 0; border-bottom: 1px solid }
summary { cursor: pointer; font-weight: 600; margin: 0.5rem 0 }
nav li { margin: 0.15rem 0 }
"""


def router_for(app: FastAPI, *, leads_from_root: bool) -> APIRouter:
    """Create the route of the page.

    Args:
        app: its OpenAPI document is shown.
        leads_from_root: whether ``/`` redirects to the page too. With a console, ``/`` redirects to the console.
    """
    router = APIRouter(include_in_schema=False)

    @cache
    def page() -> str:
        return page_of(app.openapi())

    @router.get("/docs", operation_id="getReference")
    async def get_reference() -> HTMLResponse:
        return HTMLResponse(page(), headers=HEADERS)

    if leads_from_root:

        @router.get("/", operation_id="getRoot")
        async def get_root() -> RedirectResponse:
            # Relative, because a proxy may put the service below a path of its own. Temporary: a console may be switched on.
            return RedirectResponse("docs", status_code=307, headers=HEADERS)

    return router


def page_of(document: dict[str, Any]) -> str:
    """Render the OpenAPI document as an HTML page.

    Args:
        document: OpenAPI 3.1, as ``app.openapi()`` gives it.
    """
    info, schemas = document["info"], document.get("components", {}).get("schemas", {})
    operations = [
        (f"{method.upper()} {path}", operation)
        for path, methods in document["paths"].items()
        for method, operation in methods.items()
        if method in _METHODS
    ]
    contents = "".join(
        f'<li><a href="#{escape(each["operationId"])}"><code>{escape(name)}</code></a> {escape(each.get("summary", ""))}</li>'
        for name, each in operations
    )
    body = "".join(_operation(name, each) for name, each in operations)
    types = "".join(_schema(name, schemas[name]) for name in sorted(schemas))
    title = f"{info['title']} {info['version']}"
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>'
        f"<h1>{escape(title)}</h1>{_paragraphs(info.get('description', ''))}"
        '<p>The same contract for programs: <a href="openapi.json">openapi.json</a>.</p>'
        f"<nav><ul>{contents}</ul></nav>{body}<h2>Types</h2>{types}</body></html>"
    )


def _operation(name: str, operation: dict[str, Any]) -> str:
    """Render one method of one path: purpose, parameters, body and answers."""
    parts = [f'<h2 id="{escape(operation["operationId"])}"><code>{escape(name)}</code></h2>']
    parts.append(f"<p><strong>{escape(operation.get('summary', ''))}</strong></p>")
    parts.append(_paragraphs(operation.get("description", "")))
    rows = [
        (each["name"], each["in"], each.get("schema", {}), each.get("required", False), each.get("description", ""))
        for each in operation.get("parameters", [])
    ]
    if rows:
        lines = (
            _row(
                f"<code>{escape(label)}</code> ({escape(where)})",
                _type(schema),
                _description(schema, required=required, description=description),
            )
            for label, where, schema, required, description in rows
        )
        parts.append(_table(("parameter", "type", "meaning"), lines))
    for media, content in operation.get("requestBody", {}).get("content", {}).items():
        parts.append(f"<p>Body: <code>{escape(media)}</code> {_type(content.get('schema', {}))}</p>")
        parts.append(_properties(content.get("schema", {})))
    answers = (
        _row(escape(status), ", ".join(_answer(response)), escape(response.get("description", "")))
        for status, response in operation["responses"].items()
    )
    parts.append(_table(("status", "answer", ""), answers))
    return "".join(parts)


def _answer(response: dict[str, Any]) -> list[str]:
    return [
        f"<code>{escape(media)}</code> {_type(content.get('schema', {}))}"
        for media, content in response.get("content", {}).items()
    ]


def _schema(name: str, schema: dict[str, Any]) -> str:
    """Render one type, folded, with an example if it has one."""
    examples = "".join(
        f"<pre>{escape(json.dumps(example, indent=1))}</pre>"
        for example in schema.get("examples", [])
        if isinstance(example, dict)
    )
    return (
        f'<details id="{escape(name)}" open><summary>{escape(name)}</summary>{_paragraphs(schema.get("description", ""))}'
        f"{_properties(schema)}{examples}</details>"
    )


def _properties(schema: dict[str, Any]) -> str:
    required = schema.get("required", [])
    lines = [
        _row(
            f"<code>{escape(name)}</code>",
            _type(each),
            _description(each, required=name in required, description=each.get("description", "")),
        )
        for name, each in schema.get("properties", {}).items()
    ]
    return _table(("field", "type", "meaning"), lines) if lines else ""


def _type(schema: dict[str, Any]) -> str:
    """Describe a type in a few words. A type of the document becomes a link."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f'<a href="#{escape(name)}">{escape(name)}</a>'
    for several in ("anyOf", "oneOf", "allOf"):
        if several in schema:
            return " or ".join(_type(each) for each in schema[several])
    if "const" in schema or "enum" in schema:
        return ", ".join(
            f"<code>{escape(json.dumps(value))}</code>" for value in schema.get("enum", [schema.get("const")])
        )
    if schema.get("type") == "array":
        return f"list of {_type(schema.get('items', {}))}"
    return escape(str(schema.get("format") or schema.get("type") or "any value"))


def _description(schema: dict[str, Any], *, required: bool, description: str) -> str:
    """Describe the meaning, the limits and the default of a field."""
    limits = [
        f"{sign} {limit[key]}" for limit in (schema, *schema.get("anyOf", [])) for key, sign in _LIMITS if key in limit
    ]
    words = [escape(description)] if description else []
    words += [f"<code>{escape(', '.join(limits))}</code>"] if limits else []
    words += ["required"] if required else []
    default = schema.get("default")
    words += [f"default <code>{escape(json.dumps(default))}</code>"] if default is not None and not required else []
    return "; ".join(words)


def _paragraphs(text: str) -> str:
    return "".join(f"<p>{escape(part)}</p>" for part in text.split("\n\n") if part.strip())


def _row(*cells: str) -> str:
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"


def _table(heads: tuple[str, ...], rows: Any) -> str:
    return "<table><tr>" + "".join(f"<th>{head}</th>" for head in heads) + "</tr>" + "".join(rows) + "</table>"
