"""Timing one episode, forward and with gradient, over batch sizes and mesh sizes."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch

from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import rollout


@dataclass(frozen=True)
class Timing:
    """Seconds of one whole batch, the smallest of several repeats."""

    nodes: int
    steps: int
    batch: int
    forward: float
    forward_backward: float


def time_episode(scenario: Scenario, *, batch: int, repeats: int = 3, device: str = "cpu") -> Timing:
    """Time rollouts of a scenario with gradients of stretch and mass.

    The loss is the mean square of the last positions: the cost of the simulation alone.
    """
    system, _ = scenario.scene.build(device=device)

    def once(backward: bool) -> float:
        values = {
            name: torch.linspace(0.5, 2.0, batch, dtype=system.dtype, device=device).requires_grad_(backward)
            for name in ("stretch", "mass")
        }
        begin = time.perf_counter()
        with torch.set_grad_enabled(backward):
            run = rollout(system, scenario.steps, properties=scenario.properties(system, values))
            loss = run.positions[:, -1].square().mean()
        if backward:
            loss.backward()
        float(loss.detach())  # waits for a GPU
        return time.perf_counter() - begin

    once(True)
    return Timing(
        nodes=len(system.mesh.nodes),
        steps=scenario.steps,
        batch=batch,
        forward=min(once(False) for _ in range(repeats)),
        forward_backward=min(once(True) for _ in range(repeats)),
    )
