"""docs/serving.md names every setting, and its default."""

import re
from pathlib import Path

from service.runtime.settings import Limits, Settings

TEXT = (Path(__file__).parents[2] / "docs" / "serving.md").read_text()
ROWS = [row.split("|")[1:4] for row in TEXT.splitlines() if row.startswith("| `STREETFIX_")]


def test_every_setting_has_a_row_and_no_other() -> None:
    told = {name for row in ROWS for name in re.findall(r"`STREETFIX_(\w+)`", row[0])}
    settings = {name.upper() for name in Settings.model_fields if name != "limits"}
    assert told == settings | {f"LIMITS__{name.upper()}" for name in Limits.model_fields}


def test_defaults_are_what_the_code_says() -> None:
    checked = 0
    for names, defaults, _ in ROWS:
        for name, default in zip(
            re.findall(r"`STREETFIX_(\w+)`", names), re.findall(r"`([^`]*)`", defaults), strict=False
        ):
            field = (Limits.model_fields if name.startswith("LIMITS__") else Settings.model_fields)[
                name.lower().removeprefix("limits__")
            ]
            assert (
                type(field.default)(default if not isinstance(field.default, bool) else default == "true")
                == field.default
            ), name
            checked += 1
    assert checked >= 12
