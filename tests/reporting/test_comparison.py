"""Figures and sections of the comparison from made-up records."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest

from diffcloud.estimation.record import History
from diffcloud.evaluation.summary import tables
from diffcloud.reporting.comparison import ComparisonEntry, comparison_failures, comparison_overview
from diffcloud.reporting.figures import comparison_figures
from tests.evaluation.records import record, records
from tests.reporting.pages import main_of, page_of

SECONDS = {
    ("lift", "tan1"): {
        "diffcloud": {"optimisation": 30.0},
        "mlp": {"dataset": 900.0, "training": 100.0, "inference": 0.01},
        "middle": {},
    }
}
_HISTORY = History(names=[], loss=[[0.1, 0.2], [None, 0.15], [0.05, None]], values=[], gradient_norm=[])
HISTORIES = {("lift", "tan1"): _HISTORY}


@pytest.fixture(scope="module")
def told():
    simulated = record("band", "0", truth={"stretching": 1.0, "density": 1.0}, methods={"diffcloud": 3e-5, "middle": 0.1})
    return tables([*records(), simulated], SECONDS)


@pytest.fixture(scope="module")
def figures(told):
    return comparison_figures(told, records(), HISTORIES)


@pytest.fixture(scope="module")
def page(told, figures):
    return main_of(page_of(comparison=ComparisonEntry(told, records(), ["fold/x: no fit <b>"], figures)))


def test_every_figure_is_there_with_caption_and_source(figures):
    names = [figure.name for figure in figures]
    assert names == ["losses", "parameters", "success", "curves", "landscape_lift_tan1"]
    for figure in figures:
        assert figure.caption
        assert figure.source
        assert figure.png.startswith(b"\x89PNG")
        ElementTree.fromstring(figure.svg)


def test_the_same_data_gives_the_same_bytes(told, figures):
    again = comparison_figures(told, records(), HISTORIES)
    assert [(figure.svg, figure.png) for figure in again] == [(figure.svg, figure.png) for figure in figures]


def test_nothing_is_drawn_of_nothing():
    told = tables([record("lift", "e", methods={"diffcloud": 0.1}, stated=False)], {})
    assert [figure.name for figure in comparison_figures(told, [], {})] == ["losses", "parameters"]


def test_the_page_has_no_address_and_unique_identifiers(page):
    assert "http" not in page
    identifiers = re.findall(r'\bid="([^"]+)"', page)
    assert len(identifiers) == len(set(identifiers))
    for target in re.findall(r'(?:url\(#|href="#)([^")]+)', page):
        assert target in identifiers, target


def test_the_page_is_well_formed(page):
    open_tags: list[str] = []

    class Balance(HTMLParser):
        def handle_starttag(self, tag, attrs):
            if tag not in ("input", "img"):
                open_tags.append(tag)

        def handle_startendtag(self, tag, attrs):
            pass

        def handle_endtag(self, tag):
            assert open_tags.pop() == tag

    Balance().feed(page)
    assert open_tags == []


def test_the_summary_tells_winner_verdict_and_gaps(told, page):
    summary = page[: page.index("Methods on equal terms")]
    assert "DiffCloud" in summary
    assert "ratio only (2/2)" in summary
    assert "2 things are missing" in summary
    assert comparison_failures(ComparisonEntry(told, records(), ["a"])) == ["a", "lift/tan1: MeteorNet: no checkpoint"]


def test_verdicts_stand_beside_what_other_recordings_gave(told, page):
    assert "a value up to <b>5.66 times</b> as large" in page
    alone = dict(told) | {"repeatability": told["repeatability"][:0]}
    assert comparison_overview(ComparisonEntry(alone, records())).apart is None


def test_numbers_sort_as_numbers(page):
    assert re.search(r'<td data-value="[\d.]+">', page)
    assert 'data-value="nan"' not in page
