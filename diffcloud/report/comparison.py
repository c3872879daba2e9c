"""What the page says of the comparison: a summary for a busy person, figures, tables that sort, gaps."""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from diffcloud.evaluation.summary import Tables, label, overview, sentences
from diffcloud.report.figures import INK, Figure

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
_IDENTIFIED = {
    "scenario": "scenario",
    "episode": "episode",
    "parameter": "parameter",
    "verdict": "verdict",
    "value": "fitted",
    "factor": "within a factor of",
    "ratio_factor": "ratio within",
    "combination": "seen best",
    "ends_agree": "ends that agree",
    "scale_fitted": "scale moves",
    "scale_everything": "artefact",
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


@dataclass(frozen=True)
class ComparisonEntry:
    """The comparison as the page shows it."""

    told: Tables
    """Of `evaluation.summary.tables`."""
    records: Sequence[Mapping[str, Any]]
    failures: Sequence[str] = ()
    figures: Sequence[Figure] = field(default_factory=tuple)
    command: str = "diffcloud evaluate"


def comparison_summary(entry: ComparisonEntry) -> str:
    """Which method wins, by how much, and what is identified: for the top of the page."""
    table = overview(entry.told)
    names = [str(name) for name in table]
    verdicts = {name: f"verdict on {name.removeprefix('verdict_')}" for name in names if name.startswith("verdict_")}
    gaps = comparison_failures(entry)
    note = (
        f"<p><b>Incomplete:</b> {len(gaps)} {'thing is' if len(gaps) == 1 else 'things are'} missing; "
        '<a href="#failures">what failed</a>.</p>'
        if gaps
        else ""
    )
    return (
        f'{note}<div class="scroll">{_table(table, {**_OVERVIEW, **verdicts, **_OVERVIEW_END})}</div>'
        '<p class="caption">Mean distance from the simulated to the recorded cloth [mm]. '
        '<a href="#comparison">All methods</a> · <a href="#identifiability">what “identified” means</a> · '
        f'<a href="#repeats">what repeats say</a>.</p>{_caution(entry.told)}'
    )


def _caution(told: Tables) -> str:
    """A verdict looks at one recording; what others of the same fabric gave belongs beside it."""
    if told["identifiability"].empty or told["repeatability"].empty:
        return ""
    apart = [told[name]["factor"].max() for name in ("repeatability", "consistency") if len(told[name])]
    return (
        "<p>Verdicts are about one recording each. Another recording or motion of the same fabric gave a value up to "
        f'<b>{max(apart):.3g} times</b> as large: see <a href="#repeats">repeats</a> before you take a number for a '
        "property of the fabric.</p>"
    )


def comparison_section(entry: ComparisonEntry) -> str:
    """Figures and tables as HTML sections."""
    told = entry.told
    said = {topic: "".join(f"<li>{html.escape(line)}</li>" for line in lines) for topic, lines in sentences(told).items()}
    figures = "".join(_figure(figure, entry.command) for figure in entry.figures)
    parts = [
        _section(
            "comparison",
            "Methods on equal terms",
            "The same simulator, frames, sampled points and bounds for all; searches may simulate as often as a fit from "
            "one start. Distances are root mean squares from the simulated cloth to the recorded cloud.",
            _table(told["means"], _MEANS),
            "means",
            said["winners"] + said["success"],
        ),
        f'<section id="figures"><h2>Figures</h2>{figures}</section>' if figures else "",
        _section(
            "identifiability",
            "What is identified",
            "A parameter counts as identified if the loss tells it within a factor of 1.5. “Scale moves” and “artefact” "
            "are changes of the loss, in units of the resampling noise, when stretch and mass are doubled or halved "
            "together, and when bending, air and all masses go along: then only soft handles and contact stiffness are "
            "left to tell.",
            _table(told["identifiability"], _IDENTIFIED),
            "identifiability",
            said["identifiability"],
        ),
        _section(
            "repeats",
            "Repeats of one fabric",
            "Parameters of the cloth come out again when it is recorded again.",
            _table(told["repeatability"], _REPEATS),
            "repeatability",
            said["repeats"] + said["credibility"],
        ),
        _section(
            "transfer",
            "Transfer between repeats",
            "Gain is 1 where another recording's parameters are as good as the own fit, 0 where they are no better than "
            "the middle of the range.",
            _table(told["transfer"], _TRANSFER),
            "transfer",
        ),
        _section("consistency", "One fabric in two motions", "", _table(told["consistency"], _CONSISTENCY), "consistency"),
        _section("episodes", "Every episode and method", "", _episodes(told["methods"]), "methods"),
    ]
    return "".join(parts)


def comparison_failures(entry: ComparisonEntry) -> list[str]:
    """What should be there and is not."""
    gaps = [
        f"{record['scenario']}/{record['episode']}: {label(gap['method'])}: {gap['reason']}"
        for record in entry.records
        for gap in record["gaps"]
        if gap["expected"]
    ]
    return [*entry.failures, *gaps]


def _section(name: str, title: str, caption: str, table: str, source: str, said: str = "") -> str:
    if not table:
        return ""
    note = f'<p class="caption">{caption}</p>' if caption else ""
    findings = f'<ul class="findings">{said}</ul>' if said else ""
    return (
        f'<section id="{name}"><h2>{title}</h2>{note}{findings}<div class="scroll">{table}</div>'
        f'<p class="caption">Source: <code>tables/{source}.csv</code>, by <code>diffcloud evaluate</code>.</p></section>'
    )


def _figure(figure: Figure, command: str) -> str:
    # identifiers inside are made unique: several figures share one page
    svg = figure.svg[figure.svg.index("<svg") :]
    svg = re.sub(r'(id="|url\(#|href="#)', rf"\g<1>{figure.name}-", svg).replace(INK, "currentColor")
    svg = re.sub(r' (width|height)="[\d.]+pt"', "", svg, count=2)
    svg = svg.replace("<svg", f'<svg style="max-width: {_PIXELS_PER_INCH * figure.width:.0f}px"', 1)
    # names of the standard, fetched by nobody; inside HTML they are not needed
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.S))
    return (
        f'<figure id="figure-{html.escape(figure.name)}"><h3>{html.escape(figure.title)}</h3>{svg}'
        f'<figcaption class="caption">{html.escape(figure.caption)} Source: <code>{html.escape(figure.source)}</code>; '
        f"made by <code>{html.escape(command)}</code> and <code>diffcloud report</code>.</figcaption></figure>"
    )


