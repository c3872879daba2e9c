"""Leave-one-out test of a joint fit: do parameters transfer to the recording that was left out? Each fit to the
remaining recordings starts at the joint optimum."""

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
from diffcloud.sim.threads import map_threads

Tell = Callable[[float, str, Progress], None]
"""Progress callback of (fraction of recordings done, label, progress of the current fit)."""


def leave_each_out(
    objective: JointObjective,
    space: FitSpace,
    values: Mapping[str, float],
    settings: LikelihoodSettings = LikelihoodSettings(),
    *,
    progress: Tell | None = None,
) -> list[LeftOut]:
    """Fit all recordings but one, from the joint optimum, and evaluate the parameters on that one; repeat for each.

    Pose and initial state of the left-out recording are fitted to it alone.

    Args:
        values: jointly fitted values, named as `estimation.names` explains.
        settings: settings of the joint fit.

    Raises:
        DivergedError: a motion diverges.
        KeyboardInterrupt: Ctrl-C.
    """
    objective.reseed(settings.seed)  # a solver may have resampled the points
    count = len(objective.members)

    def leave_out(index: int) -> LeftOut:
        member = objective.members[index]
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
            loss = float(member.losses(motion).mean())  # without the pose prior, like the reported loss of the joint fit
            rms_mm = 1e3 * member.scenario.length_unit_m * float(member.squares(motion).mean()) ** 0.5
        parameters = {name: value for name, value in lying.fixed.items() if not is_initial_state(name)}
        return LeftOut(loss=loss, rms_mm=rms_mm, parameters=parameters)

    return map_threads(leave_out, range(count))


def _from(
    objective: AnyObjective,
    space: FitSpace,
    values: Mapping[str, float],
    settings: LikelihoodSettings,
    progress: Callable[[Progress], None] | None,
) -> dict[str, float]:
    """Return the fitted values of a single descent from the given values."""
    further = replace(settings, starts=1, init=values)
    return solve(objective, space, further, progress=progress).uninterrupted().values
