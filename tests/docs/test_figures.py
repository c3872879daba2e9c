"""Measured figures of README and docs are those of the results."""

from __future__ import annotations

import ast
import math
import re
from dataclasses import dataclass
from functools import cache

import pytest

from tests.docs.examples import PAGES, ROOT, read

FOREIGN, MOVED = "docs/results/foreign.md", "docs/results/moved-together.md"
HELD = r"\| (?P<held>\d+ of \d+) \| "


@dataclass(frozen=True)
class Figure:
    """Groups of `text`, on a page, have the values that groups of the same names in `pattern` have in `source`.

    Both are regular expressions. The group `percent` of a text is the relative error that `log`, an error of the
    logarithm, is in a source.
    """

    page: str
    text: str
    source: str
    pattern: str


def stiffness(nodes: str) -> Figure:
    """A row of the stiffness on coarse meshes."""
    row = rf"\| {nodes} \| (?P<pad>[\d.]+) N/m \| (?P<pivot>[\d.]+) N/m \| (?P<seconds>[\d.]+) s \|"
    return Figure("docs/physics.md", row, "docs/results/discretisation.md", row)


def coverage(text: str, row: str) -> Figure:
    """A row of README's table of intervals, which has the row of `FOREIGN` that matches `row`."""
    shown = rf"{text} {HELD}(?P<percent>\d+) %"
    return Figure("README.md", shown, FOREIGN, rf"\| {row} {HELD}(?P<log>[\d.]+) \|")


FIGURES = [
    Figure(
        "README.md",
        r"\| (?P<found>[\d.]+) N/m \| (?P<low>[\d.]+) to (?P<high>[\d.]+) \| (?P<true>[\d.]+) \|",
        "tests/library/test_notebook.py",
        r"FOUND, INTERVAL, TRUE = (?P<found>[\d.]+), \((?P<low>[\d.]+), (?P<high>[\d.]+)\), (?P<true>[\d.]+)",
    ),
    Figure(
        "README.md",
        r"on new towels, (?P<held>\d+ of \d+) intervals .* takes (?P<seconds>\d+) s ",
        FOREIGN,
        r"\| towels \| (?P<held>\d+ of \d+) \|.* (?P<seconds>\d+) \|\n",
    ),
    coverage(r"size and position of the cloth known", "towels"),
    coverage(r"pad stated 1\.5 times wrong", "untold"),
    coverage(r"two lifts, fitted jointly", "joint"),
    coverage(r"one lift in Newton, an earlier version of the fit", "newton"),
    coverage(r"one lift, seen by one camera", "one_camera"),
    coverage(r"points near the table cut", "cut"),
    coverage(r"one fold", "folds"),
    Figure(
        "README.md", r"pad stated (?P<factor>[\d.]+) times wrong", FOREIGN, r"stated (?P<factor>[\d.]+) times too large"
    ),
    Figure(
        "docs/limits.md",
        r"finer towels of this simulator, (?P<held>\d+ of \d+) do",
        FOREIGN,
        r"\| finer \|(?:[^|]*\|){5} (?P<held>\d+ of \d+) \|",
    ),
    Figure(
        "docs/limits.md",
        r"(?P<held>\d+ of \d+) bending intervals .* is (?P<times>[\d.]+) times too large",
        FOREIGN,
        r"\| towels \|(?:[^|]*\|){5} (?P<held>\d+ of \d+) \|(?s:.*) overestimated: (?P<times>[\d.]+) times",
    ),
    Figure(
        "docs/concepts.md",
        r"converge from a yaw error of (?P<yaw>\d+)°",
        MOVED,
        r"shifted by \d+ mm and turned by (?P<yaw>\d+)°",
    ),
    Figure(
        "docs/own-clouds.md",
        r"within (?P<shift>\d+) mm and (?P<yaw>\d+)° of the cloud",
        MOVED,
        r"shifted by (?P<shift>\d+) mm and turned by (?P<yaw>\d+)°",
    ),
    Figure(
        "docs/evaluation.md",
        r"In (?P<lifts>\d+ of \d+) lifts and (?P<folds>\d+ of \d+) folds, the fit has a lower loss than every network",
        "docs/results/comparison.md",
        r"DiffCloud is lowest in (?P<lifts>\d+ of \d+) \(release_lift\), (?P<folds>\d+ of \d+) \(release_fold\)",
    ),
    *(stiffness(nodes) for nodes in ("7 × 6", "9 × 7", "13 × 10", "19 × 15")),
    Figure(
        "docs/regressors.md",
        r"trains for (?P<low>\d+) to (?P<high>\d+) minutes",
        "docs/results/networks.md",
        r"\| MLP \| `reduced`.*\| (?P<low>\d+) minutes \| (?P<high>\d+) minutes",
    ),
]

