"""When the demo builds its map again. Simulation and build are faked, because only the decision is tested."""

import itertools
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from model_training.cli import demo_map
from model_training.cli.demo_map import CityDemo, city_demo, recorded_demo
from model_training.datasets.dataset import Dataset
from service.maps.content import BundleContent
from service.maps.manifest import Manifest
from service.maps.writer import write_bundle

PLAN = CityDemo(streets=("1",), queries=5, depth="precise", seed=0)


class Quiet:
    """A report without output."""

    def __call__(self, stage: str, done: int, total: int, /) -> None:
        pass

    def describe(self, stage: str, text: str, /) -> None:
        pass


quiet = Quiet()


class Workshop:
    """A folder for the demo, an encoder, and a count of built maps. ``interrupted`` stops a build before it is complete."""

    def __init__(self, folder: Path, content_of: Callable[..., BundleContent]) -> None:
        self.folder, self.encoder, self.interrupted = folder / "demo", folder / "encoder.onnx", False
        self.encoder.write_bytes(b"one")
        self.built, self._content_of, self._seeds = 0, content_of, itertools.count()

    def build(self, _dataset: Dataset, _encoder: Path, out: Path, _settings: Any, **_: object) -> Manifest:
        if self.interrupted:
            raise KeyboardInterrupt
        self.built += 1
        return write_bundle(out, self._content_of(seed=next(self._seeds)), overwrite=True)

    def demo(self, plan: CityDemo = PLAN) -> None:
        city_demo(plan, self.folder, self.encoder, quiet)

    def forget_dataset(self) -> None:
        shutil.rmtree(self.folder / "dataset")


@pytest.fixture
def workshop(
    tmp_path: Path, content_of: Callable[..., BundleContent], small_dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> Workshop:
    shop = Workshop(tmp_path, content_of)

    def place(out: Path) -> None:
        if not out.exists():
            shutil.copytree(small_dataset.folder, out)

    def place_recorded(_source: Path, out: Path, **_: object) -> None:
        place(out)
        description = small_dataset.description
        source = {"kind": "kitti-object", "places": [], "queries": {}}
        text = description.model_copy(update={"source": source}).model_dump_json()
        (out / "dataset.json").write_text(text)

    monkeypatch.setattr(demo_map, "simulate", lambda _plan, out, **_: place(out))
    monkeypatch.setattr(demo_map, "import_kitti_object", place_recorded)
    monkeypatch.setattr(demo_map, "build_map", shop.build)
    return shop


def test_a_map_is_built_once(workshop: Workshop) -> None:
    workshop.demo()
    workshop.demo()
    assert workshop.built == 1


def test_another_encoder_builds_the_map_again(workshop: Workshop) -> None:
    workshop.demo()
    workshop.encoder.write_bytes(b"another")
    workshop.demo()
    assert workshop.built == 2


def test_another_plan_builds_the_map_again_even_after_an_interruption(workshop: Workshop) -> None:
    workshop.demo()
    other = replace(PLAN, seed=1)
    workshop.forget_dataset()
    workshop.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        workshop.demo(other)
    workshop.interrupted = False
    workshop.demo(other)
    workshop.demo(other)
    assert workshop.built == 2


def test_another_recording_builds_the_map_again_even_after_an_interruption(workshop: Workshop, tmp_path: Path) -> None:
    recorded_demo(tmp_path / "one", workshop.folder, workshop.encoder, quiet)
    workshop.forget_dataset()
    workshop.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        recorded_demo(tmp_path / "other", workshop.folder, workshop.encoder, quiet)
    workshop.interrupted = False
    recorded_demo(tmp_path / "other", workshop.folder, workshop.encoder, quiet)
    assert workshop.built == 2


def test_a_map_that_differs_from_the_note_is_built_again(workshop: Workshop, content_of: Callable[..., Any]) -> None:
    workshop.demo()
    write_bundle(workshop.folder / "map", content_of(seed=77), overwrite=True)
    workshop.demo()
    assert workshop.built == 2


def test_a_damaged_note_builds_the_map_again(workshop: Workshop) -> None:
    workshop.demo()
    (workshop.folder / "map.made_from.json").write_text("{")
    workshop.demo()
    assert workshop.built == 2
