"""What the other recordings of a joint fit say of one: whether parameters carry over."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch

from diffcloud.fit.joint import JointObjective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.record import LeftOut
from diffcloud.fit.solvers import GaussNewtonSettings, Progress, fit_gauss_newton
from diffcloud.sim.properties import one_set

_STEPS = 10


def leave_each_out(
    objective: JointObjective,
    space: FitSpace,
    values: Mapping[str, float],
    *,
    progress: Callable[[Progress], None] | None = None,
) -> list[LeftOut]:
    """For each recording: a fit to all others, from the joint optimum on, measured on it with its own pose.

    Args:
        values: fitted to all.

    Raises:
        DivergedError: a motion diverges.
        KeyboardInterrupt: Ctrl-C.
    """
    told = []
    settings = GaussNewtonSettings(iterations=_STEPS, starts=1, screen=0, scans=0, init=values)
    for index, member in enumerate(objective.members):
        others = JointObjective([*objective.members[:index], *objective.members[index + 1 :]])
        found = fit_gauss_newton(others, space, settings, progress=progress)
        if found.stop_reason == "interrupted":
            raise KeyboardInterrupt
        parameters = found.values | dict(space.fixed)
        with torch.no_grad():
            loss = float(member(one_set(parameters)))
        told.append(LeftOut(loss=loss, rms_mm=1e3 * member.scenario.length_unit_m * loss**0.5, parameters=parameters))
    return told
