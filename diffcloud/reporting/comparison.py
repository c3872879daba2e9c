"""What the page says of the comparison: a summary for a busy person, figures, tables that sort, gaps."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd
from markupsafe import Markup

from diffcloud.evaluation.summary import Tables, against, label, overview, percent, sentences
from diffcloud.reporting.figures import INK, Figure
from diffcloud.reporting.tables import UNKNOWN, Cell, Table, table

_OVERVIEW = {
    "scenario": "scenario",
    "first": "lowest mean loss",
    "first_mm": "mm",
    "second": "next",
    "second_mm": "mm",
}
_OVERVIEW_END = {
    "middle_mm": "middle of the range, mm",
    "below_predictor": "DiffCloud's loss against the best network's",
    "episodes": "episodes",
}
_MEANS = {
    "scenario": "scenario",
    "method": "method",
    "episodes": "episodes",
    "rms_mm": "mean mm",
    "rms_other_frames_mm": "other frames mm",
    "loss": "loss",
    "two_sided": "two-sided",
    "best": "best in",
    "success_rate": "success",
    "median_error_ratio": "ratio error",
    "simulations": "simulations",
}
_INTERVALS = {
    "scenario": "scenario",
    "episode": "episode",
    "parameter": "parameter",
    "status": "status",
    "value": "fitted",
    "interval": "interval",
    "factor": "within a factor of",
    "ratio_factor": "ratio within",
    "combination": "seen best",
    "sources": "improve first",
}
_PIXELS_PER_INCH = 92
"""Of the page per inch of a figure."""
_REPEATS = {
    "scenario": "scenario",
    "fabric": "fabric",
    "parameter": "parameter",
    "median": "median",
    "factor": "largest / smallest",
}
_TRANSFER = {
    "scenario": "scenario",
    "source": "fitted on",
    "target": "measured on",
    "loss": "loss",
    "loss_own": "own fit",
    "loss_middle": "middle",
    "gain": "gain",
}
_CONSISTENCY = {
    "fabric": "fabric",
    "parameter": "parameter",
    "first": "motion",
    "value_first": "value",
    "second": "motion",
    "value_second": "value",
    "factor": "factor",
}
_EPISODES = {
    "episode": "episode",
    "scenario": "scenario",
    "method": "method",
    "category": "category",
    "rms_mm": "mm",
    "rms_other_frames_mm": "other frames mm",
    "loss": "loss",
    "reference_loss": "reference simulator",
    "two_sided": "two-sided",
    "success": "success",
    "value_stretching": "stretching, × nominal",
    "value_density": "density, × nominal",
    "simulations": "simulations",
    "status": "status",
}


@dataclass(frozen=True)
class ComparisonEntry:
    """The comparison as the page shows it."""

    told: Tables
    """Of `evaluation.summary.tables`."""
    records: Sequence[Mapping[str, Any]]
    failures: Sequence[str] = ()
    figures: Sequence[Figure] = field(default_factory=tuple)
    command: str = "python -m pipeline.evaluate"


@dataclass(frozen=True)
class Overview:
    """The comparison in the page's summary: which method wins, by how much, and what is identified."""

    table: Table
    gaps: int
    """Things that are missing."""
    apart: float | None
    """Largest factor between recordings or motions of one fabric: a status looks at one recording, and this belongs beside
    it. None where there is no status, or nothing to hold it against."""


@dataclass(frozen=True)
class Section:
    """A section of the page: sentences, and a table."""

    name: str
    title: str
    caption: str
    findings: Sequence[str]
    table: Table
    source: str
    """The CSV with the same numbers."""


@dataclass(frozen=True)
class Picture:
    """A figure to stand inside the page."""

    name: str
    title: str
    svg: Markup
    caption: str
    source: str


def comparison_overview(entry: ComparisonEntry) -> Overview:
    """For the top of the page."""
    rows = overview(entry.told)
    names = [str(name) for name in rows]
    statuses = {name: f"status of {name.removeprefix('status_')}" for name in names if name.startswith("status_")}
    told = entry.told
    apart = [told[name]["factor"].max() for name in ("repeatability", "consistency") if len(told[name])]
    compared = bool(apart) and not told["intervals"].empty and not told["repeatability"].empty
    drawn = _table(rows, {**_OVERVIEW, **statuses, **_OVERVIEW_END})
    return Overview(drawn, len(comparison_failures(entry)), float(max(apart)) if compared else None)


