"""Tables over all episodes, and sentences that summarise them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from diffcloud.estimation.initial_state import is_initial_state
from diffcloud.evaluation.intervals import Combination, significant, worded
from diffcloud.evaluation.methods import PHASES
from diffcloud.evaluation.repeats import consistency, fit_of, parameter_table, repeatability, transfer

LABELS = {
    "diffcloud": "DiffCloud",
    "single_start": "DiffCloud, one start",
    "mlp": "MLP",
    "pointnet2": "PointNet++",
    "meteornet": "MeteorNet",
    "published_mlp": "published MLP",
    "published_pointnet2": "published PointNet++",
    "published_meteornet": "published MeteorNet",
    "middle": "middle of the range",
    "random_search": "random search",
    "cma_es": "CMA-ES",
}
"""Method -> label for people."""
PREDICTORS = (
    "mlp", "pointnet2", "meteornet", "posterior", "published_mlp", "published_pointnet2", "published_meteornet",
)  # fmt: skip
"""Trained methods."""
_CLEARLY = 2.0
"""Difference of two losses that counts as significant, in standard deviations."""
_FAR = 1.25
"""A value is no property of the fabric if repeats or motions differ by this multiple of its interval."""
Records = Sequence[Mapping[str, Any]]
Tables = Mapping[str, pd.DataFrame]
"""Type of the result of `tables`."""


def label(method: str) -> str:
    return LABELS.get(method, method)


def method_table(records: Records, references: Mapping[tuple[str, str], float] | None = None) -> pd.DataFrame:
    """Return one row per episode and method: labels, metrics, parameters. Missing methods have a `status` other than
    `ok` and a reason.

    Args:
        references: (scenario, episode) -> loss of the reference simulator's own fit, measured there, for the column
            `reference_loss`.
    """
    rows: list[dict[str, Any]] = []
    for record in records:
        shared = {key: record[key] for key in ("scenario", "episode", "fabric", "category", "repeat")}
        known = (references or {}).get((record["scenario"], record["episode"]))
        if known is not None:
            shared["reference_loss"] = known
        for method in record["methods"]:
            row = {key: value for key, value in method.items() if key not in ("values", "clipped")}
            row |= {f"value_{name}": value for name, value in method["clipped"].items()}
            rows.append({**shared, "status": "ok", "reason": "", **row})
        for gap in record["gaps"]:
            status = "missing" if gap["expected"] else "not asked for"
            rows.append({**shared, "status": status, "method": gap["method"], "reason": gap["reason"]})
    return pd.DataFrame(rows)


def fit_table(records: Records) -> pd.DataFrame:
    """Return one row per fit: losses at start and end in squared length units and as RMS [mm], fitted and true
    parameters. Losses are means over the episodes of a joint fit. The ratio stretching over density is included,
    because a motion identifies it best."""
    fits: dict[tuple[str, str], list[tuple[Mapping[str, Any], Mapping[str, Any]]]] = {}
    for record in records:
        fit = fit_of(record)
        if fit is not None:
            fits.setdefault((record["scenario"], record["fit"]), []).append((record, fit))
    rows = []
    for (scenario, name), found in fits.items():
        record, fit = found[0]
        to_mm = 1e3 * record["length_unit_m"]
        starts = [record["start"] or {} for record, _ in found]
        losses = {
            "loss_start": _mean_of(starts, "loss"),
            "loss": _mean_of([fit for _, fit in found], "loss"),
            "loss_other_frames": _mean_of([fit for _, fit in found], "loss_other_frames"),
        }
        row: dict[str, Any] = {"scenario": scenario, "episode": name, **losses}
        row |= {key.replace("loss", "rms") + "_mm": to_mm * value**0.5 for key, value in losses.items()}
        row |= {
            f"fitted_{parameter}": value for parameter, value in fit["values"].items() if not is_initial_state(parameter)
        }
        truth = {parameter: value for parameter, value in record["truth"].items() if parameter in fit["values"]}
        row |= {f"true_{parameter}": value for parameter, value in truth.items()}
        for kind, values in (("fitted", fit["values"]), ("true", truth)):
            if {"stretching", "density"} <= values.keys():
                row[f"{kind}_ratio"] = values["stretching"] / values["density"]
        rows.append(row)
    return pd.DataFrame(rows)


def _mean_of(rows: Sequence[Mapping[str, Any]], name: str) -> float:
    """Return the mean of a metric; NaN if a row lacks it."""
    return float(np.mean([row.get(name, math.nan) for row in rows]))


def method_means(table: pd.DataFrame) -> pd.DataFrame:
    """Return one row per scenario and method, over the episodes with a result. It has means of distances and
    simulations, medians of errors, and the success rate. `best` is the number of episodes in which no other method has
    a significantly lower loss."""
    measured = table[table["status"] == "ok"]
    lowest = measured.groupby(["scenario", "episode"])["loss"].transform("min")
    best = measured["loss"] <= lowest + _CLEARLY * measured["loss_deviation"]
    rows = []
    for (scenario, method), group in measured.assign(best=best).groupby(["scenario", "method"], sort=False):
        row: dict[str, Any] = {"scenario": scenario, "method": method, "episodes": len(group)}
        for name in ("loss", "rms_mm", "rms_other_frames_mm", "two_sided", "simulations"):
            row[name] = _mean(group, name)
        row["best"] = int(group["best"].sum())
        if "success" in group and group["success"].notna().any():
            row["success_rate"] = float(group["success"].dropna().astype(float).mean())
        for name in (str(column) for column in group.columns if str(column).startswith("error_")):
            if group[name].notna().any():
                row[f"median_{name}"] = float(group[name].median())
        rows.append(row)
    return pd.DataFrame(rows)


def category_means(table: pd.DataFrame) -> pd.DataFrame:
    """Return mean loss and RMS distance per scenario, category and method, for episodes with a category."""
    measured = table[(table["status"] == "ok") & table["category"].notna()]
    if measured.empty:
        return pd.DataFrame(columns=["scenario", "category", "method", "episodes", "loss", "rms_mm"])
    grouped = measured.groupby(["scenario", "category", "method"], sort=False)
    return grouped.agg(episodes=("loss", "size"), loss=("loss", "mean"), rms_mm=("rms_mm", "mean")).reset_index()


def seconds_table(seconds: Mapping[tuple[str, str], Mapping[str, Mapping[str, float]]]) -> pd.DataFrame:
    """Return one row per episode and method with its wall time in each phase and in total [s].

    Args:
        seconds: (scenario, episode) -> method -> phase -> seconds.
    """
    rows = [
        {"scenario": scenario, "episode": episode, "method": method, **{phase: told.get(phase) for phase in PHASES}}
        for (scenario, episode), methods in seconds.items()
        for method, told in methods.items()
        if told
    ]
    table = pd.DataFrame(rows, columns=["scenario", "episode", "method", *PHASES])
    return table.assign(total=table[list(PHASES)].astype(float).sum(axis=1))


def interval_table(records: Records) -> pd.DataFrame:
    """Return one row per episode and parameter: fitted value, interval, status, interval of the ratio, best-determined
    combination, and the three largest sources of uncertainty."""
    rows = []
    for record in records:
        told = record["intervals"]
        if told is None:
            continue
        ratio = told["ratio"] or {}
        for name, entry in told["parameters"].items():
            row: dict[str, Any] = {"scenario": record["scenario"], "episode": record["episode"], "fabric": record["fabric"]}
            row |= {"parameter": name, "status": entry["status"]}
            row |= {key: entry[key] for key in ("value", "low", "high", "unit", "factor")}
            row |= {"ratio": ratio.get("value"), "ratio_factor": ratio.get("factor")}
            row |= {"combination": None if told["best"] is None else str(Combination.model_validate(told["best"]))}
            row |= {"sources": largest_sources(told["sources"], name), "level": told["level"], "reason": told["reason"]}
            row |= {"warning": told["warning"], "note": told["note"]}
            row |= dict(zip(("posterior_low", "posterior_high"), _posterior(record, name, entry["nominal"]), strict=True))
            rows.append(row)
    return pd.DataFrame(rows)


def _posterior(record: Mapping[str, Any], name: str, nominal: float) -> tuple[float | None, float | None]:
    """Return the interval of a parameter from a network's posterior in SI units, or (None, None)."""
    stated = [row["intervals"] for row in record["methods"] if row.get("intervals")]
    if not stated or name not in stated[0]:
        return None, None
    low, high = stated[0][name]
    return low * nominal, high * nominal


