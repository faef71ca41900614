import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.confidence.features import FEATURES, RIVALRY, UNWEIGHED
from service.errors import BundleError
from service.maps.calibration import Calibration, Logistic, expanded, probability, read_calibration, terms
from service.maps.content import UNCALIBRATED

COUNT, NOISE = len(FEATURES), FEATURES.index("log_noise")
TERMS = COUNT + COUNT * (COUNT + 1) // 2
PATH = "maps/town/calibration.json"
SITE = {"offset": -1.0, "queries": 200, "right": 150, "expected_calibration_error": 0.02}


def read(document):
    return read_calibration(document if isinstance(document, bytes) else json.dumps(document).encode(), path=PATH)


def refused(document, what):
    with pytest.raises(BundleError, match=f"^{PATH}: .*{what}.*; build the map again with this release$") as error:
        read(document)
    assert error.value.field == "calibration.json"


@pytest.fixture
def document(calibration_json):
    """To spoil."""
    return json.loads(json.dumps(calibration_json()))


def one_hot(size, **values):
    found = np.zeros(size)
    for index, value in values.items():
        found[int(index[1:])] = value
    return found


def test_what_is_written_is_read_again(document):
    rng = np.random.default_rng(3)
    for name in ("right", "known"):
        document[name] = {
            "mean": rng.normal(size=COUNT).tolist(), "spread": rng.uniform(0.1, 9, COUNT).tolist(),
            "weights": rng.normal(size=TERMS).tolist(), "bias": float(rng.normal()),
        }  # fmt: skip
    document["site"] = SITE
    calibration = read(document)
    assert json.loads(calibration.model_dump_json()) == document
    again = read(calibration.model_dump_json().encode())
    assert again == calibration
    evidence = rng.normal(size=(50, COUNT))
    np.testing.assert_array_equal(again.confidence(evidence), calibration.confidence(evidence))


def test_a_map_that_says_it_is_not_calibrated_has_no_calibration():
    assert read({"calibrated": False, "why": "the encoder is one's own"}) is None
    assert read({"calibrated": False}) is None
    assert read(dict(UNCALIBRATED)) is None


@pytest.mark.parametrize(
    ("text", "what"),
    [(text, "not valid JSON") for text in (b"", b"{", b"\xff\xfe", b"\x00", b"[" * 100_000)]
    + [(text, "the field calibrated is missing or not a boolean") for text in (
        b"{}", b"[]", b"null", b"false", b'"calibrated"', b'{"calibrated": null}', b'{"calibrated": 0}', b'{"calibrated": "false"}')]
    + [(b'{"calibrated": true, "why": "x"}', "features: Field required")],
)  # fmt: skip
def test_a_document_that_is_neither_is_refused_with_the_file_the_reason_and_what_to_do(text, what):
    with pytest.raises(BundleError) as error:
        read(text)
    assert error.value.message == f"{PATH}: {what}; build the map again with this release"
    assert error.value.field == "calibration.json"


@pytest.mark.parametrize("features", [FEATURES[:-1], (*FEATURES, "more"), ()])
def test_a_calibration_of_another_number_of_features_is_refused(document, features):
    refused(document | {"features": list(features)}, f"right: mean and spread need {len(features)} numbers")


def test_thresholds_that_do_not_rise_are_refused(document):
    refused(
        document | {"thresholds": document["thresholds"][::-1]}, "thresholds must be sorted by rising false-accept rate"
    )


def test_a_calibration_without_thresholds_is_refused(document):
    refused(document | {"thresholds": []}, "thresholds")


@pytest.mark.parametrize(("name", "length"), [("mean", COUNT - 1), ("spread", COUNT + 1), ("weights", COUNT)])
@pytest.mark.parametrize("part", ["right", "known"])
def test_a_regression_of_another_length_is_refused(document, part, name, length):
    document[part][name] = [1.0] * length
    refused(document, f"{part}: mean and spread need {COUNT} numbers, weights {TERMS}")


