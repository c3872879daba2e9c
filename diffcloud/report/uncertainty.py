"""The intervals of one fit, and where its uncertainty comes from."""

from __future__ import annotations

from diffcloud.evaluation.intervals import Intervals, significant
from diffcloud.evaluation.summary import largest_sources
from diffcloud.report.tables import Cell, Table, table


def intervals_table(found: Intervals) -> Table:
    """A row for each parameter."""
    heads = ("parameter", "value", f"{found.level:.0%} interval", "SI", "verdict", "improve first")
    return table(heads, (_row(found, name) for name in found.parameters))


def _row(found: Intervals, name: str) -> list[Cell]:
    entry = found.parameters[name]
    digits = significant(entry.low, entry.high)
    return [
        Cell(name),
        Cell(digits(entry.value), sort=entry.value),
        Cell(f"{digits(entry.low)} to {digits(entry.high)}"),
        Cell(
            f"{digits(entry.physical)} {entry.physical_unit}",
            sort=entry.physical,
            note=f"{digits(entry.physical_low)} to {digits(entry.physical_high)}",
        ),
        Cell(entry.verdict),
        Cell(largest_sources(found.sources, name)),
    ]
