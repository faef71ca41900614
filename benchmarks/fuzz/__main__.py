"""``make fuzz``: fuzz every parser of untrusted input with a million inputs -> reports/serving.json.

Atheris mutates the inputs, guided by coverage. Each target runs in its own process, so a crash stops only that target.
The command keeps the crashing input under ``--work``. Turn each such input into a test.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

from benchmarks.report import ROOT, Report


def main() -> None:
    """Parse the arguments, fuzz and write the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=1_000_000, help="number of inputs over all targets")
    parser.add_argument("--work", type=Path, default=ROOT / "data" / "fuzz", help="folder of corpus and crashes")
    parser.add_argument("--one", nargs=3, metavar=("TARGET", "BUNDLE", "RUNS"), help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        _fuzz(arguments.one[0], Path(arguments.one[1]), int(arguments.one[2]), arguments.work)
        return
    report = Report("serving", "make fuzz")
    report.keep_others()
    with tempfile.TemporaryDirectory() as folder:
        bundle = _bundle(Path(folder))
        from benchmarks.fuzz.targets import targets

        shares = {name: target.share for name, target in targets(bundle, Path(folder)).items()}
        done, crashes = 0, []
        for name, share in shares.items():
            runs = max(1, round(arguments.inputs * share))
            began = time.perf_counter()
            command = [
                sys.executable,
                "-m",
                "benchmarks.fuzz",
                "--work",
                str(arguments.work),
                "--one",
                name,
                str(bundle),
                str(runs),
            ]
            ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
            inputs = max([0, *(int(n) for n in re.findall(r"^#(\d+)\s", ended.stderr, re.MULTILINE))])
            done += inputs
            print(
                f"{name:16} {inputs:8} inputs in {time.perf_counter() - began:6.1f} s, exit {ended.returncode}",
                flush=True,
            )
            if ended.returncode:
                crashes.append(name)
                print(ended.stderr[-3000:], flush=True)
    why = f"in {', '.join(crashes)}" if crashes else None
    report.row("fuzz.inputs", done, "count", bar=1_000_000, n=len(shares))
    report.row("fuzz.crashes", len(crashes), "count", bar=0, better="lower", n=len(shares), why=why)
    print(f"written: {report.write()}")


def _bundle(folder: Path) -> Path:
    """Write the small map of the tests."""
    from service.maps.writer import write_bundle

    spec = spec_from_file_location("tests_conftest", ROOT / "tests" / "conftest.py")
    if spec is None or spec.loader is None:
        raise RuntimeError("tests/conftest.py is missing: it creates the map for the fuzzing")
    factory = module_from_spec(spec)
    spec.loader.exec_module(factory)
    write_bundle(folder / "tiny", factory.make_content())
    return folder / "tiny"


def _fuzz(name: str, bundle: Path, runs: int, work: Path) -> None:
    """Fuzz one target in this process, which Atheris ends."""
    import atheris

    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    with atheris.instrument_imports(include=["service"]):
        from benchmarks.fuzz.targets import survives, targets
    corpus, crashes = work / "corpus" / name, work / "crashes"
    for each in (corpus, crashes):
        each.mkdir(parents=True, exist_ok=True)
    target = targets(bundle, bundle.parent)[name]
    for number, seed in enumerate(target.seeds):
        (corpus / f"seed-{number}").write_bytes(seed)
    options = [
        f"-runs={runs}",
        "-max_len=20000",
        "-rss_limit_mb=4096",
        "-timeout=20",
        f"-artifact_prefix={crashes}/{name}-",
        "-verbosity=1",
    ]
    atheris.Setup([sys.argv[0], *options, str(corpus)], lambda data: survives(target.take, data))
    atheris.Fuzz()


if __name__ == "__main__":
    main()
