"""How each recording lies, and what of it a fit compares."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from diffcloud.report.tables import UNKNOWN, Cell, Table, number, table

_SHOWN = {"m": (1e3, "mm", 1), "rad": (180 / math.pi, "°", 1), "s": (1e3, "ms", 1)}
"""Unit -> factor, unit shown, digits."""
_WIDE = 2.0
"""A value so many of its prior's deviations off zero is pointed out."""


def poses_table(fits: Sequence[tuple[str, Mapping[str, Any]]]) -> Table:
    """A row for each recording of each fit.

    Args:
        fits: name shown, and summary as `fit.result.read_fit` has it.
    """
    rows = [(name, recorded, recording) for name, fit in fits for recorded, recording in fit["recordings"].items()]
    variables = list(dict.fromkeys(key for _, _, recording in rows for key in recording["nuisance"]))
    units = {key: one["nuisance"][key]["unit"] for _, _, one in rows for key in one["nuisance"]}
    heads = [
        "fit",
        "recording",
        "RMS mm",
        "cloth to cloud mm",
        "cloud to cloth mm",
        "frames",
        "points that count",
        "cut mm",
    ]
    heads += [f"{key} {_SHOWN[units[key]][1]}" for key in variables]
    return table(heads, (_row(name, recorded, recording, variables) for name, recorded, recording in rows))


def _row(name: str, recorded: str, recording: Mapping[str, Any], variables: Sequence[str]) -> list[Cell]:
    frames = recording["frames"]
    worst = int(np.argmax(recording["frame_rms_mm"]))
    return [
        Cell(name),
        Cell(recorded),
        number(recording["rms_mm"], 1, note=f"{recording['frame_rms_mm'][worst]:.1f} in frame {frames[worst]}"),
        number(recording.get("rms_to_recording_mm"), 1),
        number(recording.get("rms_to_cloth_mm"), 1),
        Cell(f"{len(frames)}", sort=len(frames), note=f"{frames[0]} to {frames[-1]}"),
        number(float(np.mean(recording["counted"])), 0, factor=100, unit=" %"),
        number(recording["cut_m"], 0, factor=1e3),
        *(_pose_cell(recording["nuisance"].get(key)) for key in variables),
    ]


def _pose_cell(entry: Mapping[str, Any] | None) -> Cell:
    if entry is None:
        return UNKNOWN
    factor, _, digits = _SHOWN[entry["unit"]]
    far = abs(entry["value"]) > _WIDE * entry["prior"]
    return number(entry["value"], digits, factor=factor, note="beyond its prior" if far else "")
