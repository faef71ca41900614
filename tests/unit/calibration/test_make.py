import re

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `training`")

from model_training.calibration.fit import Asked, fit, pooled  # after the skip
from model_training.calibration.make import confidences, cross_checks
from service.maps.calibration import FEATURES

COUNT, MARGIN = len(FEATURES), FEATURES.index("margin")


def city(seed, *, upside_down=False, count=1200):
    """Right where the margin is positive, but for chance; three sorts of queries, both presets."""
    rng = np.random.default_rng(seed)
    evidence = rng.normal(size=(count, COUNT))
    sort = rng.integers(0, 3, count)
    evidence[:, MARGIN] += np.where(sort == 0, 3.0, -3.0)
    known = sort == 0
    right = known & (rng.random(count) < 0.9)
    if upside_down:
        evidence[:, MARGIN] *= -1
    presets = np.where(rng.random(count) < 0.5, "precise", "stereo")
    names = np.array(["clear_", "other_city.", "removed_streets."])[sort]
    return Asked(evidence, right, known, np.char.add(names, presets))


def test_confidence_is_the_calibrations_and_nothing_where_nothing_was_registered():
    asked = city(1)
    calibration = fit(asked, measured_on={})
    asked.evidence[5] = np.nan
    found = confidences(calibration, asked)
    assert found[5] == 0
    rest = np.arange(len(asked)) != 5
    np.testing.assert_allclose(found[rest], calibration.confidence(asked.evidence[rest]))


def test_every_city_is_predicted_from_the_others_with_both_presets():
    lines = cross_checks([city(1), city(2), city(3)])
    assert len(lines) == 9
    for index in range(3):
        head, *presets = lines[3 * index : 3 * index + 3]
        error = re.fullmatch(rf"city {index + 1} from the others: expected calibration error (0\.\d{{4}})", head)
        assert float(error[1]) < 0.1
        for preset, line in zip(("precise", "stereo"), presets, strict=True):
            shares = re.fullmatch(
                rf"  {preset}: false accepts at 95 % of the true ones: other_city (0\.\d{{4}}), removed_streets (0\.\d{{4}})",
                line,
            )
            assert max(float(shares[1]), float(shares[2])) < 0.05


def test_a_city_is_not_predicted_from_itself():
    """The second contradicts the first: each is predicted as wrongly as can be, however well it fits itself."""
    one, other = city(1), city(2, upside_down=True)
    heads = [line for line in cross_checks([one, other]) if line.startswith("city")]
    assert min(float(line.rsplit(" ", 1)[1]) for line in heads) > 0.3
    assert len(pooled([one, other])) == 2400
