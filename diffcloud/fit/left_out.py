"""What the other recordings of a joint fit say of one: whether parameters carry over.

A fit of the others begins where the joint one ended. With what it found, and with how the cloth lay in the recording that
was left out, the loss of all may be lower than where the joint fit ended. Then the joint fit has missed a lower minimum, or
stopped too early, and continues from those values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import torch

from diffcloud.fit.batches import batch_losses
from diffcloud.fit.joint import AnyObjective, JointObjective
from diffcloud.fit.laid import is_laid
from diffcloud.fit.names import of_recording, plain_name, with_recording, without_recording
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.record import LeftOut
from diffcloud.fit.scan import LOWER
from diffcloud.fit.solvers import (
    FitOutcome,
    GaussNewtonSettings,
    LikelihoodSettings,
    Progress,
    Settings,
    fit_gauss_newton,
    solve,
)
from diffcloud.sim.properties import one_set

_STEPS = 10
_TIMES = 2
"""How often a joint fit may go on."""
Tell = Callable[[float, str, Progress], None]
"""What a progress display gets: the part of the recordings that have been left out, what is done now, and the progress of
the current fit."""


def leave_out_and_go_on(
    objective: JointObjective,
    space: FitSpace,
    outcome: FitOutcome,
    settings: Settings,
    *,
    keep: Callable[[FitOutcome], None],
    progress: Tell | None = None,
) -> list[LeftOut]:
    """Leave each recording out in turn. If that shows a lower minimum, a fit by Gauss–Newton continues from there, and the
    recordings are left out again.

    Args:
        outcome: of the joint fit.
        settings: that it was made with.
        keep: takes the joint fit whenever it has gone on.

    Raises:
        DivergedError, KeyboardInterrupt: as `leave_each_out`.
    """
    objective.reseed(settings.seed)
    left = _TIMES
    while True:
        told, lower = leave_each_out(objective, space, outcome.values, settings, progress=progress)
        if lower is None or not left or not isinstance(settings, GaussNewtonSettings):
            return told
        left -= 1
        further = replace(settings, starts=1, screen=0, init=lower)
        shown = None if progress is None else partial(progress, 0.0, "going on from a lower loss")
        outcome = outcome.gone_on(fit_gauss_newton(objective, space, further, progress=shown))
        keep(outcome)
        outcome.uninterrupted()


def leave_each_out(
    objective: JointObjective,
    space: FitSpace,
    values: Mapping[str, float],
    settings: Settings = GaussNewtonSettings(),
    *,
    progress: Tell | None = None,
) -> tuple[list[LeftOut], dict[str, float] | None]:
    """For each recording: a fit to all others, from the joint optimum on, measured on it with its own pose, and with how
    the cloth lay in it, which is fitted to it alone.

    Args:
        values: fitted to all, named as `fit.names` says.
        settings: of the joint fit; a descent by Gauss–Newton, but where it was by `likelihood`.

    Returns:
        What came of each; and, if the values of one of these fits give a clearly lower joint loss, these values.

    Raises:
        DivergedError: a motion diverges.
        KeyboardInterrupt: Ctrl-C.
    """
    told, places, count = [], [dict(values)], len(objective.members)
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
        parameters = {name: value for name, value in lying.fixed.items() if not is_laid(name)}
        told.append(LeftOut(loss=loss, rms_mm=rms_mm, parameters=parameters))
        places.append(with_recording(found, lies, index))
    rows = torch.tensor([[place[name] for name in space.names] for place in places], dtype=torch.float64)
    losses = batch_losses(objective, space, rows)
    return told, places[int(losses.argmin())] if float(losses.min()) < (1 - LOWER) * float(losses[0]) else None


def _from(
    objective: AnyObjective,
    space: FitSpace,
    values: Mapping[str, float],
    settings: Settings,
    progress: Callable[[Progress], None] | None,
) -> dict[str, float]:
    """The fitted values at the end of a descent from these."""
    further: Settings = GaussNewtonSettings(iterations=_STEPS, starts=1, screen=0, scans=0, init=values)
    if isinstance(settings, LikelihoodSettings):
        further = replace(settings, starts=1, init=values)
    return solve(objective, space, further, progress=progress).uninterrupted().values
