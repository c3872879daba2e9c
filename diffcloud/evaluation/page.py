"""The comparison of all methods as a page of results."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from diffcloud.evaluation.markdown import Blocks, markdown_table, result_page
from diffcloud.evaluation.methods import PHASES
from diffcloud.evaluation.summary import Tables, against, against_predictors, label, overview, sentences

_HEADINGS = {
    "rms_mm": "RMS mm",
    "rms_other_frames_mm": "other frames mm",
    "two_sided": "two-sided",
    "success_rate": "success",
    "median_error_ratio": "median ratio error",
    "simulations": "runs",
    "low": "from",
    "high": "to",
    "ratio_factor": "factor of the ratio",
    "sources": "improve first",
    "source": "from",
    "target": "to",
    "loss_own": "own fit",
    "loss_middle": "mid-range",
    "value_first": "value in the first",
    "value_second": "value in the second",
}
"""Column of a table -> its heading, where this is another one."""


def comparison_page(told: Tables, missing: Sequence[str], title: str, command: str) -> str:
    """Return the page: the best method of each scenario, and folded tables of all results.

    Args:
        told: result of `summary.tables`.
        missing: missing results that were expected.
        title: what is compared; the page's question begins with it.
        command: what makes the page.
    """
    best = overview(told).to_dict("records")
    predictors = {row["scenario"]: row for row in against_predictors(told["methods"]).to_dict("records")}
    head = ["scenario", "episodes", "lowest mean loss", "RMS mm", "next", "RMS mm", "mid-range RMS mm"]
    head += ["DiffCloud lowest against predictors", "its mean loss against the best predictor's"]
    rows = []
    for row in best:
        cells: list[object] = [
            row.get(key) for key in ("scenario", "episodes", "first", "first_mm", "second", "second_mm", "middle_mm")
        ]
        one = predictors.get(row["scenario"])
        rows.append(
            [*cells, f"{one['lowest']} of {one['episodes']}" if one else None, against(one["below"]) if one else None]
        )
    where = {
        name: " and ".join(f"{row['scenario']} ({row['first_mm']:.3g} mm)" for row in best if row["first"] == name)
        for name in dict.fromkeys(row["first"] for row in best)
    }
    won = ", ".join(f"{name} in {scenarios}" for name, scenarios in where.items())
    answer = f"{won.replace(' in ', ' has the lowest mean loss in ', 1)}."
    if predictors:
        compared = ", ".join(f"{one['lowest']} of {one['episodes']} ({name})" for name, one in predictors.items())
        answer += f" Against predictors, DiffCloud is lowest in {compared} episodes."
    return result_page(
        f"{title}: which method has the lowest loss?",
        answer,
        markdown_table(head, rows),
        note="Millimetres are RMS distances from the simulated to the recorded points at the frames of the fit. Counts "
        "allow for sampling noise." + f" {len(missing)} expected results are missing." * bool(missing),
        command=command,
        details={summary: blocks for summary, blocks in _details(told, missing).items() if blocks[-1]},
    )


def _details(told: Tables, missing: Sequence[str]) -> dict[str, Blocks]:
    """Summary -> paragraphs, of which the last is empty where there is nothing to show."""
    means = told["means"].assign(method=told["means"]["method"].map(label))
    phases = [*PHASES, "total"]
    seconds = told["seconds"].groupby(["scenario", "method"], sort=False)[phases].mean().reset_index()
    return {
        "Findings": [[f"- {line}" for lines in sentences(told).values() for line in lines]],
        "Loss per episode": [
            "Loss by the fit's measure at its frames, squared length units of the scene, fresh points, parameters clipped "
            "to the bounds.",
            _losses(told["methods"]),
        ],
        "Means": [
            "RMS distances at the fit's frames and at all others; `best` counts episodes where no method is clearly lower; "
            "`runs` are simulations per episode.",
            _table(
                means,
                "scenario method episodes loss rms_mm rms_other_frames_mm two_sided best "
                "success_rate median_error_ratio simulations",
            ),
        ],
        "Seconds per episode": [
            _table(seconds.assign(method=seconds["method"].map(label)), " ".join(["scenario", "method", *phases]))
        ],
        "What is identified": [
            "Intervals at the stated level, statuses, and the largest sources of uncertainty with their parts of the "
            "variance.",
            _table(told["intervals"], "scenario episode parameter value low high ratio_factor status sources"),
        ],
        "Repeats of one fabric": [
            "Factor: largest by smallest value.",
            _table(told["repeatability"], "scenario fabric parameter repeats median factor"),
        ],
        "Transfer between repeats": [
            "Loss of one recording's parameters on another of the same fabric.",
            _table(told["transfer"], "scenario source target loss loss_own loss_middle gain"),
        ],
        "One fabric in two motions": [
            _table(told["consistency"], "fabric parameter first second value_first value_second factor")
        ],
        "What is missing": [[f"- {line}" for line in missing]],
    }


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


def _table(table: pd.DataFrame, columns: str) -> list[str]:
    """Return the lines of those columns that the table has; none without rows."""
    kept = [name for name in columns.split() if name in table]
    return markdown_table([_HEADINGS.get(name, name) for name in kept], table[kept].to_numpy(dtype=object).tolist())
