import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.confidence.features import FEATURES, RIVALRY, UNWEIGHED
from service.errors import BundleError
from service.maps.calibration import AdditiveModel, Calibration, Term, probability, read_calibration
from service.maps.content import UNCALIBRATED

COUNT = len(FEATURES)
PATH = "maps/town/calibration.json"
REMEDY = "renew the calibration with `streetfix calibrate --map MAP --calibration stock`, or build the map again with this release"
SITE = {"offset": -1.0, "queries": 200, "right": 150, "expected_calibration_error": 0.02}


def read(document):
    return read_calibration(document if isinstance(document, bytes) else json.dumps(document).encode(), path=PATH)


def refused(document, what):
    with pytest.raises(BundleError, match=f"^{PATH}: .*{what}.*; {REMEDY}$") as error:
        read(document)
    assert error.value.field == "calibration.json"


@pytest.fixture
def document(calibration_json):
    """Return a valid document that a test then damages."""
    return json.loads(json.dumps(calibration_json()))


def random_terms(rng, scale=1.0):
    """Return a term with three knots for every feature."""
    return [
        {
            "feature": name,
            "knots": (np.array([-1.0, 0.0, 1.0]) + rng.uniform(-0.4, 0.4, 3)).tolist(),
            "log_odds": rng.normal(0, scale, 3).tolist(),
        }
        for name in FEATURES
    ]


def test_written_values_are_read_again(document):
    rng = np.random.default_rng(3)
    for name in ("right", "known"):
        document[name] = {"terms": random_terms(rng), "bias": float(rng.normal())}
    for row in document["features"]:
        row |= {"mean": float(rng.normal()), "std": float(rng.uniform(0.1, 9))}
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
    + [
        (text, "the field calibrated is missing or not a boolean")
        for text in (
            b"{}",
            b"[]",
            b"null",
            b"false",
            b'"calibrated"',
            b'{"calibrated": null}',
            b'{"calibrated": 0}',
            b'{"calibrated": "false"}',
        )
    ]
    + [(b'{"calibrated": true, "why": "x"}', "features: Field required")],
)
def test_a_document_that_is_neither_is_refused_with_the_file_the_reason_and_what_to_do(text, what):
    with pytest.raises(BundleError) as error:
        read(text)
    assert error.value.message == f"{PATH}: {what}; {REMEDY}"
    assert error.value.field == "calibration.json"


def test_a_term_of_an_unknown_feature_is_refused(document):
    document["known"]["terms"] = [{"feature": "weather", "knots": [0, 1], "log_odds": [0, 1]}]
    refused(document, "known: weather is not one of the features")


def test_a_calibration_without_features_is_refused(document):
    refused(document | {"features": []}, "features")


def test_thresholds_that_do_not_rise_are_refused(document):
    refused(
        document | {"thresholds": document["thresholds"][::-1]}, "thresholds must be sorted by rising false-accept rate"
    )


def test_a_calibration_without_thresholds_is_refused(document):
    refused(document | {"thresholds": []}, "thresholds")


@pytest.mark.parametrize(
    ("knots", "log_odds", "what"),
    [
        ([0.0, 1.0], [0.0], "margin: 2 knots need as many log_odds, not 1"),
        ([0.0, 0.0], [0.0, 1.0], "margin: knots must rise"),
        ([0.0, 2.0, 1.0], [0.0, 1.0, 2.0], "margin: knots must rise"),
        ([0.0], [0.0], "knots: Tuple should have at least 2 items"),
    ],
)
@pytest.mark.parametrize("part", ["right", "known"])
def test_a_term_that_is_no_function_is_refused(document, part, knots, log_odds, what):
    document[part]["terms"] = [{"feature": "margin", "knots": knots, "log_odds": log_odds}]
    refused(document, what)


def test_two_terms_of_one_feature_are_refused(document):
    document["right"]["terms"] = 2 * [{"feature": "margin", "knots": [0, 1], "log_odds": [0, 1]}]
    refused(document, "a feature has two terms")


@pytest.mark.parametrize("std", [0.0, -1.0])
def test_a_standard_deviation_that_is_not_positive_is_refused(document, std):
    document["features"][3]["std"] = std
    refused(document, "features.3.std")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("right", "bias"), "much"),
        (("right", "terms"), None),
        (("features", 2, "mean"), "NaN"),
        (("more",), 1),
        (("right", "more"), 1),
        (("thresholds", 0, "confidence"), 1.1),
        (("thresholds", 0, "confidence"), -0.1),
        (("thresholds", 0, "false_accept_rate"), 0.0),
        (("thresholds", 1, "false_accept_rate"), 1.0),
        (("site", "offset"), 1e-9),
        (("site", "offset"), None),
        (("site", "slope"), 1.0),
        (("site", "queries"), -1),
        (("site", "right"), -1),
        (("site", "expected_calibration_error"), 2.0),
    ],
)
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