def percent(share: float) -> str:
    """Return a fraction (1 is 100 %) as text: "42 %", "0.4 %", "less than 0.1 %". Only an exact zero reads "0 %", and
    no fraction below 1 reads "100 %"."""
    value = 100 * share
    for digits in (0, 1):
        rounded = round(value, digits)
        if rounded == value or (rounded != 0 and not value < 100 <= rounded):
            return f"{rounded:.{digits}f} %"
    return "less than 0.1 %" if value < 1 else "more than 99.9 %"


def against(below: float) -> str:
    """Return a relative difference as text, "33 % below" or "2 % above"; `below` is positive for a smaller value."""
    return f"{percent(abs(below))} {'below' if below >= 0 else 'above'}"


def largest_sources(sources: Mapping[str, Mapping[str, float]], name: str, count: int = 3) -> str:
    """Return the largest sources of a parameter's variance as text, with their percentages."""
    largest = max((abs(deviations[name]) for deviations in sources.values()), default=0.0) or 1.0
    variances = {source: (deviations[name] / largest) ** 2 for source, deviations in sources.items()}  # none overflows
    total = sum(variances.values()) or 1.0
    ranked = sorted(variances.items(), key=lambda item: -item[1])[:count]
    return ", ".join(
        f"{source.replace('_', ' ')} {100 * part / total:.0f} %" for source, part in ranked if part > 0.01 * total
    )


