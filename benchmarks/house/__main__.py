"""``make house``: measure the readability of code and documents -> ``reports/house.json``."""

import argparse
import json
import tarfile
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path

from benchmarks.docs_blocks import code_blocks_run
from benchmarks.house.docstrings import all_lacking, code_lines
from benchmarks.house.installation import distributions_of
from benchmarks.house.prose import docstrings, pages, prose_of_markdown, reading_ease
from benchmarks.house.request_path import trace_of_request
from benchmarks.provenance import git
from benchmarks.report import ROOT, Report
from model_training.datasets.dataset import Dataset
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.simulation.plan import QueryPlan, SimulationPlan
from model_training.simulation.simulate import simulate
from model_training.stock import CALIBRATION, ENCODER

MOST_LINES, LONGEST_LINE, EASE = 120, 200, 55.0
#: Commit at which a review called the language "compressed and idiolectal".
BEFORE = "d8391ab"


def main() -> None:
    """Measure the chosen parts; rows of the others stay."""
    parts: dict[str, Callable[[Report], None]] = {
        "documents": _document_rows,
        "docstrings": _docstring_rows,
        "request": _request_rows,
        "blocks": _block_rows,
    }
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.house",
        description="Measure how readable code and documents are, and write reports/house.json",
        epilog="Example: python -m benchmarks.house --only documents docstrings",
    )
    parser.add_argument(
        "--only", nargs="+", choices=list(parts), default=list(parts), help="parts to measure (default: all)"
    )
    report = Report("house", "python -m benchmarks.house")
    only = parser.parse_args().only
    report.keep_others()
    for name in only:
        parts[name](report)
    print(report.write())


def _document_rows(report: Report) -> None:
    """Add length of README, longest line of the documents, and reading ease."""
    documents = [page.read_text() for page in pages()]
    report.row("readme.lines", len(documents[0].splitlines()), "lines", bar=MOST_LINES, better="lower")
    longest = max(len(line) for text in documents for line in text.splitlines())
    report.row("docs.longest_line", longest, "characters", bar=LONGEST_LINE, better="lower")
    _reading_rows(report, documents)


def _block_rows(report: Report) -> None:
    """Add the share of code blocks in README and docs that run."""
    ran, total = code_blocks_run()
    why = None if ran == total else f"{total - ran} of {total} failed"
    report.row("docs.code_blocks_run", ran / total, "share", bar=1.0, n=total, why=why)


def _reading_rows(report: Report, documents: list[str]) -> None:
    """Add the Flesch reading ease of documents, of docstrings, and of both together."""
    of_documents = "\n".join(prose_of_markdown(text) for text in documents)
    of_docstrings = "\n".join(docstrings())
    report.row("docs.reading_ease.documents", reading_ease(of_documents), "points")
    report.row("docs.reading_ease.docstrings", reading_ease(of_docstrings), "points")
    report.row("docs.reading_ease", reading_ease(f"{of_documents}\n{of_docstrings}"), "points", bar=EASE)
    report.row(
        "docs.reading_ease.before", _reading_ease_of(BEFORE), "points", why=f"of commit {BEFORE}, before the rewriting"
    )


def _reading_ease_of(commit: str) -> float | None:
    """Return the reading ease of documents and docstrings at a commit; None if this clone lacks it."""
    with tempfile.TemporaryDirectory(prefix="house-") as name:
        archive, root = Path(name, "archive.tar"), Path(name, "tree")
        if git("archive", f"--output={archive}", commit) is None:
            return None
        with tarfile.open(archive) as tar:
            tar.extractall(root, filter="data")
        documents = "\n".join(prose_of_markdown(page.read_text()) for page in pages(root))
        return reading_ease("\n".join([documents, *docstrings(root)]))


def _docstring_rows(report: Report) -> None:
    """Add the share of complete public docstrings, the length of the localizer, and what the client alone installs."""
    found, count = all_lacking()
    for each in found:
        print(f"  {each.name}: {each.what}")
    report.row("api.public_docstrings", 1 - len(found) / count, "share", bar=1.0, n=count)
    localizer = code_lines(ROOT / "service" / "localization" / "localizer.py")
    report.row("localizer.lines", localizer, "lines", bar=60, better="lower")
    core = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    report.row("wheel.client_dependencies", len(core), "packages", bar=6, better="lower")
    report.row("wheel.client_distributions", len(distributions_of(core)), "packages")


def _request_rows(report: Report) -> None:
    """Add the files that one request to a small simulated map passes through."""
    with tempfile.TemporaryDirectory(prefix="house-") as folder:
        data, bundle = Path(folder, "data"), Path(folder, "map")
        plan = SimulationPlan(
            name="house", seed=7, size_m=(120.0, 120.0), queries=(QueryPlan(name="drive", traversal=1, count=1),)
        )
        simulate(plan, data, workers=1)
        build_map(Dataset(data), ENCODER, bundle, BuildSettings(name="house", calibration=CALIBRATION))
        (frame,) = Dataset(data).queries("drive_precise")
        camera = frame.camera.pinhole()
        told = {"camera": {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}}
        parts = {
            "rgb": (frame.rgb_path.name, frame.rgb_path.read_bytes(), "image/jpeg"),
            "depth": (frame.depth_path.name, frame.depth_path.read_bytes(), "image/png"),
            "request": ("request.json", json.dumps(told).encode(), "application/json"),
        }
        trace = trace_of_request(bundle, parts)
    report.row("request.files_before_engine", len(trace.before_engine), "files", bar=6, better="lower")
    report.row("request.files_in_core", len(trace.in_core), "files", bar=20, better="lower")
    report.notes["request.files"] = {"before the engine": trace.before_engine, "in the core": trace.in_core}


if __name__ == "__main__":
    main()
