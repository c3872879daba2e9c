"""Scenarios whose grasp has another size, and what that changes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from diffcloud.errors import SceneError
from diffcloud.estimation.objective import Objective
from diffcloud.scene.scenarios import Scenario


def regripped(scenario: Scenario) -> list[Scenario]:
    """With a smaller grasp and, where its pad fits and holds the same nodes, a larger one; none where its size is known, or
    no smaller pad fits on the mesh."""
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
    """What a smaller grasp changes, and maybe a larger one, in powers of its size."""
    known = [one for one in grips if one is not None]
    if not grips or len(known) < len(grips):
        return None
    if len(known) == 1:
        return -known[0], torch.zeros_like(known[0])
    smaller, larger = known
    return (larger - smaller) / 2, (larger + smaller) / 2


def gripped(members: Sequence[Objective], grip: float) -> Sequence[Objective]:
    """With a grasp so many deviations larger than stated, where its size is not known."""
    return [one.of(one.scenario.regrip(grip)) if grip and one.scenario.regrip else one for one in members]


def that_fits(members: Sequence[Objective], grip: float) -> float:
    """So much of a change of the grasp that its pad fits on the cloth and on the mesh."""
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
    """With the grasp as its scenario has it."""
    return objective.of(replace(objective.scenario, regrip=None))
