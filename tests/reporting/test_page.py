"""Whatever an episode is called, the page shows it as text and its scripts run."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from importlib.resources import files
from itertools import combinations

import numpy as np
import pytest

from diffcloud.estimation.record import FittedParameter
from tests.reporting.pages import entry, main_of, page_of

DICHROMATS = (  # protan, deutan, tritan: on linear RGB
    np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]),
    np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]),
    np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]),
)
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
    assert "<td>as expected</td>" in page
    assert ">bending<" not in page


def test_a_number_that_is_not_known_is_a_dash():
    assert "<td>–</td>" in main_of(page_of())
    assert "nan" not in main_of(page_of())


def test_the_summary_says_how_close_a_fit_comes():
    close = entry()
    close.row["fitted_ratio"] = 2.2 * 1.003
    assert "The median error of the fitted ratio is 0.3 %." in main_of(page_of(close))


@pytest.mark.parametrize("scheme", [0, 1])
def test_colours_differ_for_the_colour_blind(scheme):
    """In both colour schemes, after the simulation of dichromats by Machado et al. (2009); distances are CIE 1976."""
    style = (files("diffcloud.reporting") / "templates" / "head.html").read_text(encoding="utf-8")
    colours = dict(re.findall(r"--(\w+): (#\w{6})", re.findall(r":root \{(.*?)\}", style, re.S)[scheme]))
    rgb = {name: np.array([int(code[at : at + 2], 16) for at in (1, 3, 5)]) / 255 for name, code in colours.items()}
    linear = {name: np.where(one <= 0.04045, one / 12.92, ((one + 0.055) / 1.055) ** 2.4) for name, one in rgb.items()}
    pairs = [*combinations(("target", "second", "third", "fourth", "fitted"), 2), ("fitted", "start")]
    for seen in DICHROMATS:
        lab = {name: _lab(np.clip(seen @ one, 0, 1)) for name, one in linear.items()}
        assert {pair: d for pair in pairs if (d := np.linalg.norm(lab[pair[0]] - lab[pair[1]])) < 13} == {}


def _lab(linear):
    xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]] @ linear / [0.9505, 1.0, 1.089]
    x, y, z = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])
