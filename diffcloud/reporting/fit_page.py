"""What a person reads of a fit: its summary, its result as JSON, and its page."""

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
from diffcloud.estimation.likelihood import FOLLOWS
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.result import FittedMotion
from diffcloud.evaluation.intervals import Intervals, stated_parameters
from diffcloud.evaluation.methods import space_of
from diffcloud.evaluation.summary import largest_sources
from diffcloud.io.episodes import Episode
from diffcloud.reporting.page import EpisodeEntry, Summary, build_page
from diffcloud.reporting.uncertainty import NamedFit, parameters_table
from diffcloud.sim.properties import one_set

_TRANSFERS, _GAIN = 1.25, 0.5
_NO_TIME = "the time was over before they were computed"
_MOTION = "compare motions with diffcloud simulate --sensitivity, and record one that this parameter moves more"
_ADVICE = {
    "density": "weigh the cloth and pass --density",
    "pose": "calibrate the cameras with diffcloud data calibrate",
    "grasp": "measure the grasp and state it in the scene as grip_m",
}
"""Largest source of a parameter's variance -> what reduces it. Other nuisance material can be measured. For other sources,
another motion helps."""


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


def _held_out(record: FitRecord, objective: AnyObjective) -> str:
    """Say whether parameters that were fitted without a recording predict it."""
    untested = "Not tested: whether the parameters predict another recording."
    if not isinstance(objective, JointObjective):
        return f"{untested} Fit two recordings to see."
    if record.estimate is None:
        return f"{untested} The solver likelihood tests it."
    held, gains = [], []
    weighed = space_of(record).fixed
    for member, episode in zip(objective.members, record.episodes, strict=True):
        if episode.left_out is None:
            interrupted = record.stop_reason == "interrupted"
            return f"{untested} {'The fit ended before.' if interrupted else 'Leaving a recording out failed.'}"
        with torch.no_grad():
            run = member.simulate_to_loss(one_set({**weighed, **record.initial_state_in(episode)}))
            middle = float(member.frame_losses(run).mean())  # as the others, without the prior of the pose
        held.append((episode.left_out.rms_mm / episode.rms_mm, episode))
        gains.append((middle - episode.left_out.loss) / max(middle - episode.loss, 1e-300))
    ratio, worst = max(held, key=lambda pair: pair[0])
    motions = len({_motion_of(member) for member in objective.members})
    predicted = ratio <= _TRANSFERS and min(gains) >= _GAIN
    same = " of this motion" if predicted and motions == 1 else ""
    assert worst.left_out is not None
    verb = "predict" if predicted else "do not predict"
    return (
        f"The parameters {verb} other recordings{same}: without {worst.name}, the fit predicts that recording to "
        f"{worst.left_out.rms_mm:.1f} mm. With all recordings, it reaches {worst.rms_mm:.1f} mm."
    )


def _motion_of(objective: Objective) -> str:
    """Describe a motion by its last displacement, in whole parts of the largest component."""
    track = objective.track
    if track is None:
        return "scene"
    end = track[0, -1].flatten().numpy()
    return str(np.round(end / max(float(np.abs(end).max()), 1e-9), 0).tolist())


def followed_until(record: FitRecord) -> list[str]:
    """Return sentences that state until when the simulation follows each recording."""
    lines, followed, horizons = [], [], []
    for one, told in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False):
        gone = np.flatnonzero(np.array(told.chi_squares) > FOLLOWS)
        last = int(gone[0]) - 1 if len(gone) else len(told.chi_squares) - 1
        if last < 0:
            lines.append(f"The simulation does not follow {one.name} from the first frame on.")
        elif len(gone) or told.departs:
            until = told.horizon_s * one.frames[last] / max(one.frames[-1], 1)
            lines.append(
                f"The simulation follows {one.name} to within noise and mesh error until {until:.1f} s, and then departs "
                "from it."
            )
        else:
            followed.append(one.name)
            horizons.append(told.horizon_s)
    if followed:
        names = " and ".join(followed) if len(followed) < 3 else f"{len(followed)} recordings"
        ends = sorted({f"{horizon:.1f}" for horizon in (min(horizons), max(horizons))})
        up_to = f"up to the horizon, {' to '.join(ends)} s"
        lines.insert(0, f"The simulation follows {names} to within noise and mesh error {up_to}.")
    return lines