_UNITS = {"mm": 1e-3, "cm": 1e-2, "%": 1e-2, "ms": 1e-3, "µs": 1e-6, "mm²": 1e-6, "cm/s": 1e-2}
_UNITS |= dict.fromkeys(["s", "m", "N/m", "GB", "MB", "°", "degrees", "N", "N·m", "kg", "kg/m²", "Hz", "m/s", "times"], 1)
_NUMBER = r"(?<![\w.,/-])\d[\d,]*(?:\.\d+)?"
_UNIT = "|".join(sorted(map(re.escape, _UNITS), key=len, reverse=True))
_WITH_UNIT = re.compile(
    rf"({_NUMBER})(?: (?:to|and) ({_NUMBER}))? ?(?:of \d+\b|simulations|({_UNIT}))(?![\w/²·.]\w)|\w+ (?:minutes|hours)\b"
)
_NO_PROSE = re.compile(
    r"^ *(?:\d+\. |- )?```.*?^ *```$|\$\$.*?\$\$|\$[^$\n]*\$|`[^`]*`|(?<=\])\([^)]*\)", re.MULTILINE | re.DOTALL
)
"""Code, equations, addresses of links."""


def prose(page: str) -> str:
    return " ".join(_NO_PROSE.sub("", read(page)).split())


@cache
def constants() -> set[str]:
    """Numbers in the code, such as defaults and limits."""
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in ROOT.glob("diffcloud/**/*.py")]
    nodes = [node.value for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant)]
    return {f"{value:.6g}" for value in nodes if isinstance(value, int | float)}


def unexplained(text: str, figures: list[Figure]) -> list[str]:
    """Numbers with a unit that are neither in `figures` nor constants of the code."""
    spans = [match.span() for match in (re.search(figure.text, text) for figure in figures) if match]
    left = []
    for match in _WITH_UNIT.finditer(text):
        *numbers, unit = match.groups()
        values = [float(number.replace(",", "")) * _UNITS[unit] for number in numbers if number and unit]
        fixed = values and constants().issuperset(f"{value:.6g}" for value in values)
        if not fixed and not any(start <= match.start() and match.end() <= end for start, end in spans):
            left.append(text[max(0, match.start() - 40) : match.end() + 20])
    return left


@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: figure.text[:40])
def test_a_figure_is_that_of_the_results(figure):
    shown = re.search(figure.text, prose(figure.page))
    measured = re.search(figure.pattern, read(figure.source))
    assert shown, f"{figure.page} does not contain {figure.text}"
    assert measured, f"{figure.source} does not contain {figure.pattern}"
    values = measured.groupdict()
    if "log" in values:
        values["percent"] = f"{100 * math.expm1(float(values.pop('log'))):.0f}"
    assert shown.groupdict() == values


@pytest.mark.parametrize("page", ["README.md", *(page for page in PAGES if re.fullmatch(r"docs/[\w-]+\.md", page))])
def test_other_figures_are_constants_of_the_code(page):
    figures = [figure for figure in FIGURES if figure.page == page]
    assert not unexplained(prose(page), figures), "add them to FIGURES, or leave them out"


@pytest.mark.parametrize("text", ["is 17.4 N/m", "in 29 of 30 cases", "twenty minutes", "13.7 % off", "1 to 4.13 mm"])
def test_a_figure_without_a_source_is_found(text):
    assert unexplained(f"It {text}.", [])
