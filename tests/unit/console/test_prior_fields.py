"""The console draws a prior before it sends one, so it has a copy of the default standard deviation."""

import re

from service.console.built import WEB
from service.retrieval.prior import POSITION_STD_M


def test_the_console_has_the_default_standard_deviation_of_the_service() -> None:
    fields = (WEB / "src" / "query" / "prior_fields.ts").read_text()
    found = re.search(r"std > 0 \? std : ([0-9.]+)", fields)
    assert found is not None
    assert float(found[1]) == POSITION_STD_M