@pytest.mark.parametrize("spread", [0.0, -1.0])
def test_a_spread_that_is_none_is_refused(document, spread):
    document["right"]["spread"][3] = spread
    refused(document, "right: .*spread must be positive")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("right", "bias"), "much"), (("right", "weights", 0), None), (("known", "mean", 2), "NaN"), (("more",), 1), (("right", "more"), 1),
        (("thresholds", 0, "confidence"), 1.1), (("thresholds", 0, "confidence"), -0.1), (("thresholds", 0, "false_accept_rate"), 0.0),
        (("thresholds", 1, "false_accept_rate"), 1.0), (("site", "offset"), 1e-9), (("site", "offset"), None),
        (("site", "slope"), 1.0), (("site", "queries"), -1), (("site", "right"), -1), (("site", "expected_calibration_error"), 2.0),
    ],
)  # fmt: skip
def test_a_number_that_makes_no_sense_is_refused_and_named(document, path, value):
    document["site"] = dict(SITE)
    read(document)
    *parents, last = path
    at = document
    for step in parents:
        at = at[step]
    at[last] = value
    refused(document, r"\.".join(str(step) for step in path))


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_numbers_that_are_none_are_refused(document, number):
    document["right"]["bias"] = 123456.0
    refused(json.dumps(document).replace("123456.0", number).encode(), "")


