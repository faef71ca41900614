"""Our method in the comparison: an encoder trained from nothing on the same data, and the one that is shipped.

The encoder of ``streetfix`` is trained for the budget that every learned method has, that of ``streetfix_as_paper`` sees as many
images as the paper's 84 iterations show its CNN; both of the same frames and pairs. The one of ``streetfix_stock`` has never
seen this city. Every map is built as any user builds one; every answer counts, accepted or not.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.paper.data import PaperData, Size, test_set
from benchmarks.paper.kept import SPLITS, MethodResult
from benchmarks.runs import MAPPING, code_hash
from model_training.baselines.answers import PlaceAnswers
from model_training.baselines.learning import CURVE, CurvePoint, one_thread, read_curve, write_curve
from model_training.cli.progress import bars
from model_training.evaluation.predict import predict
from model_training.mapping.build import BuildSettings, build_map
from model_training.stock import ENCODER
from model_training.training.encoder_net import EncoderShape
from model_training.training.export import export
from model_training.training.loop import Progress, TrainingConfig, load_run, train
from model_training.training.packs import rows_seen_by
from model_training.training.precision import native_precision
from service.imaging.view_grid import ViewGrid
from service.localization.encoder import Encoder
from service.localization.localizer import Localizer
from service.maps.reader import MapBundle

PAPER_IMAGES_SHARE = 4 * 0.7  # four epochs over 70 % of the frames
#: Half the stock encoder's columns and narrower: one city asks less of it than any city, and it learns from more images a minute.
SHAPE = EncoderShape(columns=64, widths=(16, 32, 96, 160))

PILOT_STEPS, PILOT_LEFT_OUT = 24, 8  # the first steps read the pack from disk
MOST_STEPS = 4600  # after 4,521 the loss was 0.03 and 0.99 of the pairs were first in their batch (decision log): nothing is left to gain
SPARED = 0.07  # of a budget: checkpoints, and a machine that is slower later than during the pilot


def config_as_paper(size: Size) -> TrainingConfig:
    """As many optimiser steps as show the images that the paper's iterations show its CNN; small sizes have small batches.

    Without a memory of descriptors: of one city alone it made the loss rise until nothing was left (decision log).
    """
    together = min(TrainingConfig().pairs, size.pairs // 4)
    steps = max(1, round(PAPER_IMAGES_SHARE * size.frames / (2 * together)))
    return TrainingConfig(pairs=together, steps=steps, precision=native_precision(), memory_after=None, encoder=SHAPE)


def config_within(budget_s: float, pack: Path, config: TrainingConfig, run: Path) -> TrainingConfig:
    """As many steps as a budget of processor time buys, told by a pilot, but no more than help; a run that began keeps its number."""
    if (run / "config.json").exists():
        return TrainingConfig.model_validate_json((run / "config.json").read_bytes())
    bought = int((1 - SPARED) * budget_s / seconds_a_step(pack, config))
    return config.model_copy(update={"steps": min(MOST_STEPS, max(1, bought))})


def seconds_a_step(pack: Path, config: TrainingConfig) -> float:
    """Processor time of a step of training, by the first ones of a run that is thrown away."""
    pilot, seen = config.model_copy(update={"steps": PILOT_STEPS}), list[float]()
    with tempfile.TemporaryDirectory() as folder, one_thread():
        train([pack], Path(folder), pilot, device="cpu", report=lambda _: seen.append(time.process_time()))
    return (seen[-1] - seen[PILOT_LEFT_OUT]) / (PILOT_STEPS - 1 - PILOT_LEFT_OUT)


def pack_of(data: PaperData, shape: EncoderShape) -> Path:
    """The comparison's frames and pairs as a training pack with the columns of an encoder: all of the shared data's, or every second one.

    Every second column of a query lies a quarter of a column to the left of where a grid of half the columns has its own: less
    than the turns that training draws.
    """
    folder = data.work / f"pack2-paper-0-{data.size.frames}x{data.size.pairs}-{shape.columns}"
    if folder.exists():
        return folder
    part = folder.with_name(folder.name + ".part")
    frames, pairs = data.frames, data.pairs
    every = ViewGrid().columns // shape.columns
    part.mkdir(parents=True, exist_ok=True)
    arrays = {
        "panoramas": frames.panoramas[..., ::every], "intensities": frames.intensities[..., ::every], "places": frames.places,
        "rows_seen": rows_seen_by(frames.panoramas), "ranges": pairs.ranges[..., ::every], "rgb": pairs.colours[:, :, ::every],
        "queries": pairs.views,
    }  # fmt: skip
    for name, array in arrays.items():
        np.save(part / f"{name}.npy", array)
    part.rename(folder)
    return folder


def streetfix(data: PaperData, budget_s: float | None) -> MethodResult:
    """Train on the comparison's data within a budget, None: on the paper's number of images; build the map, answer both tests."""
    method = "streetfix_as_paper" if budget_s is None else "streetfix"
    run, config = data.work / "runs" / method, config_as_paper(data.size)
    pack = pack_of(data, config.encoder)
    if budget_s is not None:
        config = config_within(budget_s, pack, config, run)
    path = run / CURVE
    curve = read_curve(path)
    before, began = (curve[-1].processor_s if curve else 0.0), time.process_time()

    def note(progress: Progress) -> None:
        """A point of the curve; what was noted after the checkpoint that a run goes on from is left out, its time is not."""
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
        method, _answers(data, encoder), curve[-1].processor_s, config.steps * 2 * config.pairs,
        data.size.frames + data.size.pairs, f"{config.steps} steps", curve, told,
    )  # fmt: skip


def streetfix_stock(data: PaperData) -> MethodResult:
    """The shipped encoder, which knows other cities alone."""
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
    """The map of the comparison's survey at 1 m, built once for each encoder and code."""
    name = f"{data.dataset.folder.name}-{Encoder.open(encoder).sha256[:12]}-{code_hash(*MAPPING)}"
    folder = data.work / "maps" / name
    if not folder.exists():
        folder.parent.mkdir(parents=True, exist_ok=True)
        with bars() as report:
            build_map(data.dataset, encoder, folder, BuildSettings(name="paper-city"), report=report)
    return MapBundle.open(folder)
