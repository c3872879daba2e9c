"""Objectives whose answers are known: no simulation, formulas instead."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace

import torch

from diffcloud.errors import DivergedError
from diffcloud.estimation.parameters import FitSpace

SPACE = FitSpace.build(["stretching", "density"])


@dataclass
class Bowl:
    """Loss: the squared logarithmic distance to a target; parameters above `diverges_above` diverge."""

    target: dict[str, float] = field(default_factory=lambda: {"stretching": 0.7, "density": 2.0})
    diverges_above: float = float("inf")
    length_unit_m: float = 1.0
    members: tuple[SimpleNamespace, ...] = (SimpleNamespace(frames=(0,)),)
    paper: bool = False
    calls: int = 0

    def __post_init__(self) -> None:
        self.system = SimpleNamespace(gravity=torch.zeros(3).double(), device=torch.device("cpu"), dtype=torch.float64)

    def reseed(self, seed: int) -> None:
        pass

    def __call__(self, parameters):
        self.calls += 1
        stacked = torch.stack(list(parameters.values()))
        bad = (stacked > self.diverges_above).any(0).nonzero().flatten().tolist()
        if bad:
            raise DivergedError(1, bad, "test")
        return sum((parameters[name] / value).log().square() for name, value in self.target.items())
