"""The comparison with the paper at a size that takes minutes: every kind of method runs, the report and the page are written."""

import json
import subprocess
import sys
from pathlib import Path

METHODS = ("streetfix", "scan_context", "dual", "regression", "cnn_one_space_both", "pace")


def test_a_little_of_everything_runs_and_goes_on_where_it_was(tmp_path: Path) -> None:
    # A batch needs pairs near frames: few pairs need many frames, and a pair takes longer to simulate than a frame.
    size = ("--frames", "128", "--pairs", "24", "--test-images", "4", "--budget-minutes", "0.01")
    command = [
        sys.executable,
        "-m",
        "benchmarks.paper",
        "--work",
        str(tmp_path / "work"),
        "--out",
        str(tmp_path / "out"),
        *size,
    ]

    first = subprocess.run([*command, "--only", *METHODS], capture_output=True, text=True, check=False)

    assert first.returncode == 0, first.stderr[-3000:]
    report = json.loads((tmp_path / "out" / "paper.json").read_text())
    rows = {row["id"]: row for row in report["rows"]}
    for method in (
        "streetfix",
        "cnn_knn",
        "cnn_softmax",
        "icp_pointnetlk_googlenet",
        "scan_context",
        "dual_encoder",
    ):
        for split in ("same_drive", "other_drive"):
            for key in ("street_accuracy", "mean_distance_error_m", "mse_m2", "training_minutes"):
                assert rows[f"paper.{method}.{split}.{key}"]["value"] is not None
    assert rows["paper.raw_range.other_drive.mse_m2"]["why"] == "not run yet"
    assert rows["paper.fov_encoder.other_drive.mse_m2"]["why"] == "not run yet"
    assert (
        rows["paper.streetfix.same_drive.mean_distance_error_m"]["value"] < 500
    )  # so few images teach it nothing, but it answers in the city
    pace = json.loads((tmp_path / "out" / "paper" / "pace.json").read_text())
    assert {"streetfix", "googlenet", "dual_encoder", "fov_encoder", "cnn_as_printed"} < set(pace["seconds_an_image"])
    assert "in one run" in rows["paper.streetfix.minutes_for_paper_images"]["why"]
    page = (tmp_path / "out" / "paper.md").read_text()
    for title in ("Table I", "Table II", "Table III", "Figure 9", "97.52 %"):
        assert title in page
    pictures = [line.split("](")[1].rstrip(")") for line in page.splitlines() if line.startswith("![")]
    assert len(pictures) >= 9
    assert all((tmp_path / "out" / picture).stat().st_size > 3000 for picture in pictures)

    again = subprocess.run([*command, "--tables"], capture_output=True, text=True, check=False)

    assert again.returncode == 0, again.stderr[-3000:]
    told = json.loads((tmp_path / "out" / "paper.json").read_text())
    assert [row["value"] for row in told["rows"]] == [row["value"] for row in report["rows"]]
