"""Many random episodes of every built-in: positions and gradients stay finite."""

from __future__ import annotations

import pytest
import torch

from diffcloud.scene.scenarios import load_scenario
from diffcloud.sim.simulate import rollout

RANGES = {
    "stretching": (0.1, 10.0),
    "density": (0.1, 10.0),
    "shear": (0.1, 3.0),
    "bending": (0.3, 3.0),
    "air_density": (0.3, 3.0),
    "damping": (0.01, 0.1),
    "friction": (0.05, 1.0),
    "self_friction": (0.05, 1.0),
}
BATCH = 25


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "episodes"),
    [("lift", 75), ("fold", 75), ("band_stretch", 75), ("vest_hang", 75), ("recorded_lift", 25), ("recorded_fold", 25)],
)
def test_gradients_are_finite_in_random_episodes(name, episodes):
    """Parameters drawn log-uniformly, and compression, where the scenario sets it below 1."""
    scenario = load_scenario(name)
    system, _ = scenario.scene.build()
    generator = torch.Generator().manual_seed(0)
    ranges = RANGES | ({"compression": (0.003, 1.0)} if scenario.scene.material.wrinkles else {})
    for _ in range(episodes // BATCH):
        values = {}
        for parameter, (low, high) in ranges.items():
            part = torch.rand(BATCH, generator=generator, dtype=torch.float64)
            values[parameter] = (low * (high / low) ** part).requires_grad_(True)
        # light bands in dense air explode, which is told (docs/limits.md)
        run = rollout(system, scenario.steps, properties=scenario.properties(system, values), drop_diverged=True)
        kept = [entry for entry in range(BATCH) if entry not in run.diverged]
        assert len(kept) >= 0.9 * BATCH
        assert bool(torch.isfinite(run.positions[kept]).all())
        gradients = torch.autograd.grad(run.positions[kept, -1].square().sum(), list(values.values()), allow_unused=True)
        assert gradients[0] is not None
        assert gradients[1] is not None
        for parameter, gradient in zip(ranges, gradients, strict=True):
            assert gradient is None or bool(torch.isfinite(gradient).all()), parameter
