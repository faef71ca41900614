"""The sanitizer check of the C code: it detects a report, and it never skips a part silently."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from benchmarks.native import sanitizers
from benchmarks.provenance import ROOT

try:
    sanitizers.runtime()
    missing = ""
except sanitizers.SanitizersMissingError as error:
    missing = str(error)
with_sanitizers = pytest.mark.skipif(bool(missing), reason=missing)

DEFECTS = {
    "beyond the end": "#include <stdlib.h>\nint wrong(int n) { int *a = malloc(16); a[n] = 1; return a[n + 4]; }",
    "freed": "#include <stdlib.h>\nint wrong(int n) { int *a = malloc(8); free(a); return a[n]; }",
    "overflow": "int wrong(int n) { volatile int a = 2147483647; return a + 1 + n; }",
    "no number": "int wrong(int n) { volatile double a = 0; return (int)(a / a) + n; }",
}


@pytest.mark.parametrize("path", sanitizers.TESTS)
def test_every_listed_test_file_exists(path: str) -> None:
    assert (ROOT / path).is_file()


@with_sanitizers
@pytest.mark.parametrize("defect", DEFECTS)
def test_a_defect_is_reported(tmp_path: Path, defect: str) -> None:
    source, library = tmp_path / "wrong.c", tmp_path / "_wrong.so"
    source.write_text(DEFECTS[defect])
    # As the build has them.
    flags = re.search(r"-O1 -g .*-fsanitize=[a-z,-]+", (ROOT / "native" / "CMakeLists.txt").read_text())
    assert flags is not None
    subprocess.run(["gcc", *flags[0].split(), "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
    found = sanitizers.reports_of(tmp_path, ["-c", f"import ctypes; ctypes.CDLL({str(library)!r}).wrong(0)"])
    assert found
    assert all("wrong" in each for each in found)


@with_sanitizers
def test_a_failure_without_a_report_is_no_success(tmp_path: Path) -> None:
    with pytest.raises(sanitizers.RunFailedError, match="a test failed"):
        sanitizers.reports_of(tmp_path, ["-c", "raise SystemExit('a test failed')"])


@with_sanitizers
def test_a_run_without_errors_has_no_report(tmp_path: Path) -> None:
    assert sanitizers.reports_of(tmp_path, ["-c", "print(1)"]) == []


@pytest.mark.parametrize(("ci", "code"), [("true", 1), ("", 0)])
def test_without_sanitizers_a_line_says_so_and_required_checks_fail(monkeypatch, capsys, ci: str, code: int) -> None:
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    monkeypatch.setenv("CI", ci)
    with pytest.raises(SystemExit) as left:
        sanitizers.main()
    assert left.value.code == code
    assert capsys.readouterr().err.startswith("NOT CHECKED: the C code did not run under sanitizers: gcc not found")


def test_reports_and_failures_end_the_check(monkeypatch, capsys) -> None:
    monkeypatch.setattr(sanitizers, "sanitize", lambda: ["x.c:1:2: runtime error: overflow"])
    with pytest.raises(SystemExit) as left:
        sanitizers.main()
    assert left.value.code == 1
    assert "sanitizers: 1 reports" in capsys.readouterr().out
