"""Whatever an episode is called, the page shows it as text and its scripts run."""

from __future__ import annotations

import json
import re
import shutil
import subprocess

import pytest

from diffcloud.estimation.record import FittedParameter
from tests.reporting.pages import entry, main_of, page_of

NASTY = "<!--<script>alert(1)</script>&amp;\u2028'\""


def data_of(page):
    """The JSON in the script, as the browser's parser of HTML leaves it."""
    return re.search(r"const episodes = (.*), trainings = (.*);", page).groups()


def test_names_are_shown_as_text():
    page = page_of(entry(NASTY, scenario=NASTY, fabric=NASTY, failures=[NASTY]), title=NASTY)
    shown = main_of(page)
    assert "<!--" not in page[: page.index("<script>")]
    assert "<script" not in shown
    assert shown.count("&lt;!--&lt;script&gt;alert(1)&lt;/script&gt;&amp;amp;") == 9  # title, six cells, a failure twice


def test_data_cannot_end_or_confuse_the_script():
    for text in data_of(page_of(entry(NASTY))):
        assert not set(text) & set("<>&\u2028\u2029")
    told = json.loads(data_of(page_of(entry(NASTY)))[0])
    assert told[0]["name"] == f"lift / {NASTY}"


@pytest.mark.skipif(shutil.which("node") is None, reason="no node on PATH: the data are not parsed as JavaScript")
def test_the_scripts_data_are_what_was_put_in():
    episodes, trainings = data_of(page_of(entry(NASTY)))
    code = f"const e = {episodes}, t = {trainings}; console.log(JSON.stringify([e[0].name, t.length]))"
    done = subprocess.run(["node", "-e", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == [f"lift / {NASTY}", 0]


def test_material_that_was_fitted_along_is_no_column_but_is_told_where_it_is_off():
    one = entry()
    along = {"multiplier": 1.0, "unit": "N·m", "meaning": "", "role": "material"}
    one.fit.parameters["bending"] = FittedParameter(value=1.95, centre=2.0, **along)
    one.fit.parameters["self_friction"] = FittedParameter(value=0.9, centre=0.6, **along)
    assert "<td>self friction × 1.50</td>" in main_of(page_of(one))
    one.fit.parameters["self_friction"].value = 0.6
    one.fit.parameters["bending"].value = 2.0
    page = main_of(page_of(one))
    assert "<td>as known</td>" in page
    assert ">bending<" not in page


def test_a_number_that_is_not_known_is_a_dash():
    assert "<td>–</td>" in main_of(page_of())
    assert "nan" not in main_of(page_of())


def test_the_summary_says_how_close_a_fit_comes():
    close = entry()
    close.row["fitted_ratio"] = 2.2 * 1.003
    assert "the fits miss it by <b>0.3 %</b> (median)" in main_of(page_of(close))
