"""Tables as the templates draw them: plain text, with numbers to sort by."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from diffcloud.evaluation.summary import percent


@dataclass(frozen=True)
class Cell:
    """One cell."""

    text: str
    sort: float | None = None
    """What the column sorts by, if that is not the text."""
    note: str = ""
    """Below, smaller."""
    strong: bool = False
    episode: int | None = None
    """Shows this recording in the player."""
    bar: tuple[float, float, float] | None = None
    """Low end, value and high end of an interval, in per cent of the searched range."""


UNKNOWN = Cell("–")


@dataclass(frozen=True)
class Table:
    """Headings, and rows of as many cells."""

    heads: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


def table(heads: Iterable[str], rows: Iterable[Iterable[Cell]]) -> Table:
    """A table of any iterables."""
    return Table(tuple(heads), tuple(tuple(row) for row in rows))


def number(value: float | None, digits: int, *, factor: float = 1.0, note: str = "") -> Cell:
    """A number times `factor`, zero without a sign; a dash where there is none."""
    if value is None or value != value:
        return UNKNOWN
    return Cell(f"{factor * value:z.{digits}f}", sort=value, note=note)


def part(share: float | None, *, note: str = "") -> Cell:
    """Return a share as a percentage, or a dash if it is not known."""
    return UNKNOWN if share is None or share != share else Cell(percent(share), sort=share, note=note)
