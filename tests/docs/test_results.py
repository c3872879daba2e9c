"""Pages of results have one form, and their index says what they say."""

from __future__ import annotations

import pytest

from diffcloud.evaluation.markdown import markdown_table, result_page
from studies.index import index_page
from tests.docs.examples import PAGES, read
from tests.docs.form import check_form

RESULTS = [page for page in PAGES if page.startswith("docs/results/") and not page.endswith("/index.md")]


@pytest.mark.parametrize("page", RESULTS)
def test_a_page_has_the_form(page):
    check_form(read(page))


def test_the_index_has_the_question_and_the_answer_of_each_page():
    assert read("docs/results/index.md") == index_page(), "run `python -m studies index`"
    for page in RESULTS:
        assert f"]({page.removeprefix('docs/results/')}) " in index_page()


def test_a_page_is_assembled():
    table = markdown_table(["a", "b"], [[1, None], [2.0, "x"]])
    page = result_page(
        "Is it?", "In 2 of 3 cases.", table, command="make it", made="2026-01-02", details={"On a GPU": [table]}
    )
    assert page.startswith("# Is it?\n\nIn 2 of 3 cases.\n\n| a | b |\n|---|---|\n| 1 | – |\n| 2 | x |\n\n")
    assert (
        '\n\nMade on 2026-01-02 by `make it`.\n\n<details markdown="1" id="on-a-gpu"><summary>On a GPU</summary>\n\n| a |'
        in page
    )
    check_form(page)
    check_form(result_page("Is it?", "In 2.", table, command="make it", note="Note.", picture="![It](it.png)"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"question": "It is"}, "no question"),
        ({"answer": "Often."}, "no figure"),
        ({"table": ["- 1"]}, "no table"),
        ({"made": "a Monday"}, "date or command"),
        ({"note": "| 1 | 2 |"}, "fold into details"),
        ({"note": "## More"}, "fold into details"),
        ({"note": "![It](it.png)\n\nNote."}, "after the notes"),
        ({"note": "word " * 300}, "300 at most"),
    ],
)
def test_another_form_is_refused(changes, message):
    page = {"question": "Is it?", "answer": "In 2.", "table": ["| a |"], "command": "make it", **changes}
    with pytest.raises(AssertionError, match=message):
        check_form(result_page(**page))
