"""Write the questions of the demo as sample pairs for the browser console."""

import json
import math
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from model_training.cli.demo_map import DemoQuery
from service.geometry.rigid import heading_of_camera


def write_samples(questions: Sequence[DemoQuery], folder: Path, *, map_name: str) -> Path:
    """Write images, request and ground truth of each question into its own folder, and return the folder of all.

    The folder is written again each time and gets its name when it is complete. A service that starts meanwhile sees the old
    samples or the new ones.

    Args:
        questions: of the demo.
        folder: folder to write; an existing one is replaced.
        map_name: name of the map. Each request names it, so that the console offers the samples for this map only.
    """
    part, old = folder.with_name(f".{folder.name}.part"), folder.with_name(f".{folder.name}.old")
    for left in (part, old):
        shutil.rmtree(left, ignore_errors=True)
    for number, question in enumerate(questions, 1):
        _write_sample(question, part / f"{number:02d}", map_name)
    part.mkdir(parents=True, exist_ok=True)  # where there are no questions
    if folder.exists():
        folder.rename(old)
    part.rename(folder)
    shutil.rmtree(old, ignore_errors=True)
    return folder


def _write_sample(question: DemoQuery, folder: Path, map_name: str) -> None:
    folder.mkdir(parents=True)
    for source, name in ((question.rgb, "rgb"), (question.depth, "depth")):
        _link(source, folder / f"{name}{source.suffix}")
    request = {"map": map_name} | json.loads(question.camera.read_text())
    (folder / "request.json").write_text(json.dumps(request, indent=1) + "\n")
    T = question.T_map_camera
    if T is not None and question.place is None:  # single frames have no distance that would mean anything
        x, y, z = T[:3, 3].tolist()
        heading_deg = math.degrees(heading_of_camera(T))
        truth = {"position": {"x": x, "y": y, "z": z}, "heading_deg": heading_deg}
        (folder / "truth.json").write_text(json.dumps(truth, indent=1) + "\n")


def _link(source: Path, target: Path) -> None:
    """Make a hard link to the file, or a copy if the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
