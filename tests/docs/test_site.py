"""The site builds without a warning, needs no other host, and has a page for every command; links hold."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlsplit

import markdown
import pytest

from tests.docs.examples import PAGES, ROOT, read
from tests.docs.site import equations, reference

_FETCHED = {
    "script": "src",
    "img": "src",
    "iframe": "src",
    "source": "src",
    "video": "src",
    "audio": "src",
    "object": "data",
}
"""Tag -> attribute whose address a browser fetches by itself; links to style sheets, icons and fonts come to it."""


CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
_ELEMENTS = """
a article aside blockquote body br button circle code details dialog div em figure footer form g
h1 h2 h3 h4 h5 h6 head header hr html iframe img input label li link main meta nav noscript ol p path pre rect script small
span strong style sub summary sup svg table tbody td th thead title tr ul
annotation math merror mfrac mi mn mo mover mpadded mphantom mroot mrow mspace msqrt mstyle msub msubsup msup mtable mtd
mtext mtr munder munderover semantics
"""
"""Elements of HTML, SVG and MathML that pages may have."""


class Fetched(HTMLParser):
    """Addresses that a page makes a browser fetch, those that a reader can follow, its elements, equations and text."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.followed: list[str] = []
        self.equations = 0
        self.elements: set[str] = set()
        self.text = ""
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.equations += tag == "math"
        self.elements.add(tag)
        if tag == "a":
            self.followed.append(given.get("href", ""))
        elif tag == "link":
            if given.get("rel") not in ("canonical", "prev", "next"):
                self.fetched.append(given.get("href", ""))
        elif given.get(_FETCHED.get(tag, "")):
            self.fetched.append(given[_FETCHED[tag]])

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--config-file", str(ROOT / "mkdocs.yml")]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, "--site-dir", str(out)], env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return out


def test_no_page_needs_another_host(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    for page in pages:
        for address in Fetched(page).fetched:
            assert not urlsplit(address).netloc, f"{page.relative_to(site)} fetches {address}"
    for style in site.rglob("*.css"):
        outside = re.findall(r"url\(['\"]?(?:https?:)?//[^)]*\)|@import[^;]*//[^;]*", style.read_text(encoding="utf-8"))
        assert not outside, f"{style.relative_to(site)} fetches {outside}"


def test_links_between_pages_hold(site):
    for page in site.rglob("*.html"):
        if page.name == "404.html":  # its links are absolute, as it may stand for any page
            continue
        for address in Fetched(page).followed:
            parts = urlsplit(address)
            if not parts.netloc and parts.path:
                assert (page.parent / parts.path).exists(), f"{page.relative_to(site)} links to {address}"


def test_every_command_has_a_page_with_its_options(site):
    for path, command in reference.commands().items():
        page = (site / reference.address(path).replace(".md", ".html")).read_text(encoding="utf-8")
        assert f"diffcloud {' '.join(path)}" in page
        for parameter in command.params:
            if parameter.param_type_name == "option":
                assert f"<code>{parameter.opts[0]}" in page, f"{path} {parameter.opts}"
    assert str(ROOT) not in page


def test_pages_and_commands_link_both_ways(site):
    assert "../commands/" not in read("docs/regressors.md")  # GitHub has no such pages
    assert 'href="commands/network-train.html"' in (site / "regressors.html").read_text(encoding="utf-8")
    assert 'href="../regressors.html"' in (site / "commands" / "network-train.html").read_text(encoding="utf-8")


def test_placeholders_of_help_texts_are_shown(site):
    """<scenario> in a help text is text. A browser would take it for an element, and show nothing."""
    told = {}
    for path, command in reference.commands().items():
        texts = [command.help or "", *(getattr(parameter, "help", None) or "" for parameter in command.params)]
        told[path] = [placeholder for text in texts for placeholder in re.findall(r"<[\w|]+>[\w./]*", text)]
    assert sum(map(bool, told.values())) >= 5
    for path, placeholders in told.items():
        shown = Fetched(site / reference.address(path).replace(".md", ".html")).text
        for placeholder in placeholders:
            assert placeholder in shown, f"{path} does not show {placeholder}"


def test_pages_have_no_elements_that_html_does_not_know(site):
    known = set(_ELEMENTS.split())
    for page in site.rglob("*.html"):
        unknown = Fetched(page).elements - known
        assert not unknown, f"{page.relative_to(site)}: {unknown}"


def test_all_that_plain_text_holds_is_shown():
    text = "a <b> & *c* _d_ [e](f) | `<g> & *h*`"
    assert markdown.markdown(reference._escaped(text)) == (
        "<p>a &lt;b&gt; &amp; *c* _d_ [e](f) | <code>&lt;g&gt; &amp; *h*</code></p>"
    )


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH: the site is not searched")
@pytest.mark.parametrize("start", ["index.html", "results/coverage.html"])
def test_a_search_on_a_page_from_disk_finds_another_page(site, start):
    api = pytest.importorskip("playwright.sync_api")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-background-networking"]
        )
        tab, wrong = browser.new_page(viewport={"width": 1280, "height": 800}), []
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.on("request", lambda asked: wrong.append(asked.url) if asked.url.startswith("http") else None)
        tab.goto((site / start).as_uri())
        tab.locator("input.md-search__input").click()
        tab.keyboard.type("checkerboard")
        found = tab.locator("a.md-search-result__link", has_text="Calibration").first
        found.wait_for(timeout=15_000)
        found.click()
        tab.wait_for_url("**/calibration.html**")
        browser.close()
    assert wrong == []


def test_equations_are_drawn(site):
    page = site / "physics.html"
    assert Fetched(page).equations > 60
    assert "arithmatex" not in page.read_text(encoding="utf-8")


def test_an_equation_that_is_none_is_refused():
    drawn = equations.with_mathml(r'<div class="arithmatex">\[a &lt; \frac{1}{b}\]</div>')
    assert "<mfrac>" in drawn
    with pytest.raises(ValueError, match="no equation"):
        equations.with_mathml(r'<span class="arithmatex">\(\nosuchcommand{x}\)</span>')


@pytest.mark.parametrize("page", [*PAGES, "CHANGELOG.md"])
def test_links_and_file_names_of_a_page_hold(page):
    text = read(page)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        parts = urlsplit(target)
        if not parts.scheme and parts.path:
            assert (ROOT / page).parent.joinpath(parts.path).exists(), f"{page} links to {target}"
    prose = re.sub(r"^ *(?:\d+\. )?```.*?^ *```$", "", text, flags=re.MULTILINE | re.DOTALL)
    for name in re.findall(r"(?<![\w/.])((?:docs|diffcloud|pipeline|tests)/[\w./-]*\w)", prose):
        assert (ROOT / name).exists(), f"{page} names {name}"
