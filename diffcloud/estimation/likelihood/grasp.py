"""Scenarios with another grasp size, and their effect on the motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from diffcloud.errors import SceneError
from diffcloud.estimation.objective import Objective
from diffcloud.scene.scenarios import Scenario


def regripped(scenario: Scenario) -> list[Scenario]:
    """Return variants of a scenario with a grasp one standard deviation smaller and, if possible, one larger. The
    larger grasp is omitted unless its pad fits on the cloth and holds the same nodes. The list is empty if the grasp
    size is known, or if the smaller pad does not fit on the mesh."""
    if scenario.regrip is None:
        return []
    found = list[Scenario]()
    try:
        found.append(scenario.regrip(-1.0))
        larger = scenario.regrip(1.0)
    except SceneError:
        return found
    return [*found, larger] if larger.scene.handles.nodes == scenario.scene.handles.nodes else found


def in_powers(grips: Sequence[Tensor | None]) -> tuple[Tensor, Tensor] | None:
    """Return (linear, quadratic) coefficients of the node displacements as a function of grasp size; None if unknown.

    Args:
        grips: node displacements for a grasp one standard deviation smaller and, if available, one larger. None:
            diverged.
    """
    known = [one for one in grips if one is not None]
    if not grips or len(known) < len(grips):
        return None
    if len(known) == 1:
        return -known[0], torch.zeros_like(known[0])
    smaller, larger = known
    return (larger - smaller) / 2, (larger + smaller) / 2


def gripped(members: Sequence[Objective], grip: float) -> Sequence[Objective]:
    """Return the objectives with a grasp `grip` standard deviations larger than stated, unless its size is known."""
    return [one.of(one.scenario.regrip(grip)) if grip and one.scenario.regrip else one for one in members]


def that_fits(members: Sequence[Objective], grip: float) -> float:
    """Return a change in grasp size [standard deviations], reduced until the gripper pad fits on the cloth and the mesh.
    The whole change is tried, then 3/4, 1/2 and 1/4 of it. If none fits, the result is 0."""
    for part in (1.0, 0.75, 0.5, 0.25):
        try:
            for one in members:
                if one.scenario.regrip is not None:
                    one.scenario.regrip(part * grip)
        except SceneError:
            continue
        return part * grip
    return 0.0


def known(objective: Objective) -> Objective:
    """Return the objective with the size of its grasp fixed at that of its scenario."""
    return objective.of(replace(objective.scenario, regrip=None))
