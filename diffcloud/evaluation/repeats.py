"""What repeats of one fabric say of the parameters: repeatability, transfer, agreement between lift and fold.

None of this needs a ground truth. Parameters that belong to the fabric must come out again when it is recorded again, must
predict another recording of it, and must not depend on the motion. Distances between parameters are in logarithms: 0.69 is
a factor of two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd


def fit_of(record: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """What was measured of the fit itself; None if it diverges."""
    return next((row for row in record["methods"] if row["method"] == "diffcloud"), None)


def parameter_table(records: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """One row per episode with a fit of its own: scenario, episode, fabric, category, repeat, loss, and a column
    per parameter but those fitted too because they are not known exactly, with their `ratio` where both are
    there. Joint fits are left out: their recordings agree because they were made to."""
    rows = []
    for record in records:
        fit = fit_of(record)
        if fit is None or record["fit"] != record["episode"]:
            continue
        row = {key: record[key] for key in ("scenario", "episode", "fabric", "category", "repeat")}
        if record["truth"]:
            row["fabric"] = None  # a simulated target has known parameters; its label names no cloth that is met again
        row |= {"loss": fit["loss"]}
        row |= {name: value for name, value in fit["clipped"].items() if name not in record["nuisance"]}
        if {"stretching", "density"} <= fit["clipped"].keys():
            row["ratio"] = fit["clipped"]["stretching"] / fit["clipped"]["density"]
        rows.append(row)
    return pd.DataFrame(rows)


def repeatability(fits: pd.DataFrame) -> pd.DataFrame:
    """Spread of each parameter over the repeats of a fabric in a scenario.

    Returns:
        scenario, fabric, parameter, repeats, median, factor: the largest fitted value over the smallest.
    """
    rows = []
    for (scenario, fabric), group in _fabrics(fits, ["scenario", "fabric"]):
        if len(group) < 2:
            continue
        for name in _positive(group):
            values = group[name].to_numpy(dtype=float)
            rows.append(
                {
                    "scenario": scenario,
                    "fabric": fabric,
                    "parameter": name,
                    "repeats": len(values),
                    "median": float(np.median(values)),
                    "factor": float(values.max() / values.min()),
                }
            )
    return pd.DataFrame(rows, columns=["scenario", "fabric", "parameter", "repeats", "median", "factor"])


def transfer(records: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Parameters fitted on one recording, on another one of the same fabric.

    Returns:
        scenario, fabric, source, target, loss: of the source's parameters on the target; loss_own: of the target's own fit;
        loss_middle: of the middle of the range; gain: how much of the way from the middle to the own fit the transferred
        parameters go (1: as good as its own fit, 0: no better than the middle, below: worse).
    """
    rows = []
    for record in records:
        losses = {row["method"]: row["loss"] for row in record["methods"]}
        own, middle = losses.get("diffcloud"), losses.get("middle")
        for found in record["transfers"]:
            gain = None
            if own is not None and middle is not None and middle > own:
                gain = (middle - found["loss"]) / (middle - own)
            rows.append(
                {
                    "scenario": record["scenario"],
                    "fabric": record["fabric"],
                    "source": found["source"],
                    "target": record["episode"],
                    "loss": found["loss"],
                    "loss_own": own,
                    "loss_middle": middle,
                    "gain": gain,
                }
            )
    columns = ["scenario", "fabric", "source", "target", "loss", "loss_own", "loss_middle", "gain"]
    return pd.DataFrame(rows, columns=columns)


def consistency(fits: pd.DataFrame) -> pd.DataFrame:
    """Whether two motions give one fabric the same parameters.

    Returns:
        fabric, parameter, first, second: scenarios; value_first, value_second: geometric means over the repeats; factor:
        the larger over the smaller.
    """
    rows = []
    for (fabric,), group in _fabrics(fits, ["fabric"]):
        scenarios = dict(list(group.groupby("scenario", sort=False)))
        for first, second in combinations(scenarios, 2):
            for name in _positive(group):
                a, b = (float(np.exp(np.log(scenarios[s][name].to_numpy(float)).mean())) for s in (first, second))
                rows.append(
                    {
                        "fabric": fabric,
                        "parameter": name,
                        "first": first,
                        "second": second,
                        "value_first": a,
                        "value_second": b,
                        "factor": max(a, b) / min(a, b),
                    }
                )
    columns = ["fabric", "parameter", "first", "second", "value_first", "value_second", "factor"]
    return pd.DataFrame(rows, columns=columns)


def other_repeats(
    episodes: Mapping[str, Mapping[str, Any]], fits: Mapping[str, Mapping[str, float]]
) -> dict[str, dict[str, Mapping[str, float]]]:
    """Episode -> the other recordings of its fabric and the parameters fitted on them.

    Args:
        episodes: name -> meta of one scenario's episodes.
        fits: name -> parameters.
    """
    return {
        name: {
            other: fits[other]
            for other, told in episodes.items()
            if other != name and other in fits and meta.get("fabric") is not None and told.get("fabric") == meta["fabric"]
        }
        for name, meta in episodes.items()
    }


def _fabrics(fits: pd.DataFrame, by: list[str]) -> list[tuple[tuple[str, ...], pd.DataFrame]]:
    if fits.empty:
        return []
    known = fits[fits["fabric"].notna()]
    return [(tuple(map(str, key)), group) for key, group in known.groupby(by, sort=False)]


def _positive(group: pd.DataFrame) -> list[str]:
    """Parameters whose logarithms exist, in all rows."""
    labels = {"scenario", "episode", "fabric", "category", "repeat", "loss"}
    return [str(name) for name in group.columns if name not in labels and bool((group[name].astype(float) > 0).all())]
