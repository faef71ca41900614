"""Whatever fits the OpenAPI document, and what does not, is answered as the document says; nothing ends in a 5xx of ours.

Schemathesis makes up the pictures, so its requests seldom reach the core. Requests with good pictures and every number at its bounds and
beyond are those of ``tests/unit/http/test_extreme_values.py``, read off the same document.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis.errors import Unsatisfiable
from schemathesis.specs.openapi.checks import positive_data_acceptance

from service.http.app import create_app
from service.runtime.engine import Engine
from service.runtime.settings import Settings

EXAMPLES = 25


OPERATIONS = (
    "localize",
    "localizeSequence",
    "localizeBatch",
    "postGeoPose",
    "getGeoPoseStatus",
    "listMaps",
    "serveVersion",
    "getStreets",
    "getCoverage",
    "getCloud",
    "getPlaces",
    "explain",
    "listSamples",
    "getSample",
    "listAnswers",
    "getLiveness",
    "getReadiness",
    "getMetrics",
    "getVersion",
)


@pytest.fixture(scope="module")
def document(bundle_path: Path) -> Iterator[schemathesis.BaseSchema]:
    engine = Engine.open(
        Settings(maps=(bundle_path,), threads=1, allowed_hosts=("*",))
    )  # whatever Schemathesis calls the host
    yield schemathesis.openapi.from_asgi("/openapi.json", create_app(engine))
    engine.close()


def test_every_operation_is_asked(document) -> None:
    assert {each.ok().definition.raw["operationId"] for each in document.get_all_operations()} == set(OPERATIONS)


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize("mode", list(schemathesis.GenerationMode))
def test_any_request_is_answered_as_the_document_says(document, name: str, mode: schemathesis.GenerationMode) -> None:
    operation = document.find_operation_by_id(name)

    @settings(
        max_examples=EXAMPLES, deadline=None, derandomize=True, database=None, suppress_health_check=list(HealthCheck)
    )
    @given(operation.as_strategy(generation_mode=mode))
    def asked(case: schemathesis.Case) -> None:
        case.call_and_validate(excluded_checks=[positive_data_acceptance])  # no schema says what a picture is

    try:
        asked()
    except Unsatisfiable:
        pytest.skip("there is no such request")
