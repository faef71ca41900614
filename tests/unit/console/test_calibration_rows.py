"""The console's rows about the calibration of an answer, made by the page's own module."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from service.console.built import WEB

MODULE = WEB / "src" / "answer" / "calibration_rows.ts"
ESBUILD = WEB / "node_modules" / ".bin" / "esbuild"
#: Reads answers from standard input and writes their rows.
DRIVER = """
import { calibrationRows } from './calibration_rows.mjs';
let read = '';
for await (const part of process.stdin) read += part;
process.stdout.write(JSON.stringify(JSON.parse(read).map(calibrationRows)));
"""


def rows_of(folder: Path, *answers: dict[str, Any]) -> list[list[list[str]]]:
    """Run the module of the page with Node and return the rows of each answer."""
    if shutil.which("node") is None or not ESBUILD.exists():
        pytest.skip("the page's packages are not there: make check-console installs them, with Node")
    options = ["--bundle", "--format=esm", f"--outfile={folder / 'calibration_rows.mjs'}", "--log-level=error"]
    subprocess.run([str(ESBUILD), str(MODULE), *options], check=True)
    (folder / "driver.mjs").write_text(DRIVER)
    done = subprocess.run(
        ["node", folder / "driver.mjs"], input=json.dumps(answers), capture_output=True, text=True, check=True
    )
    rows: list[list[list[str]]] = json.loads(done.stdout)
    return rows


def answer(**changed: Any) -> dict[str, Any]:
    return {"threshold": None, "rig_correction": None, "extrapolated": {}} | changed


def test_the_rows_name_threshold_correction_and_features(tmp_path: Path) -> None:
    full, corrected, plain, none = rows_of(
        tmp_path,
        answer(
            threshold={"confidence": 0.9, "false_accept_rate": 0.00123},
            rig_correction="mule",
            extrapolated={"far": 3.26, "points": -4.0},
        ),
        answer(threshold={"confidence": 0.905, "false_accept_rate": 0.01}, rig_correction="mule"),
        answer(threshold={"confidence": 0.5, "false_accept_rate": 0.1}),
        answer(),
    )
    assert full == [
        ["threshold", "confidence 0.90; at most 0.12 % of out-of-map queries reach it"],
        ["confidence corrected for", "mule"],
        ["confidence is extrapolated", "far +3.3 σ, points \N{MINUS SIGN}4.0 σ"],
    ]
    assert [name for name, _ in corrected] == ["threshold", "confidence corrected for"]
    assert plain == [["threshold", "confidence 0.50; at most 10 % of out-of-map queries reach it"]]
    assert none == []