def tables(
    records: Records,
    seconds: Mapping[tuple[str, str], Mapping[str, Mapping[str, float]]],
    references: Mapping[tuple[str, str], float] | None = None,
) -> dict[str, pd.DataFrame]:
    """Return all tables of the comparison by file name. Only `seconds` has wall times."""
    methods = method_table(records, references)
    parameters = parameter_table(records)
    return {
        "fits": fit_table(records),
        "methods": methods,
        "means": method_means(methods),
        "categories": category_means(methods),
        "intervals": interval_table(records),
        "repeatability": repeatability(parameters),
        "transfer": transfer(records),
        "consistency": consistency(parameters),
        "parameters": parameters,
        "seconds": seconds_table(seconds),
    }


def against_predictors(table: pd.DataFrame) -> pd.DataFrame:
    """Compare DiffCloud with the best trained or published predictor.

    Returns:
        scenario, episodes; lowest: number of episodes in which DiffCloud's loss is the lowest to within sampling noise;
            predictor: the one with the lowest mean relative to DiffCloud's in the same episodes; predictor_loss, loss:
            these means; below: relative difference, positive if DiffCloud's is lower.
    """
    measured = table[table["status"] == "ok"]
    rows = []
    for scenario, group in measured.groupby("scenario", sort=False):
        losses = group.pivot_table(index="episode", columns="method", values="loss", sort=False)
        noise = group.pivot_table(index="episode", columns="method", values="loss_deviation", sort=False)
        predictors = [name for name in PREDICTORS if name in losses]
        if "diffcloud" not in losses or not predictors:
            continue
        both = losses[losses["diffcloud"].notna() & losses[predictors].notna().any(axis=1)]
        lowest = both["diffcloud"] <= both[predictors].min(axis=1) + _CLEARLY * noise.loc[both.index, "diffcloud"]
        # compare on each predictor's own episodes, so that failing in a hard episode is no advantage
        ratios = {
            name: float(both["diffcloud"][both[name].notna()].mean() / both[name].mean())
            for name in predictors
            if both[name].notna().any()
        }
        if not ratios:
            continue
        best = max(ratios, key=lambda name: ratios[name])
        rows.append(
            {
                "scenario": scenario,
                "episodes": len(both),
                "lowest": int(lowest.sum()),
                "loss": float(both["diffcloud"][both[best].notna()].mean()),
                "predictor": best,
                "predictor_loss": float(both[best].mean()),
                "below": float(1 - ratios[best]),
            }
        )
    columns = ["scenario", "episodes", "lowest", "loss", "predictor", "predictor_loss", "below"]
    return pd.DataFrame(rows, columns=columns)


