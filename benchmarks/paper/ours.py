"""Our method in the comparison: an encoder trained from scratch on the same data, and the stock encoder.

The encoder of ``streetfix`` has the training budget of every learned method. The encoder of ``streetfix_as_paper`` sees
as many images as the paper's 84 iterations show its CNN. Both use the same frames and pairs. The encoder of
``streetfix_stock`` has never seen this city. Every map is built by the normal command. Every answer counts, accepted or
not.
"""

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.data import PaperData, Size, test_set
from benchmarks.paper.kept import SPLITS, MethodResult
from benchmarks.runs import MAPPING, code_hash
from model_training.cli.progress import bars
from model_training.evaluation.predict import predict
from model_training.mapping.build import build_map
from model_training.mapping.settings import BuildSettings
from model_training.stock import ENCODER
from model_training.training.encoder_net import EncoderShape
from model_training.training.export import export
from model_training.training.loop import Progress, TrainingConfig, load_run, train
from model_training.training.packs import rows_seen_by
from model_training.training.precision import native_precision
from research.baselines.answers import PlaceAnswers
from research.baselines.learning import CURVE, CurvePoint, one_thread, read_curve, write_curve
from service.imaging.view_grid import ViewGrid
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle
from service.retrieval.encoder import Encoder

PAPER_IMAGES_SHARE = 4 * 0.7  # four epochs over 70 % of the frames
#: Half the stock encoder's columns, and narrower. One city needs less capacity, and a smaller network sees more images
#: per minute.
SHAPE = EncoderShape(columns=64, widths=(16, 32, 96, 160))

PILOT_STEPS, PILOT_LEFT_OUT = 24, 8  # the first steps read the pack from disk
#: Largest number of steps. After 4,521 steps the loss was 0.03, and 0.99 of the pairs were first in their batch
#: (decision log). More steps gain nothing.
MOST_STEPS = 4600
#: Share of a budget kept for checkpoints, and for a machine that is slower later than during the pilot.
SPARED = 0.07


def config_as_paper(size: Size) -> TrainingConfig:
    """Return settings that show as many images as the paper's iterations show its CNN; small sizes get small batches.

    The training uses no memory of descriptors. For one city alone the memory made the loss rise until the training
    collapsed (decision log).

    Args:
        size: amount of data.
    """
    together = min(TrainingConfig().pairs, size.pairs // 4)
    steps = max(1, round(PAPER_IMAGES_SHARE * size.frames / (2 * together)))
    return TrainingConfig(pairs=together, steps=steps, precision=native_precision(), memory_after=None, encoder=SHAPE)


def config_within(budget_s: float, pack: Path, config: TrainingConfig, run: Path) -> TrainingConfig:
    """Return settings with as many steps as a pilot fits into the budget, up to ``MOST_STEPS``; a run keeps its number.

    Args:
        budget_s: budget, processor seconds.
        pack: folder of the training pack.
        config: settings to change.
        run: folder of the training.
    """
    if (run / "config.json").exists():
        return TrainingConfig.model_validate_json((run / "config.json").read_bytes())
    bought = int((1 - SPARED) * budget_s / seconds_a_step(pack, config))
    return config.model_copy(update={"steps": min(MOST_STEPS, max(1, bought))})


def seconds_a_step(pack: Path, config: TrainingConfig) -> float:
    """Measure the processor time of a training step in seconds, by the first steps of a discarded run.

    Args:
        pack: folder of the training pack.
        config: settings of the training.
    """
    pilot, seen = config.model_copy(update={"steps": PILOT_STEPS}), list[float]()
    with tempfile.TemporaryDirectory() as folder, one_thread():
        train([pack], Path(folder), pilot, device="cpu", report=lambda _: seen.append(time.process_time()))
    return (seen[-1] - seen[PILOT_LEFT_OUT]) / (PILOT_STEPS - 1 - PILOT_LEFT_OUT)


def pack_of(data: PaperData, shape: EncoderShape) -> Path:
    """Write frames and pairs as a training pack with an encoder's columns: all columns, or every second one.

    Every second column of a query lies a quarter of a column to the left of the column of a coarser grid. This offset
    is smaller than the turns that training draws.

    Args:
        data: shared data.
        shape: shape of the encoder.
    """
    folder = data.work / f"pack2-paper-0-{data.size.frames}x{data.size.pairs}-{shape.columns}"
    if folder.exists():
        return folder
    part = folder.with_name(folder.name + ".part")
    frames, pairs = data.frames, data.pairs
    every = ViewGrid().columns // shape.columns
    part.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, NDArray[Any]] = {
        "panoramas": frames.panoramas[..., ::every],
        "intensities": frames.intensities[..., ::every],
        "places": frames.places,
        "rows_seen": rows_seen_by(frames.panoramas),
        "ranges": pairs.ranges[..., ::every],
        "rgb": pairs.colours[:, :, ::every],
        "queries": pairs.views,
    }
    for name, array in arrays.items():
        np.save(part / f"{name}.npy", array)
    part.rename(folder)
    return folder


