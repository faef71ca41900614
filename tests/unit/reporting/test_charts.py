"""Charts from numbers."""

import base64
import re
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest

from model_training.reporting.charts import (
    error_curve,
    error_histogram,
    recall_curves,
    reliability,
    series_of,
    side_by_side,
)
from model_training.reporting.pictures import depth_bgr
from service.imaging.view_grid import MAX_RANGE_M

SVG = "{http://www.w3.org/2000/svg}"


def svg_of(drawn: str) -> ElementTree.Element:
    """Return the SVG inside an image of a page."""
    content = re.fullmatch(r'<img class="plot" src="data:image/svg\+xml;base64,([^"]+)" alt="[^"]+">', drawn)
    assert content is not None
    return ElementTree.fromstring(base64.b64decode(content[1]))  # noqa: S314 - we wrote it


def texts_of(svg: ElementTree.Element) -> list[str]:
    return ["".join(each.itertext()).strip() for each in svg.iter(f"{SVG}text")]


def test_a_chart_runs_and_loads_nothing_and_has_a_title(answers_of):
    svg = svg_of(error_curve({"all": answers_of([[0, 0]], [[0.2, 0]])}))
    assert {each.tag for each in svg.iter()} & {f"{SVG}script", f"{SVG}image", f"{SVG}foreignObject"} == set()
    assert not [name for each in svg.iter() for name in each.attrib if name.startswith("on")]
    links = [value for each in svg.iter() for name, value in each.attrib.items() if name.endswith("href")]
    assert all(link.startswith("#") for link in links)
    assert next(svg.iter(f"{SVG}title")).text == "Share of queries within a distance"


def test_the_same_answers_give_the_same_bytes(answers_of):
    runs = {"a": answers_of([[0, 0]] * 3, [[0.2, 0], [4, 0], [9, 0]]), "b": answers_of([[0, 0]], [[0.3, 0]])}
    assert error_curve(runs) == error_curve(runs)
    assert recall_curves(runs) == recall_curves(runs)


def test_series_are_named_where_there_are_several(answers_of):
    p = answers_of([[0, 0]], [[0.2, 0]])
    assert "rain" not in texts_of(svg_of(error_curve({"rain": p})))
    assert {"rain", "$a_b$ <1>"} <= set(texts_of(svg_of(error_curve({"rain": p, "$a_b$ <1>": p}))))


def test_axes_are_in_metres_and_per_cent(answers_of):
    told = texts_of(svg_of(error_curve({"all": answers_of([[0, 0]], [[0.2, 0]])})))
    assert told[:7] == ["0.01", "0.1", "0.5", "1", "5", "20", "100"]
    assert {"0", "100", "distance from the truth, m", "share of queries, %"} <= set(told)


def test_settings_of_the_user_neither_change_nor_matter(answers_of, monkeypatch):
    runs = {"all": answers_of([[0, 0]], [[0.2, 0]])}
    drawn = error_curve(runs)
    monkeypatch.setitem(matplotlib.rcParams, "lines.linewidth", 7.0)
    before = dict(matplotlib.rcParams)
    assert error_curve(runs) == drawn
    assert dict(matplotlib.rcParams) == before


def test_a_histogram_without_answers_is_drawn(answers_of):
    drawn = error_histogram(answers_of([[0, 0]], [[np.nan, np.nan]]))
    assert "0 answers" in drawn
    assert "queries" in texts_of(svg_of(drawn))


def test_each_set_has_its_count_and_its_share_in_words():
    drawn = side_by_side({"rain & fog": (1.0, 0.9, 1.0 - 1e-12), "sun": (0.5, 0.4, 0.6)}, "within 1 m")
    assert "rain &amp; fog 100.0% (90.0% to 100.0%); sun 50.0% (40.0% to 60.0%)" in drawn
    assert texts_of(svg_of(drawn))[:2] == ["1", "2"]


def test_the_shares_within_distances_are_in_words(answers_of):
    drawn = error_curve({"all": answers_of([[0, 0]] * 4, [[0.2, 0], [0.8, 0], [3, 0], [np.nan, np.nan]])})
    assert "25.0% within 0.5 m; 50.0% within 1 m; 75.0% within 5 m" in drawn


def test_recall_is_reported_at_one_five_and_ten_places(answers_of):
    p = answers_of([[0, 0], [0, 0]], [[9, 0], [1, 0]])
    p.ranked_xy[0, 4] = (2.0, 0.0)
    assert "50.0% at one place, 100.0% at five, 100.0% at ten" in recall_curves({"all": p})


def test_calibration_error_is_the_mean_gap_between_confidence_and_truth(answers_of):
    p = answers_of([[0, 0]] * 4, [[0.5, 0], [9, 0], [0.5, 0], [0.5, 0]], confidence=[0.75, 0.75, 1.0, 1.0])
    drawn = reliability(p)
    assert drawn is not None
    assert drawn[1] == pytest.approx(0.125)


def test_without_confidence_there_is_no_reliability(answers_of):
    assert reliability(answers_of([[0, 0]], [[0, 0]])) is None


def test_sets_are_drawn_while_there_are_colours_for_them(answers_of):
    p = answers_of([[0, 0]], [[0, 0]])
    assert list(series_of({"a": p})) == ["all queries"]
    assert list(series_of({"a": p, "b": p})) == ["all queries", "a", "b"]
    assert list(series_of({str(k): p for k in range(9)})) == ["all queries"]


def test_depth_that_was_not_measured_is_grey_and_near_is_brighter_than_far():
    picture = depth_bgr(np.array([[0.0, 2.0, np.nan, MAX_RANGE_M]], np.float32).repeat(2, axis=0), width=4)
    assert (picture[0, [0, 2]] == 128).all()
    assert int(picture[0, 1].sum()) > int(picture[0, 3].sum())