def against_reference(table: pd.DataFrame, *, within: float = 0.05) -> tuple[int, int] | None:
    """Return the number of episodes in which DiffCloud's loss is at most `within` above the reference simulator's fit,
    and the number of episodes with such a fit."""
    if "reference_loss" not in table:
        return None
    known = table[(table["method"] == "diffcloud") & (table["status"] == "ok") & table["reference_loss"].notna()]
    return int((known["loss"] <= (1 + within) * known["reference_loss"]).sum()), len(known)


def metrics(told: Tables) -> dict[str, Any]:
    """Return all numbers of the comparison: means per scenario and method, best methods, statuses. No wall times."""
    by_scenario: dict[str, Any] = {}
    for row in told["means"].to_dict("records"):
        entry = {str(key): value for key, value in row.items() if key not in ("scenario", "method") and not _unknown(value)}
        by_scenario.setdefault(row["scenario"], {})[row["method"]] = entry
    found: dict[str, Any] = {"methods": by_scenario}
    found["against_predictors"] = {
        row.pop("scenario"): row for row in against_predictors(told["methods"]).to_dict("records")
    }
    reference = against_reference(told["methods"])
    if reference is not None:
        found["against_reference"] = {"within_5_percent": reference[0], "episodes": reference[1]}
    table = told["intervals"]
    if not table.empty:
        statuses: dict[str, Any] = {}
        for (scenario, parameter), group in table.groupby(["scenario", "parameter"], sort=False):
            counts = group["status"].value_counts(sort=False)
            statuses.setdefault(str(scenario), {})[str(parameter)] = {str(key): int(n) for key, n in counts.items()}
        found["statuses"] = statuses
    return found


def headline(told: Tables) -> dict[str, Any]:
    """Return the main numbers for `metrics.json`, to compare revisions: 4 significant digits, no wall times.

    Networks are omitted. Their training depends on the rounding of the processor, and with the same samples and
    settings distances may differ by a quarter. `tables/means.csv` has them.

    Returns:
        scenario -> `rms_mm` (method -> mean RMS distance at the compared frames [mm]). If known for the fits, also
            `rms_other_frames_mm` (mean) and `ratio_factor` (median factor, at least 1, between fitted and true ratios).
    """
    found: dict[str, Any] = {}
    for row in told["means"].to_dict("records"):
        if row["method"] in PREDICTORS:
            continue
        entry = found.setdefault(str(row["scenario"]), {"rms_mm": {}})
        entry["rms_mm"][str(row["method"])] = row["rms_mm"]
        if row["method"] == "diffcloud" and not _unknown(row["rms_other_frames_mm"]):
            entry["rms_other_frames_mm"] = row["rms_other_frames_mm"]
    fits = told["fits"]
    if {"fitted_ratio", "true_ratio"} <= set(fits.columns):
        for scenario, group in fits.dropna(subset=["fitted_ratio", "true_ratio"]).groupby("scenario", sort=False):
            off = np.abs(np.log(group["fitted_ratio"] / group["true_ratio"]))
            found[str(scenario)]["ratio_factor"] = np.exp(np.median(off))
    return _rounded(found)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    return float(f"{value:.4g}")


def sentences(told: Tables) -> dict[str, list[str]]:
    """Return the comparison as sentences by topic: best methods, success, intervals, repeats, credibility."""
    return {
        "winners": _winners(told),
        "success": _success(told),
        "intervals": _identified(told["intervals"]),
        "repeats": _repeats(told),
        "credibility": _credibility(told),
    }


