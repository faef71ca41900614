"""The files that a request passes before the engine: they are few, and a document names them."""

from collections.abc import Callable
from pathlib import Path

from benchmarks.house.request_path import trace_of_request
from benchmarks.report import ROOT

MEDIA_TYPES = {"rgb": "image/jpeg", "depth": "image/png", "request": "application/json"}


def test_a_request_passes_few_files_before_the_engine_and_the_document_names_them(
    bundle_path: Path, parts_of: Callable[..., dict[str, bytes]]
) -> None:
    parts = {name: (name, data, MEDIA_TYPES[name]) for name, data in parts_of().items()}
    before = trace_of_request(bundle_path, parts).before_engine
    assert len(before) <= 7, "\n".join(before)
    told = (ROOT / "docs" / "architecture.md").read_text()
    assert [each for each in before if each.removeprefix("service/") not in told] == []