def streetfix(data: PaperData, budget_s: float | None) -> MethodResult:
    """Train on the comparison's data, build the map and answer both tests.

    Args:
        data: shared data.
        budget_s: budget, processor seconds; None shows the paper's number of images.
    """
    method = "streetfix_as_paper" if budget_s is None else "streetfix"
    run, config = data.work / "runs" / method, config_as_paper(data.size)
    pack = pack_of(data, config.encoder)
    if budget_s is not None:
        config = config_within(budget_s, pack, config, run)
    path = run / CURVE
    curve = read_curve(path)
    before, began = (curve[-1].processor_s if curve else 0.0), time.process_time()

    def note(progress: Progress) -> None:
        """Add a point to the curve.

        A resumed run drops the points after its checkpoint, but keeps their time.

        Args:
            progress: state of the training.
        """
        if progress.step % 10 == 0 or progress.step == progress.steps:
            images, spent = progress.step * 2 * config.pairs, before + time.process_time() - began
            curve[:] = [point for point in curve if point.images < images]
            curve.append(CurvePoint(images, spent, progress.loss, progress.accuracy))
            write_curve(path, curve)
        show("training", progress.step, progress.steps)

    with one_thread(), bars() as show:
        train([pack], run, config, device="cpu", report=note)
    encoder = run / "encoder.onnx"
    if not encoder.exists():
        export(load_run(run), encoder)
    shape = config.encoder
    told = {
        "cells": [shape.rows, shape.columns],
        "widths": list(shape.widths),
        "steps": config.steps,
        "pairs": config.pairs,
    }
    return MethodResult(
        method,
        _answers(data, encoder),
        curve[-1].processor_s,
        config.steps * 2 * config.pairs,
        data.size.frames + data.size.pairs,
        f"{config.steps} steps",
        curve,
        told,
    )


def streetfix_stock(data: PaperData) -> MethodResult:
    """Answer both tests by the stock encoder, which has seen only other cities.

    Args:
        data: shared data.
    """
    return MethodResult(
        "streetfix_stock", _answers(data, ENCODER), None, ended="trained beforehand, on 26 other cities"
    )


def _answers(data: PaperData, encoder: Path) -> dict[str, PlaceAnswers]:
    bundle = bundle_of(data, encoder)
    localizer, found = Localizer.open(bundle), {}
    for split in SPLITS:
        with bars() as report:
            asked = predict(localizer, data.dataset, test_set(split), report=report)
        found[split] = PlaceAnswers(asked.T_answer[:, :2, 3], asked.street_answer)
    return found


def bundle_of(data: PaperData, encoder: Path) -> MapBundle:
    """Build the map of the comparison's survey, once for each encoder, spacing and version of the code.

    Args:
        data: shared data.
        encoder: ONNX file of the encoder.
    """
    spacing_m = data.size.spacing_m
    name = f"{data.dataset.folder.name}-{spacing_m:g}-{Encoder.open(encoder).sha256[:12]}-{code_hash(*MAPPING)}"
    folder = data.work / "maps" / name
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with bars() as report:
            build_map(
                data.dataset,
                encoder,
                folder,
                BuildSettings(name="paper-city", spacing_m=spacing_m, between_m=3 * spacing_m),
                report=report,
            )
    return MapBundle.open(folder)
