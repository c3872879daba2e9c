"""Repeated recordings of one fabric: repeatability, transfer, and agreement between lift and fold.

No true parameters are needed. Parameters that belong to the fabric must be reproducible, predict another recording of
it, and not depend on the motion. Differences between parameters are in logarithms: 0.69 is a factor of two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd


def fit_of(record: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """Return the metrics of the fit itself; None if it diverges."""
    return next((row for row in record["methods"] if row["method"] == "diffcloud"), None)


def parameter_table(records: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return one row per episode with its own fit: scenario, episode, fabric, category, repeat, loss and parameters.
    `ratio` is stretching over density, if both are there. Nuisance parameters are omitted. Joint fits are omitted,
    since their recordings share the parameters."""
    rows = []
    for record in records:
        fit = fit_of(record)
        if fit is None or record["fit"] != record["episode"]:
            continue
        row = {key: record[key] for key in ("scenario", "episode", "fabric", "category", "repeat")}
        if record["truth"]:
            row["fabric"] = None  # for a simulated target, the label does not identify a physical cloth
        row |= {"loss": fit["loss"]}
        row |= {name: value for name, value in fit["clipped"].items() if name not in record["nuisance"]}
        if {"stretching", "density"} <= fit["clipped"].keys():
            row["ratio"] = fit["clipped"]["stretching"] / fit["clipped"]["density"]
        rows.append(row)
    return pd.DataFrame(rows)


def repeatability(fits: pd.DataFrame) -> pd.DataFrame:
    """Return the spread of each parameter over the repeats of a fabric in a scenario.

    Returns:
        scenario, fabric, parameter, repeats, median, factor: ratio of the largest to the smallest fitted value.
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
    """Return the metrics of parameters fitted to one recording, on another one of the same fabric.

    Returns:
        scenario, fabric, source, target; loss: of the source's parameters on the target; loss_own: of the target's own
            fit; loss_middle: of the mid-range; gain: (loss_middle - loss) / (loss_middle - loss_own). A gain of 1 is as
            good as the own fit, 0 is no better than the mid-range.
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
    """Compare the parameters of one fabric between two motions.

    Returns:
        fabric, parameter, first, second: scenarios; value_first, value_second: geometric means over the repeats;
            factor: ratio of the larger to the smaller.
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
    """Return for each episode the other recordings of its fabric with the parameters fitted to them.

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
    """Return the parameters that are positive in all rows, so that their logarithms exist."""
    labels = {"scenario", "episode", "fabric", "category", "repeat", "loss"}
    return [str(name) for name in group.columns if name not in labels and bool((group[name].astype(float) > 0).all())]
