"""The page's section on raw recordings: how clouds were made of them, in figures and pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from diffcloud.evaluation.summary import percent
from diffcloud.io.episodes import Episode
from diffcloud.reporting.tables import UNKNOWN, Cell, Table, number, table

_HEADS = ("Episode", "Points per view", "Masked", "Overlap mm", "Cameras moved mm", "Arm thicker mm", "Log late ms")


class RecordedEntry(Protocol):
    """Properties of an episode that the section needs."""

    @property
    def scenario(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def episode(self) -> Episode: ...
    @property
    def pictures(self) -> Mapping[str, bytes]: ...


@dataclass(frozen=True)
class Photograph:
    """A PNG that is embedded in the page."""

    caption: str
    base64: str


def recordings_table(entries: Sequence[RecordedEntry]) -> Table:
    """Return a row for each episode that comes from a raw recording."""
    return table(_HEADS, (_row(entry) for entry in entries if _is_recorded(entry)))


def recordings_pictures(entries: Sequence[RecordedEntry]) -> list[Photograph]:
    """Return the pictures that preprocessing made of raw recordings."""
    return [
        Photograph(f"{entry.name}: {caption}", base64.b64encode(data).decode())
        for entry in entries
        if _is_recorded(entry)
        for caption, data in entry.pictures.items()
    ]


def _is_recorded(entry: RecordedEntry) -> bool:
    return "points_per_view" in entry.episode.meta.get("quality", {})


def _row(entry: RecordedEntry) -> list[Cell]:
    quality = entry.episode.meta["quality"]
    refined = quality.get("refinement", {})
    overlap = [value for value in quality["overlap_m"] if value is not None]
    moved = "; ".join(f"{name} {1e3 * shift:.1f}" for name, shift in list(refined.get("shift_m", {}).items())[1:])
    return [
        Cell(entry.name),
        Cell("; ".join(f"{name} {_range(values)}" for name, values in quality["points_per_view"].items())),
        Cell("; ".join(f"{name} {percent(_mean(values))}" for name, values in quality["masked_fraction"].items())),
        number(_mean(overlap), 1, factor=1e3),
        Cell(moved) if moved else UNKNOWN,
        number(refined.get("skin_m"), 1, factor=1e3),
        number(refined.get("clock_offset_s"), 0, factor=1e3),
    ]


def _range(values: Sequence[int]) -> str:
    return f"{min(values)} / {int(np.median(values))} / {max(values)}"


def _mean(values: Sequence[Any]) -> float:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else float("nan")
