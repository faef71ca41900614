"""The demo writes its queries as sample pairs that the service reads."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from model_training.cli.demo_map import DemoQuery
from model_training.cli.demo_samples import write_samples
from service.console.samples import Samples
from service.geometry.rigid import R_BODY_OPTICAL, rotation_z, transform_from

TRUTH = transform_from(rotation_z(np.pi / 2) @ R_BODY_OPTICAL, np.array([1.0, 2.0, 3.0]))


def question(folder: Path, **changed: Any) -> DemoQuery:
    camera = {"camera": {"width": 64, "height": 48, "fx": 32, "fy": 32, "cx": 31.5, "cy": 23.5}}
    (folder / "front.json").write_text(json.dumps(camera))
    for name in ("000000.jpg", "000000.png"):
        (folder / name).write_bytes(name.encode())
    given = {"T_map_camera": TRUTH} | changed
    return DemoQuery("1", folder / "000000.jpg", folder / "000000.png", folder / "front.json", **given)


def test_a_service_reads_the_written_values(tmp_path: Path) -> None:
    (sample,) = Samples.open(
        write_samples([question(tmp_path)], tmp_path / "samples", map_name="town")
    ).by_name.values()
    assert (sample.request.map, sample.request.camera.width) == ("town", 64)
    assert sample.pictures["rgb"].path.read_bytes() == b"000000.jpg"
    assert sample.truth is not None
    assert (sample.truth.position.z, sample.truth.heading_deg) == (3.0, pytest.approx(90))


@pytest.mark.parametrize("changed", [{"T_map_camera": None}, {"place": 4}])
def test_without_ground_truth_none_is_written(tmp_path: Path, changed: dict[str, Any]) -> None:
    (sample,) = Samples.open(
        write_samples([question(tmp_path, **changed)], tmp_path / "samples", map_name="town")
    ).by_name.values()
    assert sample.truth is None


def test_a_second_write_removes_the_old_files(tmp_path: Path) -> None:
    asked = question(tmp_path)
    write_samples([asked, asked], tmp_path / "samples", map_name="town")
    write_samples([asked], tmp_path / "samples", map_name="town")
    assert os.listdir(tmp_path / "samples") == ["01"]
    assert not list(tmp_path.glob(".samples*"))


def test_without_queries_the_folder_is_empty(tmp_path: Path) -> None:
    assert Samples.open(write_samples([], tmp_path / "samples", map_name="town")).by_name == {}
