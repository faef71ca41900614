import pytest

pytest.importorskip("matplotlib")

from benchmarks import render


def test_conditions_stand_beside_the_clear_day_with_the_stage_that_loses_most():
    head = "full.condition."
    values = {
        f"{head}clear.within_1_m": 0.98, f"{head}clear.recall_at_10_5m": 1.0,
        f"{head}night.within_1_m": 0.90, f"{head}night.recall_at_10_5m": 0.99, f"{head}night.forced_within_1_m": 0.92,
        f"{head}fog.within_1_m": 0.80, f"{head}fog.recall_at_10_5m": 0.85, f"{head}fog.forced_within_1_m": 0.82,
        f"{head}night.recall_at_1_5m": 0.95, "raw.condition.night.recall_at_1_5m": 0.5,
        f"{head}five.within_1_m": 0.99, "full.unseen.precise.within_1_m": 0.5,
    }  # fmt: skip
    lines = render._conditions(values)
    assert lines[3:] == [
        "| night | 0.900 | 0.980 | -0.080 | choice and registration (7.0 points) | 0.950 | 0.500 |",
        "| fog | 0.800 | 0.980 | -0.180 | retrieval (15.0 points) |  |  |",
        "| five | 0.990 | 0.980 | +0.010 |  |  |  |",
    ]
    assert render._conditions({"full.unseen.precise.within_1_m": 0.5}) == []


def test_a_curve_of_each_kind_of_stranger_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr(render, "REPORTS", tmp_path)
    points = [[0.0, 0.5], [0.01, 0.8], [0.2, 0.9]]
    picture = render._accepts("any", {"sky.precise": points, "sky.stereo": points, "noise.stereo": points})
    assert picture == tmp_path / "any_accepts.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
