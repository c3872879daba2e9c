"""How each recording lies, and what of it a fit compares."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from diffcloud.estimation.initial_state import asked_as
from diffcloud.estimation.record import FitRecord, RecordingFit
from diffcloud.reporting.tables import UNKNOWN, Cell, Table, number, part, table

_SHOWN = {"m": (1e3, "mm", 1), "rad": (180 / math.pi, "°", 1), "s": (1e3, "ms", 1), "1": (1e2, "%", 1)}
"""Unit -> factor, unit shown, digits."""
_WIDE = 2.0
"""A value so many of its prior's deviations off the centre of that is pointed out."""


def poses_table(fits: Sequence[tuple[str, FitRecord]]) -> Table:
    """A row for each recording of each fit.

    Args:
        fits: name shown, and record.
    """
    rows = [(name, recording) for name, fit in fits for recording in fit.episodes]
    units = {asked_as(key): entry.unit for _, recording in rows for key, entry in recording.nuisance.items()}
    variables = list(units)
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
    joint = any(recording.left_out is not None for _, recording in rows)
    heads += ["RMS mm by the others"] * joint
    return table(heads, ([*_row(name, one, variables), *[_left_out_cell(one)] * joint] for name, one in rows))


def _row(name: str, recording: RecordingFit, variables: Sequence[str]) -> list[Cell]:
    frames = recording.frames
    worst = int(np.argmax(recording.frame_rms_mm))
    return [
        Cell(name),
        Cell(recording.name),
        number(recording.rms_mm, 1, note=f"{recording.frame_rms_mm[worst]:.1f} in frame {frames[worst]}"),
        number(recording.rms_to_recording_mm, 1),
        number(recording.rms_to_cloth_mm, 1),
        Cell(f"{len(frames)}", sort=len(frames), note=f"{frames[0]} to {frames[-1]}"),
        part(float(np.mean(recording.counted))),
        number(recording.cut_m, 0, factor=1e3),
        *(_pose_cell(recording, [own for own in recording.nuisance if asked_as(own) == key]) for key in variables),
    ]


def _left_out_cell(recording: RecordingFit) -> Cell:
    """With the parameters that the other recordings of a joint fit give."""
    return UNKNOWN if recording.left_out is None else number(recording.left_out.rms_mm, 1)


def _pose_cell(recording: RecordingFit, names: Sequence[str]) -> Cell:
    """Of one variable, or the RMS of several that were asked for as one."""
    entries = [recording.nuisance[name] for name in names]
    if not entries:
        return UNKNOWN
    factor, _, digits = _SHOWN[entries[0].unit]
    off = [entry.value - recording.clocks.get(name, 0.0) for name, entry in zip(names, entries, strict=True)]
    far = any(abs(one) > _WIDE * entry.prior for one, entry in zip(off, entries, strict=True))
    value = entries[0].value if len(entries) == 1 else math.hypot(*(entry.value for entry in entries)) / len(entries) ** 0.5
    return number(value, digits, factor=factor, note="beyond its prior" if far else "")
