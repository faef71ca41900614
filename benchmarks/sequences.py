"""Several frames as one question: a street of repeating blocks."""

import numpy as np

from benchmarks.plans import SEQUENCE, repeating_plan
from benchmarks.report import Report
from benchmarks.runs import Runs, accepted_within
from model_training.simulation.repeating import landmarks_m

PASSED_M, FAR_M = 18.0, 58.0  # a landmark's middle this near is passed; so far away it cannot be seen


def sequence_rows(report: Report, runs: Runs) -> None:
    """Sequences that pass a landmark are told apart, those that pass none are said to be ambiguous."""
    dataset = runs.dataset(repeating_plan())
    found = runs.predictions(runs.bundle(dataset), dataset, "sequences_precise", frames_each=SEQUENCE)
    x = found.T_true[:, 0, 3]
    away = np.abs(x[:, None] - landmarks_m()).min(axis=1)
    inside = np.abs(x) < landmarks_m().max() + PASSED_M  # the street's ends tell where they are
    passed, far = away <= PASSED_M, (away >= FAR_M) & inside
    report.share("sequence.landmark.within_1_m", accepted_within(found, 1.0)[passed], bar=0.99)
    report.share("sequence.no_landmark.ambiguous", found.status[far] == "AMBIGUOUS", bar=0.95)
    report.share("sequence.no_landmark.wrong_and_accepted", (found.localized & ~accepted_within(found, 1.0))[far])
