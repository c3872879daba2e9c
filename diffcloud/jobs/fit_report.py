"""What a person reads of a fit: its findings in sentences, its result as JSON, and its page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffcloud
from diffcloud.estimation.joint import AnyObjective, JointObjective
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.result import physical_values, read_motion
from diffcloud.evaluation.intervals import FOLLOWS, Intervals, significant
from diffcloud.evaluation.methods import space_of
from diffcloud.evaluation.summary import largest_sources
from diffcloud.io.episodes import Episode
from diffcloud.report import EpisodeEntry, build_page
from diffcloud.sim.properties import one_set

_TRANSFERS, _GAIN = 1.25, 0.5
_NO_TIME = "there was no time for it"


class Status(StrEnum):
    """How a fit ended."""

    finished = "finished"
    interrupted = "interrupted"
    budget_reached = "budget reached"


@dataclass(frozen=True)
class Told:
    """A fit that ended, and what it minimised."""

    record: FitRecord
    objective: AnyObjective
    intervals: Intervals | None
    """None: the solver knows none, or there was no time."""
    status: Status


def _validation(record: FitRecord, objective: AnyObjective) -> str:
    """Whether parameters fitted without a given recording still explain it."""
    if not isinstance(objective, JointObjective):
        return "One recording: whether its parameters carry over to another is not known."
    if record.estimate is None:
        return "Only the solver likelihood predicts each recording from the others."
    held, gains = [], []
    weighed = space_of(record).fixed
    for member, episode in zip(objective.members, record.episodes, strict=True):
        if episode.left_out is None and record.stop_reason == "interrupted":
            return f"Whether parameters carry over from one recording to another is not known: {_NO_TIME}."
        if episode.left_out is None:
            return "Leaving one recording out failed: whether parameters carry over is not known."
        with torch.no_grad():
            run = member.simulate_to_loss(one_set({**weighed, **record.initial_state_in(episode)}))
            middle = float(member.frame_losses(run).mean())  # as the others, without the prior of the pose
        held.append(episode.left_out.rms_mm / episode.rms_mm)
        gains.append((middle - episode.left_out.loss) / max(middle - episode.loss, 1e-300))
    told = f"when a recording is left out of the fit, its misfit is at most {max(held):.2f} times that in the joint fit"
    motions = len({_motion_of(member) for member in objective.members})
    if max(held) <= _TRANSFERS and min(gains) >= _GAIN:
        return f"Transfers{'' if motions > 1 else ' within this motion'}: {told}."
    return f"Explains its own recordings only: {told}."


def _motion_of(objective: Objective) -> str:
    """What a motion is told by: its last displacement, in whole parts of the largest component."""
    track = objective.track
    if track is None:
        return "scene"
    end = track[0, -1].flatten().numpy()
    return str(np.round(end / max(float(np.abs(end).max()), 1e-9), 0).tolist())


def follows(record: FitRecord) -> list[str]:
    """Of each recording, until when the model follows it, for people."""
    lines = []
    for one, told in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False):
        gone = np.flatnonzero(np.array(told.misfits) > FOLLOWS)
        rate = told.horizon_s / max(one.frames[-1], 1)
        if len(gone) == 0:
            told_so = f"follows {one.name} to within noise and mesh up to {told.horizon_s:.1f} s, where frames end to count"
        elif gone[0] == 0:
            told_so = f"does not follow {one.name} from the first frame on"
        else:
            told_so = f"follows {one.name} to within noise and mesh until {rate * one.frames[gone[0]]:.1f} s, then departs"
        lines.append(f"The model {told_so}.")
    return lines


def findings_of(told: Told) -> list[str]:
    """The report's first lines: does the model explain the recordings, do parameters carry over, what are they."""
    record, found, lines = told.record, told.intervals, list[str]()
    if told.status != Status.finished:
        why, again = (
            ("Ctrl-C was pressed", "")
            if told.status == Status.interrupted
            else ("the time of --budget was over", " with --budget none")
        )
        lines.append(f"Unfinished: {why}. These are the best parameters so far. Run the same command{again} to finish.")
    if found is None:
        known = record.estimate is not None or told.status != Status.finished
        why = _NO_TIME if known else f"the solver {record.solver} knows no uncertainty"
        lines.append(f"The residual is {record.rms_mm:.1f} mm RMS. There are no intervals: {why}.")
    elif not found.explains:
        lines.append(f"The model does not explain the recordings: {found.reason}.")
    lines += follows(record)
    lines.append(_validation(record, told.objective))
    if found is not None and found.explains:
        lines += found.sentences
    for name, entry in _parameters(told).items():
        digits = significant(entry["low"], entry["high"])
        ends, verdict, improve = "", "unfinished", ""
        if found is not None:
            interval, verdict = found.parameters[name], entry["verdict"]
            first = largest_sources(found.sources, name, 2)
            ends = f", {found.level:.0%} interval {digits(interval.physical_low)} to {digits(interval.physical_high)}"
            improve = f" (improve first: {first})" if first else ""
        lines.append(f"{name}: {digits(entry['physical'])} {entry['physical_unit']}{ends}: {verdict}{improve}.")
    if record.estimate is not None and record.estimate.grip_m is not None:
        lines.append(f"The grasp is {1e3 * record.estimate.grip_m:.0f} mm wide, as the fit found it.")
    return lines