def overview(told: Tables) -> pd.DataFrame:
    """Return one row per scenario. It has the methods with the two lowest mean losses, the mid-range baseline, the
    difference to the best predictor, and the most frequent status of each parameter."""
    below = {row["scenario"]: row["below"] for row in against_predictors(told["methods"]).to_dict("records")}
    statuses = told["intervals"]
    rows = []
    for scenario, group in told["means"].groupby("scenario", sort=False):
        ranked = group.sort_values("loss", kind="stable").to_dict("records")
        row: dict[str, Any] = {"scenario": str(scenario), "episodes": max(int(one["episodes"]) for one in ranked)}
        for place, one in zip(("first", "second"), ranked, strict=False):
            row |= {place: label(one["method"]), f"{place}_mm": one["rms_mm"]}
        row["middle_mm"] = next((one["rms_mm"] for one in ranked if one["method"] == "middle"), None)
        row["below_predictor"] = below.get(scenario)
        if not statuses.empty:
            for name, part in statuses[statuses["scenario"] == scenario].groupby("parameter", sort=False):
                status, count = next(iter(part["status"].value_counts().items()))
                row[f"status_{name}"] = f"{worded(str(status))} ({count}/{len(part)})"
        rows.append(row)
    return pd.DataFrame(rows)


def _winners(told: Tables) -> list[str]:
    found = []
    for scenario, group in told["means"].groupby("scenario", sort=False):
        ranked = group.sort_values("loss", kind="stable")
        first, middle = ranked.iloc[0], group[group["method"] == "middle"]
        text = f"{scenario}: {label(first['method'])} has the lowest mean loss over {_count(int(first['episodes']))}, "
        text += f"{first['rms_mm']:.1f} mm (RMS)"
        if len(ranked) > 1:
            second = ranked.iloc[1]
            text += f"; next {label(second['method'])}, {second['rms_mm']:.1f} mm"
        if len(middle):
            text += f"; the middle of the range, {middle['rms_mm'].iloc[0]:.1f} mm"
        found.append(text + ".")
    for row in against_predictors(told["methods"]).to_dict("records"):
        found.append(
            f"{row['scenario']}: against predictors DiffCloud is lowest, within the sampling noise, in {row['lowest']} of "
            f"{row['episodes']} episodes; its mean loss is {against(row['below'])} that of the best one, "
            f"{label(row['predictor'])}."
        )
    reference = against_reference(told["methods"])
    if reference is not None:
        found.append(
            f"Within 5 % of the reference simulator's own fits, or below: {reference[0]} of {reference[1]} episodes."
        )
    return found


def _success(told: Tables) -> list[str]:
    means = told["means"]
    if "success_rate" not in means:
        return []
    found = []
    for scenario, group in means[means["success_rate"].notna()].groupby("scenario", sort=False):
        rates = ", ".join(f"{label(row['method'])} {percent(row['success_rate'])}" for row in group.to_dict("records"))
        found.append(f"{scenario}, simulated targets below the paper's threshold: {rates}.")
    return found


def _identified(table: pd.DataFrame) -> list[str]:
    if table.empty:
        return []
    found = []
    for (scenario, name), group in table.groupby(["scenario", "parameter"], sort=False):
        counts = ", ".join(f"{worded(str(status))} in {count}" for status, count in group["status"].value_counts().items())
        text = f"{scenario}: status of {name}: {counts} of {_count(len(group))}"
        if group["factor"].notna().any():
            text += f"; {group['level'].iloc[0]:.0%} intervals end within {_times(group['factor'].median())} (median)"
        found.append(f"{text}.")
    for scenario, group in table.drop_duplicates(["scenario", "episode"]).groupby("scenario", sort=False):
        if group["ratio_factor"].notna().any():
            found.append(
                f"{scenario!s}: stretching / density is known within {_times(group['ratio_factor'].median())} (median)."
            )
    for kind in ("reason", "warning"):
        for row in table[table[kind] != ""].drop_duplicates(["scenario", "episode"]).to_dict("records"):
            found.append(f"{row['scenario']} / {row['episode']}: {row[kind]}.")
    for row in table[table["note"] != ""].drop_duplicates(["scenario", "note"]).to_dict("records"):
        found.append(f"{row['scenario']}: {row['note']}.")
    for row in table[table["low"].notna() & table["posterior_low"].notna()].to_dict("records"):
        if row["posterior_low"] > row["high"] or row["posterior_high"] < row["low"]:
            digits = significant(row["low"], row["high"])
            fitted, told = (f"{digits(row[f'{kind}low'])} to {digits(row[f'{kind}high'])}" for kind in ("", "posterior_"))
            found.append(
                f"{row['scenario']} / {row['episode']}: fit and posterior disagree on {row['parameter']} by more than "
                f"their widths: {fitted} and {told}. Believe neither before you know why."
            )
    return found