def _episodes(table: pd.DataFrame) -> str:
    columns = {
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
        "value_stretch": "stretch",
        "value_mass": "mass",
        "simulations": "simulations",
        "status": "status",
    }
    return _table(table[table["status"] != "not asked for"], columns)


def _table(table: pd.DataFrame, columns: Mapping[str, str]) -> str:
    """Empty without rows."""
    kept = [name for name in columns if name in table and table[name].notna().any()]
    if table.empty:
        return ""
    heads = "".join(f"<th>{html.escape(columns[name])}</th>" for name in kept)
    rows = "".join(f"<tr>{''.join(_cell(name, row[name]) for name in kept)}</tr>" for row in table[kept].to_dict("records"))
    return f'<table class="sorts"><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table>'


def _cell(name: str, value: Any) -> str:
    if value is None or (isinstance(value, float) and value != value):
        return "<td>–</td>"
    if name == "method":
        return f"<td>{html.escape(label(str(value)))}</td>"
    if isinstance(value, bool):
        return f"<td>{'yes' if value else 'no'}</td>"
    if isinstance(value, int | float):
        shares = {"success_rate": f"{100 * value:.0f} %", "below_predictor": f"{-100 * value:+.0f} %"}
        return f'<td data-value="{value}">{shares.get(name, f"{value:.4g}")}</td>'
    return f"<td>{html.escape(str(value))}</td>"
