"""What the records of `python -m studies coverage` say, and the page that they make."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from diffcloud.errors import ConfigError
from diffcloud.estimation.settings import LEVEL
from diffcloud.evaluation.markdown import Blocks, markdown_table, result_page
from diffcloud.evaluation.summary import largest_sources
from diffcloud.io.files import files_in, read_json

REFITS = "refits"
"""Last part of the name of a folder whose records are of few cloths, each recorded several times."""
_RATIO = "stretching / density"
Counts = dict[tuple[str, str], dict[str, Any]]
"""(scenario, name of a folder of records) -> what these say, as of `counted`."""
Cell = tuple[tuple[str, str, str], dict[str, Any]]
"""(scenario, known, parameter), and what the records of that folder say of it."""
HEAD = (
    "scenario",
    "known",
    "parameter",
    "recordings",
    "stated",
    "hold the truth",
    "RMS error",
    "median error",
    "median half-width",
    "identified",
)
REFIT_HEAD = ("scenario", "known", "parameter", "cloths", "held", "of held: identified", "of others: identified")
TOGETHER_HEAD = ("truth", "rows", "cases", "hold the truth", "rows in the band")
SOURCE_HEAD = ("scenario", "known", "parameter", "hold the truth with noise alone", "largest sources")


def counts_of(out: Path) -> Counts:
    """Of all folders of records that `coverage` has filled."""
    return {
        (scenario.name, folder.name): counted(folder)
        for scenario in sorted(path for path in out.iterdir() if path.is_dir())
        for folder in sorted(path for path in scenario.iterdir() if path.is_dir() and files_in(path, ".json"))
    }


def counted(folder: Path) -> dict[str, Any]:
    """What the records of one folder say.

    Returns:
        level: of the intervals; parameters: name -> n, stated: with an interval, covered: those that hold the truth,
        median_factor: of the intervals, rms_error: of the logarithm, statuses, identified_within: of those called
        identified, how many are within the factor, noise_alone: how many intervals of the noise of residuals alone would
        hold the truth, sources: source -> median deviation; ratio: the same of the ratio, if both are fitted; refits:
        as of `_held_by_refits`, where each cloth was recorded several times.

    Raises:
        ConfigError: intervals of several levels.
    """
    named = {path.stem: read_json(path) for path in files_in(folder, ".json")}
    records = list(named.values())
    fitted = next((list(one["intervals"]["parameters"]) for one in records if "intervals" in one), [])
    parameters = {name: _count(records, name) for name in fitted}
    told: dict[str, Any] = {"parameters": parameters, "level": level_of(folder, records) or LEVEL}
    if any("ratio" in one.get("intervals", {}) for one in records) and {"stretching", "density"} <= set(fitted):
        told["ratio"] = _count(records, "ratio")
    if folder.name.endswith(REFITS):
        told["refits"] = _held_by_refits(named)
    return told


def level_of(folder: Path, records: Sequence[Mapping[str, Any]]) -> float | None:
    """Of the intervals that a folder's records state; None where none does.

    Raises:
        ConfigError: they are several.
    """
    levels = {one["intervals"]["level"] for one in records if "intervals" in one}
    if len(levels) > 1:
        raise ConfigError(
            f"{folder} holds intervals of several levels, {', '.join(map(str, sorted(levels)))}. Choose another --out."
        )
    return next(iter(levels), None)


def _count(records: Sequence[Mapping[str, Any]], name: str) -> dict[str, Any]:
    offs, widths, covered, statuses, right, alone = [], [], 0, dict[str, int](), 0, 0
    sources: dict[str, list[float]] = {}
    for record in records:
        if "intervals" not in record:
            continue
        truth, told = record["truth"], record["intervals"]
        entry = told["ratio"] if name == "ratio" else told["parameters"][name]
        true = entry["nominal"] * (truth["stretching"] / truth["density"] if name == "ratio" else truth[name])
        off = abs(math.log(entry["value"] / true))
        offs.append(off)
        if entry["low"] is not None:
            covered += entry["low"] <= true <= entry["high"]
            widths.append(math.log(entry["high"] / entry["low"]) / 2)
        if (status := entry.get("status")) is not None:
            statuses[status] = statuses.get(status, 0) + 1
            right += status == "identified" and off <= math.log(told["within"])
        if entry["low"] is None or "sources" not in told:
            continue
        for source, deviations in told["sources"].items():
            sources.setdefault(source, []).append(deviations[name])
        if "recording" in told["sources"]:
            alone += off <= NormalDist().inv_cdf(0.5 + told["level"] / 2) * told["sources"]["recording"][name]
    return {
        "n": len(records),
        "stated": len(widths),
        "covered": covered,
        "median_factor": math.exp(float(np.median(widths))) if widths else None,
        "median_half_width": float(np.median(widths)) if widths else None,
        "rms_error": float(np.sqrt(np.mean(np.square(offs)))) if offs else None,
        "median_error": float(np.median(offs)) if offs else None,
        "statuses": statuses,
        "identified_within": right,
        "noise_alone": int(alone),
        "sources": {source: float(np.median(deviations)) for source, deviations in sources.items()},
    }


def summary(cells: Sequence[Cell]) -> list[list[str]]:
    """Rows under `HEAD`."""
    return [
        [
            *labels,
            str(count["n"]),
            str(count["stated"]),
            _share(count["covered"], count["n"]),
            _number(count["rms_error"]),
            _number(count["median_error"]),
            _number(count["median_half_width"]),
            f"{count['identified_within']} of {count['statuses'].get('identified', 0)}" if labels[2] != _RATIO else "",
        ]
        for labels, count in cells
    ]


def _together(cells: Sequence[Cell], level: float) -> list[list[str]]:
    """Rows under `TOGETHER_HEAD`: of fits, by how their truths were made, and of networks."""
    kinds: dict[str, list[dict[str, Any]]] = {"same": [], "refined": [], "finer": []}
    for (_, known, _), count in cells:
        words = known.split()
        fitted = words[0] == "free" or "known" in words
        kinds.setdefault(("same" if words[-1] in ("free", "known") else words[-1]) if fitted else known, []).append(count)
    rows = []
    for kind, counts in kinds.items():
        if counts:
            cases, covered = np.array([(count["n"], count["covered"]) for count in counts]).T
            least, most = _band(cases, level)
            inside = f"{((least <= covered) & (covered <= most)).sum()} of {len(cases)}"
            rows.append([kind, str(len(cases)), str(cases.sum()), _share(covered.sum(), cases.sum()), inside])
    return rows


def _band(cases: Any, level: float) -> tuple[Any, Any]:
    """Least and most of so many cases, a number or an array, that hold the truth in 99 of 100 rows of such intervals."""
    from scipy.stats import binom  # slow to import

    least, most = binom.interval(0.99, cases, level)
    return least, most


def _sources(cells: Sequence[Cell]) -> list[list[str]]:
    """Rows under `SOURCE_HEAD`, of cells whose intervals name their sources."""
    return [
        [
            *labels,
            _share(count["noise_alone"], count["n"]),
            largest_sources({source: {"": deviation} for source, deviation in count["sources"].items()}, "", 4),
        ]
        for labels, count in cells
        if count["sources"]
    ]


def cells_of(counts: Counts) -> Iterator[Cell]:
    """Of all folders of records, but those of refits."""
    for (scenario, folder), told in counts.items():
        if "refits" not in told:
            ratio = {_RATIO: told["ratio"]} if "ratio" in told else {}
            for name, count in (told["parameters"] | ratio).items():
                yield (scenario, folder.replace("_", " "), name), count


def refit_rows(counts: Counts) -> Iterator[list[str]]:
    """Rows under `REFIT_HEAD`: of parameters that refits hold, and of others, how often refits call them identified."""
    for (scenario, folder), told in counts.items():
        for name, of in told.get("refits", {}).items():
            named = [
                f"{part} of {whole} ({100 * part / whole:.0f} %)" if whole else ""
                for part, whole in (of["identified"], of["others"])
            ]
            known = folder.removesuffix(f"_{REFITS}").replace("_", " ")
            yield [scenario, known, name, str(of["cloths"]), str(of["held"]), *named]


def _held_by_refits(named: Mapping[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """
    Args:
        named: name of a file, <cloth>_<refit>, -> its record.

    Returns:
        parameter -> cloths, held: of how many at least the share `level` of all refits is within the status's factor of
        the truth, identified: (refits of these with the status identified, all refits of these), others: the same of other
        cloths.
    """
    cloths: dict[str, list[dict[str, Any]]] = {}
    for name, record in named.items():
        cloths.setdefault(name.partition("_")[0], []).append(record)
    found: dict[str, dict[str, Any]] = {}
    stated = [record["intervals"] for record in named.values() if "intervals" in record]
    for records in cloths.values() if stated else ():
        fits = [record["intervals"] | {"truth": record["truth"]} for record in records if "intervals" in record]
        for name in stated[0]["parameters"]:
            entries = [
                (fit["parameters"][name], fit["truth"][name] * fit["parameters"][name]["nominal"], fit["within"])
                for fit in fits
            ]
            near = sum(abs(math.log(entry["value"] / true)) <= math.log(within) for entry, true, within in entries)
            held = near >= stated[0]["level"] * len(records)
            named = sum(entry["status"] == "identified" for entry, _, _ in entries)
            told = found.setdefault(name, {"cloths": 0, "held": 0, "identified": (0, 0), "others": (0, 0)})
            told["cloths"] += 1
            told["held"] += held
            key = "identified" if held else "others"
            told[key] = (told[key][0] + named, told[key][1] + len(records))
    return found


def coverage_page(counts: Counts) -> str:
    """Markdown of docs/results/coverage.md.

    Raises:
        ConfigError: no records, or of several levels.
    """
    levels = sorted({told["level"] for told in counts.values()})
    if len(levels) != 1:
        raise ConfigError(f"A page is of records of one level of intervals, got {', '.join(map(str, levels)) or 'none'}.")
    level = f"{levels[0] * 100:g} %"
    cells = list(cells_of(counts))
    together, sources, refits = _together(cells, levels[0]), _sources(cells), list(refit_rows(counts))
    networks = [row for row in together if row[0] not in ("same", "refined", "finer")]
    usual = int(np.median([count["n"] for _, count in cells] or [0]))
    least, most = _band(usual, levels[0])
    details: dict[str, Blocks] = {
        "Each parameter": [
            "Stretching and density are drawn at random; `lift` and `fold` are recorded by two depth cameras and "
            "preprocessed, the others by their whole surface. Nuisance material is off by the factors that fits state "
            "(`estimation.uncertain`). Cameras and clock are off by what fits assume of a calibrated set-up: 2 mm and 0.3° "
            "along and about each axis, and 2 ms, as standard deviations. The cloth is displaced by about a centimetre.",
            "Errors and half-widths are of the natural logarithm: 0.1 is about 10 %. *Identified*: of the recordings with "
            "that status, how many are within its factor of the true value. A fit without an interval counts as a miss."
            + " The prior of a posterior is the distribution of its training set, which may be wider than that of these "
            "cloths." * bool(networks),
            markdown_table(HEAD, summary(cells)),
        ],
        "Where the uncertainty comes from": [
            "Each source's share of the variance, from its median standard deviation over the recordings: the four largest "
            "above 1 %. [evaluation.md](../evaluation.md#what-is-identified) explains each. The fourth column counts the "
            "intervals that would still contain the true value with the source `noise` alone.",
            markdown_table(SOURCE_HEAD, sources),
        ],
        "Fresh recordings of the same cloths": [
            "All but the cloth is drawn anew. A parameter is *held* where at least "
            f"{level} of the recordings find it within the status's factor of the true value. The last two columns count "
            "recordings with the status *identified*.",
            markdown_table(REFIT_HEAD, refits),
        ],
    }
    found = [f"{row[3]} of {row[2]} cases ({row[0]})" for row in together]
    found += [f"{row[4]} of {row[3]} cloths in fresh recordings ({row[1]}, {row[2]})" for row in refits if not together]
    return result_page(
        f"How often do {level} intervals{' of fits and networks' * bool(networks)} contain the true value?",
        f"In {', '.join(found)}.",
        markdown_table(TOGETHER_HEAD, together) or markdown_table(REFIT_HEAD, refits),
        note="Cloths are simulated, recorded with errors, and fitted. *Same* truths have the steps and the mesh of the "
        "fits, *refined* ones four times the steps and other noise, *finer* ones also half the edge length."
        + f" If each interval contained the true value with a probability of exactly {level}, 99 of 100 rows would be in "
        "the "
        f"band: {least:.0f} to {most:.0f} of {usual} recordings." * bool(together),
        command="make coverage-own",
        details={name: blocks for name, blocks in details.items() if blocks[-1]},
    )


def _share(part: int, whole: int) -> str:
    return f"{part} ({100 * part / whole:.0f} %)"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
