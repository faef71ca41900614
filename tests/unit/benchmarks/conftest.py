from collections.abc import Callable

import numpy as np
import pytest

from model_training.evaluation.predict import RANKED, Predictions
from service.confidence.features import FEATURES


def make_predictions(T_true, T_answer=None, *, confidence=0.5, localized=True) -> Predictions:
    T_true = np.array(T_true, np.float64)
    count = len(T_true)
    T_answer = T_true.copy() if T_answer is None else np.array(T_answer, np.float64)
    return Predictions(
        T_true,
        T_answer,
        np.zeros(count, int),
        np.zeros(count, int),
        np.zeros((count, RANKED, 2)),
        np.zeros((count, RANKED), int),
        np.where(np.broadcast_to(localized, count), "LOCALIZED", "AMBIGUOUS"),
        np.broadcast_to(np.float64(confidence), count),
        np.zeros((count, len(FEATURES))),
        np.tile(np.eye(6), (count, 1, 1)),
        np.zeros(count),
        np.zeros(count),
    )


@pytest.fixture(scope="session")
def predictions_of() -> Callable[..., Predictions]:
    return make_predictions