def _repeats(told: Tables) -> list[str]:
    found = []
    for scenario, group in told["repeatability"].groupby("scenario", sort=False):
        factors = group.groupby("parameter", sort=False)["factor"].median()
        text = ", ".join(f"{_times(value)} in {name}" for name, value in factors.items())
        found.append(f"{scenario}: repeats of one fabric differ, in the median, by {text}.")
    known = told["transfer"]
    for scenario, group in known[known[["loss_own", "loss_middle"]].notna().all(axis=1)].groupby("scenario", sort=False):
        better = int((group["loss"] < group["loss_middle"]).sum())
        found.append(
            f"{scenario}: parameters of one repeat predict another better than the middle of the range in {better} of "
            f"{len(group)} cases; their loss is {(group['loss'] / group['loss_own']).median():.2g} times that of its own "
            f"fit, the middle's {(group['loss_middle'] / group['loss_own']).median():.2g} times (medians)."
        )
    for (first, second), group in told["consistency"].groupby(["first", "second"], sort=False):
        factors = group.groupby("parameter", sort=False)["factor"].median()
        text = ", ".join(f"{_times(value)} in {name}" for name, value in factors.items())
        found.append(f"{first} and {second} of one fabric disagree, in the median, by {text}.")
    return found


def _credibility(told: Tables) -> list[str]:
    """Compare the intervals of one recording with the spread over repeats and another motion of the same fabric."""
    promised, repeats, motions = told["intervals"], told["repeatability"], told["consistency"]
    if promised.empty or repeats.empty:
        return []
    found = []
    for (scenario, name), group in repeats.groupby(["scenario", "parameter"], sort=False):
        chosen = promised[(promised["scenario"] == scenario) & (promised["parameter"] == name)]
        own = chosen["factor"].astype(float).median()
        if math.isnan(own):
            continue
        spreads = {"repeats of a fabric differ by": group["factor"]}
        if not motions.empty:
            other = motions[
                ((motions["first"] == scenario) | (motions["second"] == scenario)) & (motions["parameter"] == name)
            ]
            if len(other):
                spreads["another motion of it by"] = other["factor"]
        text = f"{scenario}: the interval of one recording gives {name} within {_times(own)} (median); "
        text += ", ".join(
            f"{what} {_times(factors.median())}, at most {factors.max():.3g}" for what, factors in spreads.items()
        )
        # use the worst fabric, since a new one may be like it
        if max(factors.max() for factors in spreads.values()) > _FAR * own:
            text += ": the number holds for its own recording, and not for the fabric to that precision"
        else:
            text += ": the number holds beyond its own recording"
        found.append(f"{text}.")
    return found


def _count(episodes: int) -> str:
    return f"{episodes} episode{'' if episodes == 1 else 's'}"


def _mean(group: pd.DataFrame, name: str) -> float | None:
    return float(group[name].mean()) if name in group and group[name].notna().any() else None


def _times(value: float) -> str:
    return f"a factor of {value:.3g}" if value < 1000 else "a factor of more than 1000"


def _unknown(value: Any) -> bool:
    return value is None or (isinstance(value, float) and math.isnan(value))
