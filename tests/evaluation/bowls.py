"""Objectives whose answers are known: no simulation, formulas instead."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import torch

from diffcloud.clouds import NeighbourIndex
from diffcloud.errors import DivergedError
from diffcloud.fit import FitSpace

SPACE = FitSpace.build(["stretch", "mass"])


@dataclass
class Bowl:
    """Loss: the squared logarithmic distance to a target; parameters above `diverges_above` diverge."""

    target: dict[str, float] = field(default_factory=lambda: {"stretch": 0.7, "mass": 2.0})
    diverges_above: float = float("inf")
    length_unit_m: float = 1.0
    members: tuple[SimpleNamespace, ...] = (SimpleNamespace(frames=(0,)),)
    paper: bool = False
    explained: float = 0.0
    knows_gaps: bool = False
    calls: int = 0

    def __post_init__(self) -> None:
        self.system = SimpleNamespace(gravity=torch.zeros(3).double(), device=torch.device("cpu"), dtype=torch.float64)

    def until(self, part: float) -> Bowl:
        return self  # a single frame

    def reseed(self, seed: int) -> None:
        pass

    def __call__(self, parameters):
        self.calls += 1
        stacked = torch.stack(list(parameters.values()))
        bad = (stacked > self.diverges_above).any(0).nonzero().flatten().tolist()
        if bad:
            raise DivergedError(1, bad, "test")
        return sum((parameters[name] / value).log().square() for name, value in self.target.items())


class KnownResiduals:
    """Points on the x axis at `10 + J_i · (u - u*)` plus noise, against one recorded point at the origin.

    u are logarithms. The rows of J come in pairs ± so that the mean squared distance rises by exactly δᵀ (mean J Jᵀ) δ.
    """

    def __init__(self, rows, optimum, *, noise=0.02, count=400):
        self.rows = torch.as_tensor(np.array(rows)).double().repeat(count, 1)
        self.rows = torch.cat([self.rows, -self.rows])
        self.optimum, self.noise = optimum, noise
        self.system = SimpleNamespace(gravity=torch.zeros(3).double())
        self.scenario = SimpleNamespace(node_sets={})
        self.reseed(0)

    def reseed(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.errors = self.noise * torch.randn(len(self.rows), generator=generator, dtype=torch.float64)

    def simulate(self, parameters):
        return torch.stack([(parameters[name] / value).log() for name, value in self.optimum.items()], dim=-1)

    def pose(self, run):
        return None

    def points(self, run, *, pose=None):
        x = 10 + run @ self.rows.T + self.errors
        return torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], dim=-1)[:, None]

    @property
    def clouds(self):
        return (NeighbourIndex(torch.zeros(1, 3).double()),)

    def frame_losses(self, run, *, pose=None):
        return self.points(run).square().sum(-1).mean(-1)
