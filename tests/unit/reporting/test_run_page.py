"""``index.html`` of a run."""

import re

import numpy as np
import pytest

from model_training.evaluation.failures import stages, worst
from model_training.evaluation.saved_run import SavedRun
from model_training.reporting.page import Section, page
from model_training.reporting.plan import counted
from model_training.reporting.queries import locate


@pytest.fixture(scope="module")
def document(saved_run):
    return (saved_run / "index.html").read_text()


def test_a_page_holds_all_it_shows_and_runs_nothing(document, page_of):
    found = page_of(document)
    assert not {"script", "link", "iframe", "object", "form"} & {tag for tag, _ in found.elements}
    for _, attributes in found.elements:
        assert not [name for name in attributes if name.startswith("on")]
        for name in ("src", "href"):
            assert (attributes.get(name) or "#").startswith(("data:image/", "#"))
    assert not re.search(r"url\(|@import|https?://", document)
    assert found.of("meta")[1]["content"] == "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def test_pictures_and_drawings_have_words_and_tables_captions(document, page_of):
    found = page_of(document)
    charts = [image for image in found.of("img") if image.get("class") == "plot"]
    assert (len(charts), len(found.of("img"))) == (3, 13)
    assert all(image["alt"] for image in found.of("img"))
    assert all(drawing["role"] == "img" and drawing["aria-label"] for drawing in found.of("svg"))
    assert len(found.of("caption")) == len(found.of("table")) >= 2
    assert found.of("html")[0]["lang"] == "en"


def test_it_takes_the_readers_light_dark_and_paper(document):
    assert "prefers-color-scheme: dark" in document
    assert "@media print" in document


def test_contents_lead_to_sections(document, page_of):
    found = page_of(document)
    ids = {attributes.get("id") for _, attributes in found.elements}
    assert {link["href"].removeprefix("#") for link in found.of("a")} <= ids
    assert {"figures", "errors", "search", "map", "lost", "streets", "worst"} <= ids


def test_the_worst_queries_are_listed_with_their_outcome(document, saved_run, page_of):
    answers = SavedRun.open(saved_run).predictions["drive1_precise"]
    became, text = stages(answers), page_of(document).text
    order = [text.index(f"drive1_precise, query {row}") for row in worst(answers, 20)]
    assert order == sorted(order)
    for stage in became:
        assert stage in text


def test_names_from_data_are_text_not_markup():
    document = page("<b>city</b>", "", [Section("a", "<script>", "")])
    assert "<script>" not in document
    assert "<b>city" not in document


def test_rows_of_joined_sets_are_found_again(answers_of):
    runs = {"one": answers_of([[0, 0]] * 2, [[0, 0]] * 2), "two": answers_of([[0, 0]] * 3, [[0, 0]] * 3)}
    assert locate([4, 1, 2], runs) == [("two", 2, 4), ("one", 1, 1), ("two", 0, 2)]


def test_no_answer_is_counted_with_the_farthest():
    assert counted(np.array([0.5, 0.6, 5.0, 5.1, np.inf])) == {
        "up to 0.5 m": 1,
        "up to 1 m": 1,
        "up to 5 m": 1,
        "over 5 m": 2,
    }
