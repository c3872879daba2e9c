"""The fitted parameters with their intervals, and the sources of their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from diffcloud.estimation.record import FitRecord, FittedParameter
from diffcloud.evaluation.intervals import Intervals, significant, worded
from diffcloud.reporting.tables import UNKNOWN, Cell, Table, part, table


@dataclass(frozen=True)
class NamedFit:
    """One fit as tables show it."""

    name: str
    record: FitRecord
    intervals: Intervals | None
    true: Mapping[str, float] = field(default_factory=dict)
    """Parameter -> true value as a multiplier of the nominal value, where it is known."""
    episode: int | None = None
    """Recording in the player that belongs to the fit."""


def parameters_table(fits: Sequence[NamedFit]) -> Table:
    """Return a row for each requested parameter of each fit. The first column names the fit if there are several."""
    level = next((one.intervals.level for one in fits if one.intervals is not None), None)
    interval = "interval" if level is None else f"{level:.0%} interval"
    heads = ["fit"] * (len(fits) > 1) + ["parameter", "value", interval, "searched range", "status"]
    rows = []
    for one in fits:
        names = [name for name, parameter in one.record.parameters.items() if parameter.role == "requested"]
        first = [Cell(one.name, episode=one.episode)] * (len(fits) > 1)
        rows += [[*first, Cell(name), *_cells(one, name)] for name in names]
    if len(fits) > 1:  # a wide table keeps its bars only
        rows = [[replace(cell, text="", sort=cell.bar[1]) if cell.bar else cell for cell in row] for row in rows]
    return table(heads, rows)


def _cells(one: NamedFit, name: str) -> list[Cell]:
    fitted = one.record.parameters[name]
    true = one.true.get(name)
    note = "" if true is None else f"true {true * fitted.nominal:.3g}"
    entry = None if one.intervals is None else one.intervals.parameters.get(name)
    if entry is None:
        status = "given" if fitted.fixed else "at its bound" if fitted.at_bound else "no interval"
        return [
            Cell(f"{fitted.value:.3g} {fitted.unit}", sort=fitted.value, note=note),
            UNKNOWN,
            _range(fitted, fitted.value, fitted.value, fitted.value),
            Cell(status),
        ]
    digits = significant(entry.low, entry.high)
    return [
        Cell(f"{digits(entry.value)} {entry.unit}", sort=entry.value, strong=True, note=note),
        Cell(f"{digits(entry.low)} to {digits(entry.high)}"),
        _range(fitted, entry.low, entry.value, entry.high),
        Cell(worded(entry.status)),
    ]


def _range(fitted: FittedParameter, *values: float) -> Cell:
    """Draw low, value and high within the search range, on a logarithmic axis if the range does not start at zero."""
    if fitted.bounds is None or fitted.fixed:
        return UNKNOWN
    low, high = fitted.bounds
    scale = math.log if low > 0 else float
    first, last = scale(low), scale(high)
    places = [100 * (scale(min(max(value, low), high)) - first) / (last - first) for value in values]
    shown = significant(None, None)
    return Cell(f"{shown(low)} to {shown(high)}", bar=(places[0], places[1], places[2]))


def sources_table(fits: Sequence[NamedFit]) -> Table:
    """Return the part of each source in the variance of each parameter, the largest first."""
    rows = []
    for one in fits:
        sources = {} if one.intervals is None else one.intervals.sources
        for name in one.intervals.parameters if one.intervals is not None else ():
            total = math.hypot(*(deviations[name] for deviations in sources.values())) or 1.0
            shares = sorted(((deviations[name] / total) ** 2, source) for source, deviations in sources.items())
            rows += [
                [Cell(one.name), Cell(name), Cell(source.replace("_", " ")), part(share)]
                for share, source in reversed(shares)
                if share > 0.01
            ]
    return table(("fit", "parameter", "source", "part of the variance"), rows)
