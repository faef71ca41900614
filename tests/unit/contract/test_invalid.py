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
