"""``make sanitize``: run all C code under AddressSanitizer and UndefinedBehaviorSanitizer.

The command builds the package with both. It runs the unit tests of the modules that call C, then random inputs of
extreme shapes and values. It exits with 0 without a report, and with 1 after a report or a failure. Without a compiler
with sanitizers it prints a message and skips the check; if ``CI`` is set, it then exits with 1.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

from benchmarks.native.wheels import ROOT, build_wheel, python_in

#: Unit tests of every module that calls C.
TESTS = tuple(
    f"tests/unit/{folder}/test_{name}.py"
    for folder, names in {
        "imaging": ("decode_depth", "resample", "level", "png16", "ros_depth", "view_grid"),
        "registration": ("align", "gradients", "nearest_grid", "points", "rays", "render", "surfel_map", "visibility"),
        "mapping": ("passes", "voxel_map"),
    }.items()
    for name in names
)
ROUNDS = 70
#: Marks of a report: the first line of AddressSanitizer, and each line of UndefinedBehaviorSanitizer.
_REPORT = re.compile(r"ERROR: AddressSanitizer|: runtime error: ")
_PROBE = "int main(void) { return 0; }\n"


class SanitizersMissingError(Exception):
    """No compiler with sanitizers is installed."""


class RunFailedError(Exception):
    """A run under the sanitizers failed for another reason than a report."""


def runtime() -> str:
    """Return the libraries to preload: the runtime of gcc's AddressSanitizer, and that of C++, whose exceptions it intercepts.

    Raises:
        SanitizersMissingError: gcc not found, or it lacks the sanitizers.
    """
    if shutil.which("gcc") is None:
        raise SanitizersMissingError("gcc not found")
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "probe.c"
        source.write_text(_PROBE)
        command = ["gcc", "-fsanitize=address,undefined", "-o", str(source.with_suffix("")), str(source)]
        built = subprocess.run(command, capture_output=True, text=True, check=False)
    if built.returncode != 0:
        raise SanitizersMissingError(f"gcc cannot link with its sanitizers: {built.stderr.strip()}")
    names = ("libasan.so", "libstdc++.so.6")
    places = [
        subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
        for name in names
    ]
    return " ".join(place.stdout.strip() for place in places)


def reports_of(unpacked: Path, arguments: list[str]) -> list[str]:
    """Run Python in an unpacked wheel built with sanitizers.

    Args:
        unpacked: folder of the unpacked wheel.
        arguments: arguments of Python.

    Returns:
        The reports, each with the text below it.

    Raises:
        RunFailedError: the process failed without a report.
    """
    with tempfile.TemporaryDirectory() as folder:
        log = f"{folder}/report"
        done = python_in(
            unpacked,
            arguments,
            LD_PRELOAD=runtime(),
            PYTHONMALLOC="malloc",
            # Python itself keeps memory until it ends, so leak detection is off.
            ASAN_OPTIONS=f"detect_leaks=0:log_path={log}",
            UBSAN_OPTIONS=f"print_stacktrace=1:log_path={log}",
        )
        told = "\n".join(path.read_text(errors="replace") for path in sorted(Path(folder).iterdir()))
    # UndefinedBehaviorSanitizer inside AddressSanitizer's runtime writes to the log or to stderr.
    found = list(_split(told + "\n" + done.stderr))
    if done.returncode != 0 and not found:
        raise RunFailedError(f"{' '.join(arguments)}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}")
    return found


def _split(told: str) -> Iterator[str]:
    starts = [found.start() for found in _REPORT.finditer(told)]
    for begin, end in pairwise([*starts, len(told)]):
        yield told[max(0, told.rfind("\n", 0, begin)) : min(end, begin + 1500)].strip()


@contextmanager
def sanitized() -> Iterator[Path]:
    """Build a wheel with sanitizers; yield its unpacked folder."""
    runtime()
    with tempfile.TemporaryDirectory() as folder:
        yield build_wheel(Path(folder) / "wheel", "gcc", {"cmake.define.STREETFIX_SANITIZE": "ON"})


def sanitize(rounds: int = ROUNDS) -> list[str]:
    """Return the reports of tests and random inputs.

    Args:
        rounds: rounds of random inputs.

    Raises:
        SanitizersMissingError: no compiler has them.
        RunFailedError: a test failed, or the random inputs ended early.
    """
    with sanitized() as unpacked:
        # Use the tests' own configuration and folders, but the package of the wheel.
        tests = ["-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", f"{ROOT}/pyproject.toml", f"--rootdir={ROOT}"]
        found = reports_of(unpacked, [*tests, *(str(ROOT / each) for each in TESTS)])
        return found + reports_of(unpacked, ["-W", "ignore", "-m", "benchmarks.native.inputs", "--rounds", str(rounds)])


def main() -> None:
    """Run, print the reports, and exit with the status that the module's docstring gives."""
    try:
        found = sanitize()
    except SanitizersMissingError as error:
        print(
            f"NOT CHECKED: the C code did not run under sanitizers: {error}; install gcc and libasan", file=sys.stderr
        )
        sys.exit(1 if os.environ.get("CI") else 0)
    except RunFailedError as error:
        sys.exit(f"failed under the sanitizers:\n{error}")
    for report in found:
        print(report, end="\n\n")
    print(f"sanitizers: {len(found)} reports")
    sys.exit(1 if found else 0)


if __name__ == "__main__":
    main()