@pytest.mark.parametrize(
    ("margin", "noise", "expected"),
    [
        (0.0, 0.0, 0.5),  # the bias alone
        (1.0, 0.0, 0.5 + 10.0),
        (2.0, 0.0, 0.5 + 20.0),
        (3.0, 0.0, 0.5 + 20.5),  # halfway to the last knot
        (4.0, 0.0, 0.5 + 21.0),
        (1e300, 0.0, 0.5 + 21.0),  # constant beyond it
        (-1e300, 0.0, 0.5),
        (2.0, 1.0, 0.5 + 20.0 - 100.0),
    ],
)
def test_log_odds_by_hand(calibration_of, margin, noise, expected):
    """The margin contributes 10 per unit up to 2 and 0.5 per unit up to 4. The noise contributes -100 per unit."""
    terms = [
        {"feature": "margin", "knots": [0.0, 2.0, 4.0], "log_odds": [0.0, 20.0, 21.0]},
        {"feature": "log_noise", "knots": [-1.0, 1.0], "log_odds": [100.0, -100.0]},
    ]
    calibration = calibration_of(right={"terms": terms, "bias": 0.5})
    evidence = np.zeros(COUNT)
    evidence[FEATURES.index("margin")], evidence[FEATURES.index("log_noise")] = margin, noise
    assert float(calibration.log_odds("right", evidence)) == pytest.approx(expected)
    both = calibration.log_odds("right", np.stack([evidence, np.zeros(COUNT)]))
    np.testing.assert_allclose(both, [expected, 0.5])


@given(st.integers(0, 10**6))
@settings(max_examples=25)
def test_a_rising_term_never_lowers_the_log_odds(calibration_of, seed):
    rng = np.random.default_rng(seed)
    term = Term(feature="margin", knots=(-1.0, 0.5, 3.0), log_odds=tuple(np.sort(rng.normal(size=3)).tolist()))
    calibration = calibration_of(right=AdditiveModel(terms=(term,), bias=0.0).model_dump())
    evidence = np.zeros((9, COUNT))
    evidence[:, FEATURES.index("margin")] = np.sort(rng.normal(0, 3, 9))
    assert (np.diff(calibration.log_odds("right", evidence)) >= 0).all()


def test_deviations_are_in_standard_deviations_from_the_mean(calibration_of, document):
    document["features"][FEATURES.index("margin")] |= {"mean": 7.0, "std": 2.0}
    evidence = np.zeros(COUNT)
    evidence[FEATURES.index("margin")] = 10.0
    found = calibration_of(features=document["features"]).deviations(evidence)
    np.testing.assert_allclose(found, np.where(np.array(FEATURES) == "margin", 1.5, 0.0))


@pytest.mark.parametrize(
    ("odds", "expected"), [(0.0, 0.5), (np.log(3), 0.75), (-np.log(3), 0.25), (1e9, 1.0), (-1e9, 0.0)]
)
def test_probability_of_log_odds(odds, expected):
    assert float(probability(np.array([odds]))[0]) == pytest.approx(expected, abs=1e-12)


def test_confidence_is_the_probability_of_the_log_odds_and_the_maps_own_correction_comes_after(
    calibration_of, document
):
    """A bias of log 9 is 0.9, and log 9 - 1 is 0.768. A map without a correction stays as it is."""
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
    right = {"terms": random_terms(rng, 0.1), "bias": 0.1}
    calibration, evidence = calibration_of(right=right), rng.normal(size=(count, COUNT))
    together = calibration.confidence(evidence)
    np.testing.assert_allclose(together, [float(calibration.confidence(row)) for row in evidence])
    assert ((together > 0) & (together < 1)).all()


@pytest.mark.parametrize(
    ("rate", "confidence"),
    [(0.001, 0.9), (0.005, 0.8), (0.0049, 0.9), (0.007, 0.8), (0.01, 0.6), (0.02, 0.5), (0.5, 0.5), (0.0001, 0.9)],
)
def test_the_threshold_is_that_of_the_largest_rate_not_above_the_requested_one(calibration_of, rate, confidence):
    """Below the smallest measured rate, the threshold is the strictest one. No threshold accepts what is more likely wrong than right."""
    rates = {0.001: 0.9, 0.005: 0.8, 0.01: 0.6, 0.02: 0.3}
    thresholds = [{"false_accept_rate": each, "confidence": at} for each, at in rates.items()]
    assert calibration_of(thresholds=thresholds).threshold(rate) == confidence


def test_every_feature_has_a_name_of_its_own_and_the_groups_name_features():
    assert len(set(FEATURES)) == COUNT
    assert set(RIVALRY) < set(FEATURES)
    assert set(UNWEIGHED) < set(FEATURES)
    assert set(RIVALRY) - set(UNWEIGHED)


def test_a_calibration_cannot_be_changed(calibration_of):
    calibration = calibration_of()
    assert isinstance(calibration, Calibration)
    with pytest.raises(ValueError, match="frozen"):
        calibration.site = None  # type: ignore[misc]  # that is the point