def comparison_sections(entry: ComparisonEntry) -> list[Section]:
    """Sections with their tables; those without rows are left out."""
    told, said = entry.told, sentences(entry.told)
    shown = told["methods"][told["methods"]["status"] != "not asked for"]
    sections = [
        Section(
            "comparison",
            "Methods on equal terms",
            "The same simulator, frames, sampled points and bounds for all; searches may simulate as often as a fit from "
            "one start. Distances are root mean squares from the simulated cloth to the recorded cloud.",
            [*said["winners"], *said["success"]],
            _table(told["means"], _MEANS),
            "means",
        ),
        Section(
            "intervals",
            "What is identified",
            "Intervals hold the truth at the stated level, as far as the named sources of uncertainty go. A parameter "
            "counts as identified if its interval ends within the factor that was asked for (evaluate.within, by default "
            "1.5). “Improve first” names the largest sources and their parts of the variance: what is known better makes "
            "the interval shorter.",
            said["intervals"],
            _table(_with_intervals(told["intervals"]), _INTERVALS),
            "intervals",
        ),
        Section(
            "repeats",
            "Repeats of one fabric",
            "Parameters of the cloth itself should come out again when it is recorded again.",
            [*said["repeats"], *said["credibility"]],
            _table(told["repeatability"], _REPEATS),
            "repeatability",
        ),
        Section(
            "transfer",
            "Transfer between repeats",
            "Gain is 1 where another recording's parameters are as good as the own fit, 0 where they are no better than "
            "the middle of the range.",
            [],
            _table(told["transfer"], _TRANSFER),
            "transfer",
        ),
        Section(
            "consistency", "One fabric in two motions", "", [], _table(told["consistency"], _CONSISTENCY), "consistency"
        ),
        Section("episodes", "Every episode and method", "", [], _table(shown, _EPISODES), "methods"),
    ]
    return [section for section in sections if section.table.rows]


def _with_intervals(found: pd.DataFrame) -> pd.DataFrame:
    """The table of intervals with both ends of an interval and the unit in one column."""
    if found.empty:
        return found
    ends = found[["low", "high", "unit"]].itertuples(index=False)
    return found.assign(
        interval=["" if pd.isna(low) or pd.isna(high) else f"{low:.4g} to {high:.4g} {unit}" for low, high, unit in ends]
    )


def comparison_failures(entry: ComparisonEntry) -> list[str]:
    """What should be there and is not."""
    gaps = [
        f"{record['scenario']}/{record['episode']}: {label(gap['method'])}: {gap['reason']}"
        for record in entry.records
        for gap in record["gaps"]
        if gap["expected"]
    ]
    return [*entry.failures, *gaps]


def comparison_pictures(entry: ComparisonEntry) -> list[Picture]:
    """Figures as SVG that may stand inside the page."""
    return [Picture(figure.name, figure.title, _inside(figure), figure.caption, figure.source) for figure in entry.figures]


def _inside(figure: Figure) -> Markup:
    # identifiers inside are made unique: several figures share one page
    svg = figure.svg[figure.svg.index("<svg") :]
    svg = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{figure.name}-", svg).replace(INK, "currentColor")
    svg = re.sub(r' (width|height)="[\d.]+pt"', "", svg, count=2)
    svg = svg.replace("<svg", f'<svg style="max-width: {_PIXELS_PER_INCH * figure.width:.0f}px"', 1)
    # names of the standard, fetched by nobody; inside HTML they are not needed
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S))
    return Markup(svg)  # matplotlib has escaped its texts


def _table(frame: pd.DataFrame, columns: Mapping[str, str]) -> Table:
    """Without rows where the frame has none."""
    kept = [name for name in columns if name in frame and frame[name].notna().any()]
    rows = frame[kept].to_dict("records") if kept else []
    return table((columns[name] for name in kept), ((_cell(name, row[name]) for name in kept) for row in rows))


def _cell(name: str, value: Any) -> Cell:
    if value is None or (isinstance(value, float) and value != value):
        return UNKNOWN
    if name == "method":
        return Cell(label(str(value)))
    if isinstance(value, bool):
        return Cell("yes" if value else "no")
    if isinstance(value, int | float):
        shown = {"success_rate": percent, "below_predictor": against}.get(name, "{:.4g}".format)
        return Cell(shown(value), sort=value)
    return Cell(str(value))
