"""The committed contract is what the code says, and the examples in it are valid."""

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from service.contract.oscp import GeoPoseRequest
from service.contract.schema import BatchRequest, LocalizeRequest, SequenceRequest, ServeVersion
from service.http.openapi import main, openapi_text

COMMITTED = Path(__file__).parents[2] / "openapi" / "openapi.json"
#: Models of all request bodies, by the names of their schemas.
REQUESTS: dict[str, type[BaseModel]] = {
    model.__name__: model for model in (LocalizeRequest, SequenceRequest, BatchRequest, ServeVersion, GeoPoseRequest)
}


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    read: dict[str, Any] = json.loads(openapi_text())
    return read


def test_the_committed_file_is_what_the_code_says() -> None:
    assert COMMITTED.read_text() == openapi_text(), "run: python -m service.http.openapi"


def test_check_passes_on_the_committed_file_and_fails_on_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--check", str(COMMITTED)]) == 0
    (tmp_path / "old.json").write_text("{}")
    assert main(["--check", str(tmp_path / "old.json")]) == 1
    assert "run: python -m service.http.openapi" in capsys.readouterr().err


def test_the_environment_does_not_reach_the_contract(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STREETFIX_PORT", "1234")
    assert COMMITTED.read_text() == openapi_text()


def test_every_operation_has_an_id_and_a_summary(document: dict[str, Any]) -> None:
    operations = [operation for path in document["paths"].values() for operation in path.values()]
    assert all(operation["operationId"] and operation["summary"] for operation in operations)
    assert len({operation["operationId"] for operation in operations}) == len(operations)


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    text = json.dumps(document)
    for reference in {part.split('"')[0] for part in text.split('"$ref": "#/')[1:]}:
        node: Any = document
        for key in reference.split("/"):
            node = node[key]


def test_every_error_is_a_problem(document: dict[str, Any]) -> None:
    for path in document["paths"].values():
        for operation in path.values():
            for status, response in operation["responses"].items():
                if int(status) >= 400:
                    assert list(response["content"]) == ["application/problem+json"]
                    schema = response["content"]["application/problem+json"]["schema"]
                    assert schema == {"$ref": "#/components/schemas/Problem"}


def test_every_request_body_has_a_model(document: dict[str, Any]) -> None:
    named = set()
    for path in document["paths"].values():
        for operation in path.values():
            for content in operation.get("requestBody", {}).get("content", {}).values():
                body = content["schema"].get("properties", {}).get("request", content["schema"])
                named.add(body["$ref"].rpartition("/")[2])
    assert named == set(REQUESTS)


@pytest.mark.parametrize("name", REQUESTS)
def test_every_example_of_a_request_is_valid(document: dict[str, Any], name: str) -> None:
    examples = document["components"]["schemas"][name]["examples"]
    assert examples
    for example in examples:
        # Models that ignore unknown fields would also accept a misspelt one.
        assert set(example) <= set(REQUESTS[name].model_fields)
        REQUESTS[name].model_validate(example)
