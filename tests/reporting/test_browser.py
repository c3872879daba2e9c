"""The pages in a browser: they draw without an error or the network, and a keyboard and a screen reader are enough."""

from __future__ import annotations

import functools
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from diffcloud.evaluation.summary import tables
from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import CameraInfo, RawEpisodeWriter
from diffcloud.reporting.comparison import ComparisonEntry
from diffcloud.reporting.figures import comparison_figures
from diffcloud.reporting.overlay import Overlay, recorded_layers
from diffcloud.reporting.view import build_view
from tests.evaluation.records import records
from tests.reporting.pages import SUMMARY, entry, page_of

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH: pages are not opened"),
]
CONTRAST = 4.5
"""Of text on its background (WCAG 2.2, 1.4.3)."""
# text whose colour contrasts too little with the nearest background that is painted
_FAINT = """least => {
  const parse = c => { const n = c.match(/[\\d.]+/g).map(Number); return n.length < 4 ? [...n, 1] : n; };
  const light = ([r, g, b]) => [r, g, b].map(v => (v /= 255) <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = e => { for (; e; e = e.parentElement) { const c = parse(getComputedStyle(e).backgroundColor);
    if (c[3] > 0.99) return c; } return [255, 255, 255, 1]; };
  const found = [];
  for (const e of document.querySelectorAll("main *")) {
    const own = [...e.childNodes].some(n => n.nodeType === 3 && n.textContent.trim());
    if (!own || !e.checkVisibility() || e.closest("#scene, svg, .js-plotly-plot")) continue;
    const a = light(parse(getComputedStyle(e).color)), b = light(behind(e));
    const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (contrast < least) found.push(`${e.tagName} ${e.textContent.trim().slice(0, 40)}: ${contrast.toFixed(2)}`);
  }
  return found;
}"""
# tables wider than their section, and cells beyond its edge
_CUT_OFF = """() => [...document.querySelectorAll(".scroll")].filter(box => box.scrollWidth > box.clientWidth
  || [...box.querySelectorAll("td, th")].some(e => e.getBoundingClientRect().right > box.getBoundingClientRect().right + 1))
  .map(box => box.textContent.trim().slice(0, 60))"""
_NAMELESS = """() => [...document.querySelectorAll("input, select, button, a, img, [role=img]")]
  .filter(e => e.checkVisibility() && !e.closest(".js-plotly-plot .main-svg"))
  .filter(e => !(e.getAttribute("aria-label") || e.getAttribute("alt") || e.textContent.trim()
    || (e.labels && [...e.labels].some(l => l.textContent.trim()))))
  .map(e => e.outerHTML.slice(0, 80))"""


@functools.cache
def pages():
    episode = entry().episode
    frames = [0, 1]
    layers = recorded_layers(episode, frames, points=4, rng=np.random.default_rng(0))
    overlay = Overlay("tan1", frames, episode.times, layers)
    view = build_view([overlay], title="A recording", note="Two frames.", facts=[("tan1", "2 frames")])
    told = tables(records(), {})
    failures = ["data/regressors/fold/" + 90 * "n" + ".safetensors: no such file"]
    compared = ComparisonEntry(told, records(), failures, comparison_figures(told, records(), {}))
    pipeline = page_of(entry("tan1"), entry("tan2"), comparison=compared)
    return {"pipeline": pipeline, "fit": page_of(entry("tan1"), summary=SUMMARY, title="Fit of tan1"), "view": view}


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        quiet = [
            "--no-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--disable-background-networking",
        ]
        one = playwright.chromium.launch(executable_path=CHROMIUM, args=quiet)
        yield one
        one.close()


@pytest.fixture(scope="module", params=["pipeline", "fit", "view"])
def opened(request, browser, tmp_path_factory):
    """A page that is open, with what went wrong in `wrong`."""
    file = tmp_path_factory.mktemp("page") / "page.html"
    file.write_text(pages()[request.param])
    tab = browser.new_page(viewport={"width": 1200, "height": 900})
    tab.wrong = []
    tab.on("pageerror", lambda error: tab.wrong.append(str(error)))
    tab.on("console", lambda message: tab.wrong.append(message.text) if message.type == "error" else None)
    tab.on("request", lambda asked: tab.wrong.append(asked.url) if asked.url.startswith("http") else None)
    tab.goto(file.as_uri())
    tab.wait_for_selector("#scene canvas")
    tab.name = request.param
    yield tab
    tab.close()


@pytest.fixture
def page(opened):
    """The open page with all details folded and all layers drawn."""
    opened.set_viewport_size({"width": 1200, "height": 900})
    opened.emulate_media(color_scheme="light")
    opened.evaluate("document.querySelectorAll('details').forEach(one => { one.open = false; })")
    opened.evaluate("document.querySelectorAll('#layers input:not(:checked)').forEach(box => box.click())")
    yield opened
    assert opened.wrong == []


def unfolded(page):
    page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")
    page.wait_for_timeout(300)


