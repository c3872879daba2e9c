"""What a person reads of a fit: its findings in sentences, its result as JSON, and its page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import torch

import diffcloud
from diffcloud.estimation.joint import AnyObjective, JointObjective
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.result import FittedMotion
from diffcloud.evaluation.intervals import FOLLOWS, Intervals, significant, stated_parameters, worded
from diffcloud.evaluation.methods import space_of
from diffcloud.evaluation.summary import largest_sources
from diffcloud.io.episodes import Episode
from diffcloud.reporting.page import EpisodeEntry, build_page
from diffcloud.sim.properties import one_set

_TRANSFERS, _GAIN = 1.25, 0.5
_NO_TIME = "the time was over before they were computed"


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
    """Whether parameters that were fitted without a recording predict it."""
    if not isinstance(objective, JointObjective):
        return "Not tested: whether the parameters predict another recording. Fit two recordings to see."
    if record.estimate is None:
        return "Not tested: whether the parameters predict another recording. The solver likelihood tests it."
    held, gains = [], []
    weighed = space_of(record).fixed
    for member, episode in zip(objective.members, record.episodes, strict=True):
        if episode.left_out is None and record.stop_reason == "interrupted":
            return "Not tested: whether the parameters predict another recording. The fit ended before."
        if episode.left_out is None:
            return "Not tested: whether the parameters predict another recording. Leaving a recording out failed."
        with torch.no_grad():
            run = member.simulate_to_loss(one_set({**weighed, **record.initial_state_in(episode)}))
            middle = float(member.frame_losses(run).mean())  # as the others, without the prior of the pose
        held.append(episode.left_out.rms_mm / episode.rms_mm)
        gains.append((middle - episode.left_out.loss) / max(middle - episode.loss, 1e-300))
    told = f"left out of the fit, a recording has at most {max(held):.2f} times its residual in the joint fit"
    motions = len({_motion_of(member) for member in objective.members})
    if max(held) <= _TRANSFERS and min(gains) >= _GAIN:
        return f"The parameters predict other recordings{'' if motions > 1 else ' of this motion'}: {told}."
    return f"The parameters do not predict other recordings: {told}."


def _motion_of(objective: Objective) -> str:
    """What a motion is told by: its last displacement, in whole parts of the largest component."""
    track = objective.track
    if track is None:
        return "scene"
    end = track[0, -1].flatten().numpy()
    return str(np.round(end / max(float(np.abs(end).max()), 1e-9), 0).tolist())


def follows(record: FitRecord) -> list[str]:
    """Return one sentence for each recording: until when the simulation follows it."""
    lines = []
    for one, told in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False):
        gone = np.flatnonzero(np.array(told.chi_squares) > FOLLOWS)
        rate = told.horizon_s / max(one.frames[-1], 1)
        if len(gone) == 0:
            told_so = f"follows {one.name} to within noise and mesh error up to the horizon, {told.horizon_s:.1f} s"
        elif gone[0] == 0:
            told_so = f"does not follow {one.name} from the first frame on"
        else:
            told_so = f"follows {one.name} to within noise and mesh error until {rate * one.frames[gone[0]]:.1f} s only"
        lines.append(f"The simulation {told_so}.")
    return lines


def findings_of(told: Told) -> list[str]:
    """Return the report's first lines: fit to the recordings, prediction of others, parameters."""
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
        why = _NO_TIME if known else f"the solver {record.solver} gives none"
        lines.append(f"The residual is {record.rms_mm:.1f} mm RMS. There are no intervals: {why}.")
    elif not found.fits_to_noise:
        lines.append(f"The simulation does not fit the recordings to within the noise: {found.reason}.")
    lines += follows(record)
    lines.append(_validation(record, told.objective))
    if found is not None and found.fits_to_noise:
        lines += found.sentences
    for name, entry in _parameters(told).items():
        digits = significant(entry["low"], entry["high"])
        ends, status, improve = "", "unfinished", ""
        if found is not None:
            interval, status = found.parameters[name], entry["status"]
            first = largest_sources(found.sources, name, 2)
            ends = f", {found.level:.0%} interval {digits(interval.low)} to {digits(interval.high)}"
            improve = f" (improve first: {first})" if first else ""
        lines.append(f"{name}: {digits(entry['value'])} {entry['unit']}{ends}: {worded(status)}{improve}.")
    if record.estimate is not None and record.estimate.grip_m is not None:
        lines.append(f"The grasp is {1e3 * record.estimate.grip_m:.0f} mm wide, as the fit found it.")
    return lines


def _parameters(told: Told) -> dict[str, dict[str, Any]]:
    return stated_parameters(told.record, told.intervals, told.objective.members[0].scenario)


def result_of(told: Told, findings: Sequence[str]) -> dict[str, Any]:
    """For programs."""
    record, found = told.record, told.intervals
    return {
        "status": told.status.value,
        "solver": record.solver,
        "stop_reason": record.stop_reason,
        "parameters": _parameters(told),
        "rms_mm": record.rms_mm,
        "fits_to_noise": None if found is None else found.fits_to_noise,
        "reason": "" if found is None else found.reason,
        "warning": "" if found is None else found.warning,
        "horizons_s": {
            one.name: frames.horizon_s
            for one, frames in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False)
        },
        "findings": list(findings),
        "episodes": {one.name: one.rms_mm for one in record.episodes},
    }


def page_of(told: Told, findings: Sequence[str], episodes: Mapping[str, Episode], motions: Sequence[FittedMotion]) -> str:
    """
    Args:
        episodes: recording -> episode.
        motions: of the fit, one for each recording.
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
                motion=motions[index],
            )
        )
    return build_page(
        entries,
        title="A cloth from its recordings",
        cloud_points=1200,
        environment={"command": "diffcloud fit", "diffcloud": diffcloud.__version__},
        findings=findings,
        intervals=told.intervals,
    )


def _with_one(record: FitRecord, index: int) -> FitRecord:
    """The record with one of its recordings alone, as a page's row shows it."""
    return record.model_copy(update={"episodes": [record.episodes[index]]})
