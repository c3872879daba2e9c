"""The comparison as a Markdown page for the documentation."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from diffcloud.evaluation.methods import PHASES
from diffcloud.evaluation.summary import Tables, label, sentences


def comparison_page(told: Tables, missing: Sequence[str], title: str) -> str:
    """Return the page: sentences first, then tables of losses, means, wall times, intervals and repeats.

    Args:
        told: result of `summary.tables`.
        missing: missing results that were expected.
    """
    parts = [f"# {title}", "", *(f"- {line}" for lines in sentences(told).values() for line in lines), ""]
    parts += [
        "## Loss per episode",
        "",
        "Loss by the fit's measure at its frames, squared length units of the scene, fresh points, parameters clipped to "
        "the bounds.",
        "",
        *_losses(told["methods"]),
        "",
        "## Means",
        "",
        "RMS distances at the fit's frames and at all others; `best` counts episodes where no method is clearly lower; "
        "`runs` are simulations per episode.",
        "",
        *_means(told["means"]),
        "",
        "## Seconds per episode",
        "",
        *_seconds(told["seconds"]),
        "",
        "## What is identified",
        "",
        "Intervals at the stated level, statuses, and the largest sources of uncertainty with their parts of the variance.",
        "",
        *_identified(told["intervals"]),
        "",
        "## Repeats of one fabric",
        "",
        *_table(
            ["scenario", "fabric", "parameter", "repeats", "median", "largest / smallest"],
            told["repeatability"][["scenario", "fabric", "parameter", "repeats", "median", "factor"]],
        ),
        "",
        "## Transfer between repeats",
        "",
        "Loss of one recording's parameters on another of the same fabric.",
        "",
        *_table(
            ["scenario", "from", "to", "loss", "own fit", "middle", "gain"],
            told["transfer"][["scenario", "source", "target", "loss", "loss_own", "loss_middle", "gain"]],
        ),
        "",
        "## One fabric in two motions",
        "",
        *_table(
            ["fabric", "parameter", "first", "second", "value", "value", "factor"],
            told["consistency"][["fabric", "parameter", "first", "second", "value_first", "value_second", "factor"]],
        ),
        "",
    ]
    if missing:
        parts += ["## What is missing", "", *(f"- {line}" for line in missing), ""]
    return "\n".join(parts)


def _losses(table: pd.DataFrame) -> list[str]:
    measured = table[table["status"] == "ok"]
    names = list(dict.fromkeys(measured["method"]))
    reference = "reference_loss" in measured
    head = ["scenario", "episode", *(label(name) for name in names), *(["reference simulator"] if reference else [])]
    rows = []
    for (scenario, episode), group in measured.groupby(["scenario", "episode"], sort=False):
        known = dict(zip(group["method"], group["loss"], strict=True))
        cells: list[object] = [scenario, episode, *(known.get(name) for name in names)]
        rows.append(cells + ([group["reference_loss"].iloc[0]] if reference else []))
    return markdown_table(head, rows)


def _means(table: pd.DataFrame) -> list[str]:
    columns = {
        "scenario": "scenario",
        "method": "method",
        "episodes": "episodes",
        "loss": "loss",
        "rms_mm": "rms mm",
        "rms_other_frames_mm": "other frames mm",
        "two_sided": "two-sided",
        "best": "best",
        "success_rate": "success",
        "median_error_ratio": "median ratio error",
        "simulations": "runs",
    }
    kept = [name for name in columns if name in table]
    shown = table[kept].assign(method=table["method"].map(label)) if len(table) else table[kept]
    return _table([columns[name] for name in kept], shown)


def _seconds(table: pd.DataFrame) -> list[str]:
    if table.empty:
        return ["None known."]
    means = table.groupby(["scenario", "method"], sort=False)[[*PHASES, "total"]].mean().reset_index()
    return _table(["scenario", "method", *PHASES, "total"], means.assign(method=means["method"].map(label)))


def _identified(table: pd.DataFrame) -> list[str]:
    if table.empty:
        return ["Not asked for."]
    kept = ["scenario", "episode", "parameter", "value", "low", "high", "ratio_factor", "status", "sources"]
    head = ["scenario", "episode", "parameter", "value", "from", "to", "factor of the ratio", "status", "improve first"]
    return _table(head, table[kept])


def _table(head: Sequence[str], table: pd.DataFrame) -> list[str]:
    if table.empty:
        return ["None."]
    return markdown_table(head, table.to_numpy(dtype=object).tolist())


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table; a missing value is a dash."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return lines + ["| " + " | ".join(_cell(value) for value in row) + " |" for row in rows]


def _cell(value: object) -> str:
    if value is None or value != value:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
