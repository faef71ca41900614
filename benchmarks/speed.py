"""Cost of registration: all hypotheses and their verification, on one core."""

import time
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.plans import BOTH, unseen_plan
from benchmarks.report import Report
from benchmarks.runs import Runs
from service.localization.localizer import Localizer
from service.retrieval.encoder import Encoder
from service.retrieval.query import Query

QUERIES = 100
BARS_MS = {"precise": 25.0, "stereo": 40.0}


def speed_rows(report: Report, runs: Runs) -> None:
    """Add the median processor time of the stage: with registration minus without, for the same query.

    Args:
        report: collects the rows.
        runs: simulates, builds and answers, or reuses what is kept on disk.
    """
    dataset = runs.dataset(unseen_plan(0))
    bundle = runs.bundle(dataset)
    localizer = Localizer(bundle, Encoder.open(bundle.encoder_bytes(), threads=1))
    for preset in BOTH:
        times = []
        frames = list(dataset.queries(f"drive1_{preset}"))[:QUERIES]
        with threadpool_limits(1):  # as in a service: waiting threads spin, and their time would count
            for frame in frames:
                query = frame.query(bundle.grid)
                times.append(_spent_ms(localizer, query) - _spent_ms(localizer, replace(query, refine=False)))
        row = f"registration.cpu_ms_per_query.{preset}"
        report.row(row, float(np.median(times)), "ms", bar=BARS_MS[preset], better="lower", n=len(times))


def _spent_ms(localizer: Localizer, query: Query) -> float:
    began = time.process_time()
    localizer.localize(query)
    return 1e3 * (time.process_time() - began)
