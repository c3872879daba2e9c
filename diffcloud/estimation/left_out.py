"""What the other recordings of a joint fit say of one: whether parameters carry over.

A fit of the others begins where the joint one ended.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import torch

from diffcloud.estimation.initial_state import is_initial_state
from diffcloud.estimation.joint import AnyObjective, JointObjective
from diffcloud.estimation.names import of_recording, plain_name, without_recording
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import LeftOut
from diffcloud.estimation.solvers import LikelihoodSettings, Progress, solve
from diffcloud.sim.properties import one_set

Tell = Callable[[float, str, Progress], None]
"""What a progress display gets: the part of the recordings that have been left out, what is done now, and the progress of
the current fit."""


def leave_each_out(
    objective: JointObjective,
    space: FitSpace,
    values: Mapping[str, float],
    settings: LikelihoodSettings = LikelihoodSettings(),
    *,
    progress: Tell | None = None,
) -> list[LeftOut]:
    """For each recording: a fit to all others, from the joint optimum on, measured on it with its own pose, and with how
    the cloth lay in it, which is fitted to it alone.

    Args:
        values: fitted to all, named as `estimation.names` says.
        settings: of the joint fit.

    Raises:
        DivergedError: a motion diverges.
        KeyboardInterrupt: Ctrl-C.
    """
    objective.reseed(settings.seed)  # a solver may have drawn other points
    told, count = [], len(objective.members)
    for index, member in enumerate(objective.members):
        shown = None if progress is None else partial(progress, index / count, f"leaving out {index + 1} of {count}")
        others = JointObjective([*objective.members[:index], *objective.members[index + 1 :]])
        found = _from(others, space.without_recording(index), without_recording(values, index), settings, shown)
        alike = {name: value for name, value in found.items() if name == plain_name(name)}
        here, _ = space.of_recording(index)
        lying = FitSpace(tuple(one for one in here.variables if one.name not in alike), {**here.fixed, **alike})
        lies = _from(member, lying, of_recording(values, index), settings, shown) if lying.variables else {}
        with torch.no_grad():
            run = member.simulate_to_loss(one_set({**lying.fixed, **lies}))
            motion = member.match(run)
            loss = float(member.losses(motion).mean())  # without the prior of the pose, as the joint fit's is told
            rms_mm = 1e3 * member.scenario.length_unit_m * float(member.squares(motion).mean()) ** 0.5
        parameters = {name: value for name, value in lying.fixed.items() if not is_initial_state(name)}
        told.append(LeftOut(loss=loss, rms_mm=rms_mm, parameters=parameters))
    return told


def _from(
    objective: AnyObjective,
    space: FitSpace,
    values: Mapping[str, float],
    settings: LikelihoodSettings,
    progress: Callable[[Progress], None] | None,
) -> dict[str, float]:
    """The fitted values at the end of a descent from these."""
    further = replace(settings, starts=1, init=values)
    return solve(objective, space, further, progress=progress).uninterrupted().values