def summary_of(told: Told) -> Summary:
    """Return status, parameters, findings and next steps of a fit."""
    record, found = told.record, told.intervals
    good: bool | None = True
    status, findings = "Fits to the noise", list[str]()
    if found is None:
        known = record.estimate is not None or told.status != Status.finished
        why = _NO_TIME if known else f"the solver {record.solver} gives none"
        status, good = "No intervals", None
        findings.append(f"There are no intervals: {why}.")
    elif not found.fits_to_noise:
        status, good = "Model error", False
        findings.append(f"The simulation does not fit the recordings to within the noise: {found.reason}.")
    else:
        if found.warning:
            status, good = "Fits to the noise, but not converged", None
        findings += found.sentences
    if told.status != Status.finished:
        status, good = f"Unfinished: {told.status.value}", False
        why = "Ctrl-C was pressed" if told.status == Status.interrupted else "the time of --budget was over"
        findings.insert(0, f"Unfinished: {why}. These are the best parameters so far.")
    findings += followed_until(record)
    if record.estimate is not None and record.estimate.grip_m is not None:
        findings.append(f"The grasp is {1e3 * record.estimate.grip_m:.0f} mm wide, as the fit found it.")
    return Summary(
        status=status,
        good=good,
        residual=f"residual {record.rms_mm:.1f} mm RMS",
        parameters=parameters_table([NamedFit("fit", record, found)]),
        findings=findings,
        held_out=_held_out(record, told.objective),
        next_steps=_next_steps(told),
    )


def _next_steps(told: Told) -> list[str]:
    """Return at most three things to do, the most useful first."""
    found, steps = told.intervals, list[str]()
    if told.status != Status.finished:
        budget = " with --budget none" if told.status == Status.budget_reached else ""
        steps.append(f"Run the same command again{budget}: it continues this fit.")
    usable = found is not None and found.fits_to_noise
    if found is not None and not usable:
        steps.append(
            "Look at the recordings and the fit with diffcloud view: does the cloth start where the clouds show it?"
        )
    if found is not None and usable:
        explained = ("identified", "mesh_dependent")  # of the latter, the findings say what to do
        statuses = {name: one.status for name, one in found.parameters.items() if one.status not in explained}
        if "density" in statuses:
            steps.append("Weigh the cloth, divide by its area and pass --density. Stretching is then known apart from it.")
        for name in statuses if "density" not in statuses else ():
            first = max(found.sources, key=lambda source: found.sources[source][name])
            known = f"measure {first} and pass --fix" if first in told.record.parameters else _MOTION
            shares = largest_sources(found.sources, name, 2)
            steps.append(f"{name.capitalize()}: {_ADVICE.get(first, known)} (its variance: {shares}).")
    if len(told.record.episodes) == 1 and len(steps) < 2:
        steps.append("Fit a second recording jointly: it tests the prediction and narrows the intervals.")
    if usable:
        steps.append("Export the cloth: diffcloud export fit.json --to mujoco --out in_mujoco --check")
    return steps[:3]


def result_of(told: Told, summary: Summary) -> dict[str, Any]:
    """Return the result for programs."""
    record, found = told.record, told.intervals
    return {
        "status": told.status.value,
        "solver": record.solver,
        "stop_reason": record.stop_reason,
        "parameters": stated_parameters(record, found, told.objective.members[0].scenario),
        "rms_mm": record.rms_mm,
        "fits_to_noise": None if found is None else found.fits_to_noise,
        "reason": "" if found is None else found.reason,
        "warning": "" if found is None else found.warning,
        "horizons_s": {
            one.name: frames.horizon_s
            for one, frames in zip(record.episodes, record.estimate.recordings if record.estimate else (), strict=False)
        },
        "findings": list(summary.findings),
        "held_out": summary.held_out,
        "next_steps": list(summary.next_steps),
        "episodes": {one.name: one.rms_mm for one in record.episodes},
    }


def page_of(told: Told, summary: Summary, episodes: Mapping[str, Episode], motions: Sequence[FittedMotion]) -> str:
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
                intervals=told.intervals,
            )
        )
    return build_page(
        entries,
        title=f"Fit of {', '.join(one.name for one in record.episodes[:3])}{', …' * (len(record.episodes) > 3)}",
        cloud_points=1200,
        environment={"command": "diffcloud fit", "diffcloud": diffcloud.__version__},
        summary=summary,
    )


def _with_one(record: FitRecord, index: int) -> FitRecord:
    """The record with one of its recordings alone, as a page's row shows it."""
    return record.model_copy(update={"episodes": [record.episodes[index]]})
