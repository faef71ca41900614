"""Validation errors of pydantic become request errors that name the fields."""

import pytest
from pydantic import ValidationError

from service.contract.invalid import invalid, request_error_from
from service.contract.schema import LocalizeRequest


def test_the_error_names_the_first_field_and_lists_the_next_ones() -> None:
    with pytest.raises(ValidationError) as caught:
        LocalizeRequest.model_validate(
            {"camera": {"width": 640, "height": 480, "fx": "wide", "fy": 1e9, "cx": 1, "cy": 1}}
        )
    error = invalid(caught.value)
    assert error.field == "camera.fx"
    assert error.message.startswith("camera.fx: Input should be a valid number")
    assert "; camera.fy: " in error.message
    assert error.message.endswith("; see the schema at /openapi.json")


def test_an_error_of_the_whole_request_says_so() -> None:
    error = request_error_from([{"loc": (), "msg": "Value error, it is empty"}])
    assert (error.field, error.message) == ("", "the request: it is empty; see the schema at /openapi.json")


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (-3, " (given: -3)"),
        (2.5, " (given: 2.5)"),
        (True, " (given: true)"),
        ("wide", ' (given: "wide")'),
        ('a"\n', ' (given: "a\\"\\n")'),  # as JSON: one line
        ("x" * 40, f' (given: "{"x" * 40}")'),
        ("x" * 41, ""),
        (10**41, ""),
        pytest.param(10**5000, "", id="more digits than Python prints"),
        (float("nan"), " (given: NaN)"),
        (b"\x89PNG", ""),
        ([1, 2], ""),
        ({"secret": 1}, ""),
        (None, ""),
    ],
)
def test_the_message_repeats_a_wrong_number_or_short_text(value: object, shown: str) -> None:
    error = request_error_from([{"loc": ("camera", "fx"), "msg": "wrong", "input": value}])
    assert error.message == f"camera.fx: wrong{shown}; see the schema at /openapi.json"


@pytest.mark.parametrize(
    ("location", "kind"), [((), "json_invalid"), (("note",), "extra_forbidden"), (("map",), "missing")]
)
def test_the_message_repeats_no_value_that_is_not_the_wrong_one(location: tuple[str, ...], kind: str) -> None:
    error = request_error_from([{"loc": location, "type": kind, "msg": "wrong", "input": "private"}])
    assert "private" not in error.message


def test_a_document_that_is_not_json_is_not_repeated() -> None:
    with pytest.raises(ValidationError) as caught:
        LocalizeRequest.model_validate_json(b'{"camera": secret')
    assert "secret" not in invalid(caught.value).message
