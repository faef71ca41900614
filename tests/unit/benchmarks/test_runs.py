"""Results that benchmarks keep on disk."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from benchmarks import runs  # after the skip
from benchmarks.runs import RAW_EVERY, Runs, code_hash


def test_each_map_has_its_own_raw_figures_for_the_same_queries(tmp_path, monkeypatch):
    """Queries stand at x = 0, 1, ... 8 m, and every third is asked. The first map answers all with x = 0 m, the other with x = 100 m."""
    frames = [SimpleNamespace(T_map_camera=np.eye(4)) for _ in range(3 * RAW_EVERY)]
    for x, frame in enumerate(frames):
        frame.T_map_camera[0, 3] = x
    dataset: Any = SimpleNamespace(folder=Path("hard-1"), queries=lambda _: iter(frames))

    def map_at(name, x_m):
        T = np.eye(4)[None].copy()
        T[0, 0, 3] = x_m
        return SimpleNamespace(path=Path(name), T_map_place=T)

    asked = []
    monkeypatch.setattr(
        runs, "raw_best_views", lambda bundle, *_, **__: asked.append(bundle.path.name) or {"l2": np.zeros(3, int)}
    )
    found, work = Runs(tmp_path, tmp_path / "encoder.onnx"), (map_at("near", 0.0), map_at("far", 100.0))
    for _ in range(2):
        assert found.raw(work[0], dataset, "clear_precise") == {
            "l2": (2, 3)
        }  # queries at 0 and 3 m are within 5 m, and not that at 6 m
        assert found.raw(work[1], dataset, "clear_precise") == {"l2": (0, 3)}
    assert asked == ["near", "far"]


@pytest.fixture
def code_of(tmp_path, monkeypatch):
    """Return a function that hashes a folder of files with these contents."""
    monkeypatch.setattr(runs, "ROOT", tmp_path)

    def hashed(**files):
        for name, content in files.items():
            path = tmp_path / "service" / name.replace("_", ".")
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(content)
        code_hash.cache_clear()
        return code_hash("service")

    yield hashed
    code_hash.cache_clear()


@pytest.mark.parametrize("name", ["score_py", "rays_c", "rays_h", "verifier_onnx"])
def test_the_hash_of_the_code_includes_programs_and_networks(code_of, name):
    """A new network gives other answers. So results of the old one are not used again."""
    before = code_of(**{name: b"one"})
    assert code_of(**{name: b"other"}) != before
    assert code_of(**{name: b"one"}) == before


def test_texts_and_compiled_libraries_do_not_change_the_hash_of_the_code(code_of):
    before = code_of(score_py=b"one", card_md=b"one", rays_so=b"one")
    assert code_of(card_md=b"other", rays_so=b"other") == before
