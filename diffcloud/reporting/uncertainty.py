"""The intervals of one fit, and where its uncertainty comes from."""

from __future__ import annotations

from diffcloud.evaluation.intervals import Intervals, significant, worded
from diffcloud.evaluation.summary import largest_sources
from diffcloud.reporting.tables import Cell, Table, table


def intervals_table(found: Intervals) -> Table:
    """A row for each parameter."""
    heads = ("parameter", "value", f"{found.level:.0%} interval", "status", "improve first")
    return table(heads, (_row(found, name) for name in found.parameters))


def _row(found: Intervals, name: str) -> list[Cell]:
    entry = found.parameters[name]
    digits = significant(entry.low, entry.high)
    return [
        Cell(name),
        Cell(f"{digits(entry.value)} {entry.unit}", sort=entry.value),
        Cell(f"{digits(entry.low)} to {digits(entry.high)}"),
        Cell(worded(entry.status)),
        Cell(largest_sources(found.sources, name)),
    ]