def test_the_first_screen_has_status_parameters_and_picture(page):
    """Of a window of 1280 x 800 pixels; with everything folded, a page is at most four of them."""
    page.set_viewport_size({"width": 1280, "height": 800})
    page.wait_for_timeout(300)
    shown = [".problems"] if page.name == "view" else [".status", "#parameters tbody tr", ".findings li"]
    for selector in (*shown, "#layers input", "#scene canvas"):
        assert page.locator(selector).first.bounding_box()["y"] < 800, selector
    scene = page.locator("#scene").first.bounding_box()
    assert scene["y"] + scene["height"] <= 800
    assert page.evaluate("document.documentElement.scrollHeight") <= 4 * 800


def test_every_picture_has_a_legend(page):
    named = page.evaluate("[...document.querySelectorAll('#layers label')].map(one => one.textContent)")
    assert set(named) == set(page.evaluate("overlays[current].layers.map(one => one.name)"))
    unfolded(page)
    plots = page.locator(".plot.js-plotly-plot")
    assert plots.count() == (0 if page.name == "view" else 2)
    for index in range(plots.count()):
        assert plots.nth(index).locator(".legend .legendtext").count() > 0


def test_the_scene_is_drawn(page):
    canvas = page.locator("#scene canvas").first
    drawn = canvas.screenshot()
    for box in page.locator("#layers input").all():
        box.uncheck()
    page.wait_for_timeout(300)
    assert canvas.screenshot() != drawn


def test_the_keyboard_is_enough(page):
    page.locator("#frame").focus()
    page.keyboard.press("Home")
    before = page.inner_text("#time")
    page.keyboard.press("ArrowRight")
    assert page.inner_text("#time") != before
    page.locator("#play").focus()
    page.keyboard.press("Enter")
    assert page.inner_text("#play") == "Stop"
    page.keyboard.press("Enter")
    assert page.inner_text("#play") == "Play"
    box = page.locator("#layers input").first
    box.focus()
    was = box.is_checked()
    page.keyboard.press("Space")
    assert box.is_checked() != was
    assert was in page.evaluate("document.querySelector('#scene').data.map(one => !one.visible)")
    unfolded(page)
    heads = page.locator("#fits thead button")
    if heads.count():  # the report's table
        heads.nth(1).focus()
        page.keyboard.press("Enter")
        assert page.locator("#fits th").nth(1).get_attribute("aria-sort") == "ascending"


def test_everything_has_a_name(page):
    unfolded(page)
    assert page.evaluate(_NAMELESS) == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out(page, scheme):
    unfolded(page)
    page.emulate_media(color_scheme=scheme)
    assert page.evaluate(_FAINT, 21.1)  # more than black on white
    assert page.evaluate(_FAINT, CONTRAST) == []


@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_leaves_the_page_sideways(page, width):
    unfolded(page)
    page.set_viewport_size({"width": width, "height": 800})
    page.wait_for_function("width => document.documentElement.scrollWidth <= width", arg=width)  # plots are drawn again
    assert page.evaluate(_CUT_OFF) == []


def test_a_narrow_table_names_each_cell(page):
    """A table that does not fit has a line per cell, with its heading; a wide window makes it a table again."""
    unfolded(page)
    page.set_viewport_size({"width": 390, "height": 800})
    cells = page.locator("table.sorts.cards tbody tr:first-child td")
    heads = page.locator("table.sorts.cards thead th")
    assert cells.count() == heads.count()
    for index in range(cells.count()):
        said = cells.nth(index).evaluate("e => getComputedStyle(e, '::before').content")
        assert said == f'"{heads.nth(index).inner_text()}"'
    page.set_viewport_size({"width": 1280, "height": 800})
    assert page.locator("table.sorts.cards").count() == 0


def test_a_recording_is_watched_while_it_grows(browser, tmp_path):
    """The command in a process of its own, as beside a capture; Ctrl-C ends it."""
    pytest.importorskip("viser")
    folder = tmp_path / "episode"
    command = [sys.executable, "-m", "diffcloud", "view", str(folder), "--live", "--port", "8741"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            told = process.stderr.readline()
            assert "does not exist yet" in process.stderr.readline()
            url = re.search(r"http://127\.0\.0\.1:\d+", told).group()
            tab = browser.new_page(viewport={"width": 1000, "height": 700})
            tab.goto(url)
            tab.get_by_text("Waiting for the first frame").wait_for()
            info = CameraInfo("top", "1", Intrinsics(width=8, height=6, fx=10, fy=10, cx=3.5, cy=2.5), 0.001, np.eye(4))
            with RawEpisodeWriter(folder, {"top": info}, rate_hz=30, source="test") as writer:
                writer.add_frame("top", 0.25, np.full((6, 8), 700, dtype=np.uint16))
                tab.get_by_text("top: frame 0, 0.25 s, 48 points").wait_for()
            tab.get_by_text("complete").wait_for()
            tab.close()
        finally:
            process.send_signal(signal.SIGINT)
        assert process.wait(timeout=30) == 0
        assert "Recording complete" in process.stderr.read()
