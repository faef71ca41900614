"""Encoders that differ from the stock recipe in one thing each: short trainings in half precision, without a second round."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from model_training.training.export import export
from model_training.training.loop import Progress, TrainingConfig, load_run, train
from model_training.training.packs import make_packs
from model_training.training.precision import native_precision
from model_training.training.recipe import stock_plans
from research.baselines.learning import one_thread
from service.imaging.view_grid import ViewGrid

CITIES = 26


@dataclass(frozen=True)
class Variation:
    """One change of the recipe.

    Attributes:
        changed: changed fields of ``TrainingConfig``.
        cities: number of training cities.
    """

    changed: dict[str, Any] = field(default_factory=dict)
    cities: int = CITIES

    @property
    def blind(self) -> tuple[str, ...]:
        """Planes that queries lack, in training and in the measurement."""
        found: tuple[str, ...] = self.changed.get("blind", ())
        return found


#: Variations by row name. Colour and LiDAR intensity share only brightness; the paper's fusion does not use it.
VARIATIONS = {
    "reference": Variation(),
    "planes.ihs": Variation({"blind": ("brightness",)}),
    "planes.depth_alone": Variation({"blind": ("v1", "v2", "brightness")}),
    "planes.rgb_alone": Variation({"blind": ("range_m", "height_m")}),
    "descriptor.64": Variation({"encoder": {"descriptor": 64}}),
    "descriptor.128": Variation({"encoder": {"descriptor": 128}}),
    "descriptor.512": Variation({"encoder": {"descriptor": 512}}),
    "loss.triplet": Variation({"loss": "triplet"}),
    "cities.2": Variation(cities=2),
    "cities.8": Variation(cities=8),
    "memory": Variation({"memory_after": 300}),
    "look_alikes": Variation({"memory_after": 300, "stale_negatives": False}),
}


def trained(name: str, work: Path, steps: int, report: Callable[[str, int, int], None]) -> Path:
    """Return the ONNX file of a variation; train it if it is absent, and continue a stopped training.

    Args:
        name: name of the variation.
        work: folder for runs and training data.
        steps: training steps.
        report: receives name, step and number of steps.
    """
    variation, run = VARIATIONS[name], work / "runs" / f"{name}-{steps}"
    encoder = run / "encoder.onnx"
    if encoder.exists():
        return encoder
    config = TrainingConfig.model_validate(
        {"steps": steps, "turn_deg": 7.5, "precision": native_precision(), "memory_after": None} | variation.changed
    )
    packs = make_packs(stock_plans(variation.cities), work / "packs", ViewGrid(), report=report)

    def show(progress: Progress) -> None:
        report(name, progress.step, progress.steps)

    with one_thread():  # so that two trainings can run side by side
        train(packs, run, config, device="cpu", report=show)
    export(load_run(run), encoder)
    return encoder