def _parameters(told: Told) -> dict[str, dict[str, Any]]:
    """Of each parameter its value and, if there are intervals, these."""
    record = told.record
    if told.intervals is not None:
        return {
            name: {
                "value": entry.value,
                "physical": entry.physical,
                "physical_unit": entry.physical_unit,
                "low": entry.physical_low,
                "high": entry.physical_high,
                "verdict": entry.verdict,
            }
            for name, entry in told.intervals.parameters.items()
        }
    values = {name: record.free[name] for name in space_of(record).asked.names}
    nothing = {"low": None, "high": None, "verdict": None}
    return {
        name: {
            "value": one.value,
            "physical": one.physical,
            "physical_unit": one.physical_unit,
            **nothing,
        }
        for name, one in physical_values(told.objective.members[0].scenario, values).items()
    }


def result_of(told: Told, findings: Sequence[str]) -> dict[str, Any]:
    """For programs."""
    record, found = told.record, told.intervals
    return {
        "status": told.status.value,
        "solver": record.solver,
        "stop_reason": record.stop_reason,
        "parameters": _parameters(told),
        "rms_mm": record.rms_mm,
        "explains": None if found is None else found.explains,
        "reason": "" if found is None else found.reason,
        "remark": "" if found is None else found.remark,
        "horizons_s": {
            one.name: frames.horizon_s
            for one, frames in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False)
        },
        "findings": list(findings),
        "episodes": {one.name: one.rms_mm for one in record.episodes},
    }


def page_of(told: Told, findings: Sequence[str], episodes: Mapping[str, Episode], motions: Path) -> str:
    """
    Args:
        episodes: recording -> episode.
        motions: of the fit, NPZ.
    """
    record, entries = told.record, list[EpisodeEntry]()
    for index, recording in enumerate(record.episodes):
        row = {
            "rms_start_mm": 1e3 * record.length_unit_m * record.loss_start**0.5,
            "rms_mm": recording.rms_mm,
            "rms_other_frames_mm": math.nan,
        }
        entries.append(
            EpisodeEntry(
                scenario=recording.scenario,
                name=recording.name,
                row=row,
                fit=_with_one(record, index),
                recording=recording,
                episode=episodes[recording.name],
                motion=read_motion(motions, index),
            )
        )
    return build_page(
        entries,
        title="A cloth from its recordings",
        overlay_points=1200,
        environment={"command": "diffcloud fit", "diffcloud": diffcloud.__version__},
        findings=findings,
        intervals=told.intervals,
    )


def _with_one(record: FitRecord, index: int) -> FitRecord:
    """The record with one of its recordings alone, as a page's row shows it."""
    return record.model_copy(update={"episodes": [record.episodes[index]]})