def test_features_enter_in_their_spreads_and_multiplied_by_two():
    """Of three features, each 7 at its mean and 2 a deviation: one, minus three and a half deviations."""
    found = expanded(np.array([9.0, 1.0, 8.0]), (7.0, 7.0, 7.0), (2.0, 2.0, 2.0))
    assert terms(3) == ((0,), (1,), (2,), (0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    np.testing.assert_allclose(found, [1, -3, 0.5, 1, -3, 0.5, 9, -1.5, 0.25])


@pytest.mark.parametrize("count", [1, 4, COUNT])
def test_every_term_is_the_product_of_the_features_that_it_names(count):
    evidence = np.random.default_rng(count).uniform(-2, 2, (5, count))
    found = expanded(evidence, (0.0,) * count, (1.0,) * count)
    named = np.stack([evidence[:, list(term)].prod(axis=1) for term in terms(count)], axis=1)
    np.testing.assert_allclose(found, named)
    assert len(set(terms(count))) == count + count * (count + 1) // 2


@pytest.mark.parametrize(
    ("margin", "noise", "expected"),
    [
        (0.0, 0.0, 0.5),  # all at their means: the bias alone
        (2.0, 0.0, 0.5 + 10 * 2 + 100 * 4),
        (-2.0, 0.0, 0.5 - 10 * 2 + 100 * 4),
        (2.0, 3.0, 0.5 + 10 * 2 + 100 * 4 + 1000 * 6),
        (2.0, -1.0, 0.5 + 10 * 2 + 100 * 4 - 1000 * 2),
        (9.0, 0.0, 0.5 + 10 * 4 + 100 * 16),  # no further than four deviations
        (-9.0, 9.0, 0.5 - 10 * 4 + 100 * 16 - 1000 * 16),
        (1e300, 0.0, 0.5 + 10 * 4 + 100 * 16),
    ],
)
def test_log_odds_by_hand(margin, noise, expected):
    """The margin has weight 10, its square 100, its product with the noise 1000; a deviation is 4 units above 7."""
    square, product = terms(COUNT).index((0, 0)), terms(COUNT).index((0, NOISE))
    weights = one_hot(TERMS, **{"_0": 10.0, f"_{square}": 100.0, f"_{product}": 1000.0})
    mean, spread = one_hot(COUNT, _0=7.0), np.ones(COUNT) + one_hot(COUNT, _0=3.0)
    logistic = Logistic(mean=tuple(mean), spread=tuple(spread), weights=tuple(weights), bias=0.5)
    evidence = one_hot(COUNT, _0=7.0 + 4.0 * margin) + one_hot(COUNT, **{f"_{NOISE}": noise})
    assert float(logistic.log_odds(evidence)) == pytest.approx(expected)
    np.testing.assert_allclose(logistic.log_odds(np.stack([evidence, mean])), [expected, 0.5])


@pytest.mark.parametrize(
    ("odds", "expected"), [(0.0, 0.5), (np.log(3), 0.75), (-np.log(3), 0.25), (1e9, 1.0), (-1e9, 0.0)]
)
def test_probability_of_log_odds(odds, expected):
    assert float(probability(np.array([odds]))[0]) == pytest.approx(expected, abs=1e-12)


def test_confidence_is_the_probability_of_the_log_odds_and_the_maps_own_correction_comes_after(
    calibration_of, document
):
    """A bias of log 9 is 0.9; 1 less is 0.768; a map where it needs none is not corrected."""
    right = document["right"] | {"bias": float(np.log(9.0))}
    evidence = np.zeros((2, COUNT))
    np.testing.assert_allclose(calibration_of(right=right).confidence(evidence), [0.9, 0.9])
    corrected = 9 / (9 + np.e)
    np.testing.assert_allclose(calibration_of(right=right, site=SITE).confidence(evidence), [corrected] * 2)
    unchanged = calibration_of(right=right, site=SITE | {"offset": 0.0})
    np.testing.assert_allclose(unchanged.confidence(evidence), [0.9, 0.9])


@given(st.floats(-20, 20), st.floats(-20, 0))
@settings(max_examples=25)
def test_a_maps_own_correction_never_raises_confidence(calibration_of, calibration_json, bias, offset):
    right, evidence = calibration_json()["right"] | {"bias": bias}, np.zeros(COUNT)
    corrected = calibration_of(right=right, site=SITE | {"offset": offset}).confidence(evidence)
    assert corrected <= calibration_of(right=right).confidence(evidence)


@given(st.integers(0, 10**6), st.integers(1, 6))
@settings(max_examples=25)
def test_many_answers_get_the_confidence_that_each_gets_alone(calibration_of, seed, count):
    rng = np.random.default_rng(seed)
    right = {
        "mean": rng.normal(size=COUNT).tolist(), "spread": rng.uniform(0.5, 2, COUNT).tolist(),
        "weights": (0.1 * rng.normal(size=TERMS)).tolist(), "bias": 0.1,
    }  # fmt: skip
    calibration, evidence = calibration_of(right=right), rng.normal(size=(count, COUNT))
    together = calibration.confidence(evidence)
    np.testing.assert_allclose(together, [float(calibration.confidence(row)) for row in evidence])
    assert ((together > 0) & (together < 1)).all()


@pytest.mark.parametrize(
    ("rate", "confidence"),
    [(0.001, 0.9), (0.005, 0.8), (0.0049, 0.9), (0.007, 0.8), (0.01, 0.4), (0.5, 0.4), (0.0001, 0.9)],
)
def test_the_threshold_is_that_of_the_greatest_rate_that_is_not_beyond_the_one_asked_for(
    calibration_of, rate, confidence
):
    """Below the least rate that was measured, its threshold is the most cautious there is."""
    rates = {0.001: 0.9, 0.005: 0.8, 0.01: 0.4}
    thresholds = [{"false_accept_rate": each, "confidence": at} for each, at in rates.items()]
    assert calibration_of(thresholds=thresholds).threshold(rate) == confidence


def test_every_feature_has_a_name_of_its_own_and_those_of_rivalry_and_the_unweighed_are_among_them():
    assert len(set(FEATURES)) == COUNT
    assert set(RIVALRY) < set(FEATURES)
    assert set(UNWEIGHED) < set(FEATURES) - set(RIVALRY)


def test_a_calibration_cannot_be_changed(calibration_of):
    calibration = calibration_of()
    assert isinstance(calibration, Calibration)
    with pytest.raises(ValueError, match="frozen"):
        calibration.site = None  # type: ignore[misc]  # that is the point
