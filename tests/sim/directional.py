"""Directional derivatives of whole episodes, three ways: reverse mode, forward mode, central differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from diffcloud.scene.scenarios import Scenario
from diffcloud.sim import Properties, State, init, rollout, rollout_tangents
from diffcloud.sim.system import System

SCALARS = ("stretching", "shear", "density", "bending", "damping", "air_density", "friction")
STILL_AIR = ("added_mass", "linear_drag")
STEPS = tuple(10.0**-k for k in range(2, 9))


@dataclass(frozen=True)
class Episode:
    """An episode as a function of everything that can be differentiated."""

    scenario: Scenario
    system: System
    steps: int
    track: Tensor
    """[1, S, G, 3] displacement of the grippers."""
    weights: Tensor
    """[S + 1, V, 3] of the linear functional whose derivative is taken."""

    @staticmethod
    def build(scenario: Scenario, steps: int, *, seed: int = 0) -> Episode:
        system, _ = scenario.scene.build()
        generator = torch.Generator().manual_seed(seed)
        paths = {handle.gripper: handle.motion for handle in system.handles.handles if handle.motion is not None}
        times = torch.arange(1, steps + 1, dtype=torch.float64) * system.time_step
        moved = [path.at(times.numpy())[1] for path in paths.values()]
        track = torch.as_tensor(np.stack(moved, axis=1))[None]
        nodes = len(system.mesh.nodes)
        weights = torch.zeros(steps + 1, nodes, 3, dtype=torch.float64)
        weights[-1] = torch.randn(nodes, 3, dtype=torch.float64, generator=generator)
        weights[steps // 2] = torch.randn(nodes, 3, dtype=torch.float64, generator=generator)
        return Episode(scenario, system, steps, track, weights)

    @property
    def scalars(self) -> tuple[str, ...]:
        """The parameters that the scene has."""
        return SCALARS + (STILL_AIR if self.scenario.scene.surrounding.added_mass else ())

    def base(self) -> dict[str, Tensor]:
        """Inputs of batch 1, away from special values.

        A cloth at rest sits on kinks of the model (|E01| and the tension clamp at zero strain), where a central difference
        gives the mean of two slopes. So the start is stretched by 2 % and crumpled by a tenth of a millimetre.
        """
        nodes = torch.as_tensor(self.system.mesh.nodes)
        middle = nodes.mean(0)
        generator = torch.Generator().manual_seed(2)
        noise = torch.randn(nodes.shape, dtype=torch.float64, generator=generator)
        nodes = middle + (nodes - middle) * 1.02 + 1e-4 * noise
        one = torch.ones(1, dtype=torch.float64)
        return {
            "stretching": 1.3 * one,
            "shear": 0.7 * one,
            "density": 0.88 * one,
            "bending": 1.2 * one,
            "damping": 0.004 * one,
            "air_density": 0.9 * one,
            "friction": 0.4 * one,
            **{name: 1.4 * one for name in STILL_AIR if name in self.scalars},
            "positions": nodes[None].clone(),
            "velocities": torch.zeros_like(nodes)[None],
            "track": self.track.clone(),
        }

    def run(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """[B, ...] inputs -> [B] functional."""
        properties = self.properties(inputs)
        state = init(self.system, properties.batch, positions=inputs["positions"], velocities=inputs["velocities"])
        result = rollout(self.system, self.steps, properties=properties, state=state, track=inputs["track"])
        return (result.positions * self.weights).sum((1, 2, 3))

    def properties(self, inputs: Mapping[str, Tensor]) -> Properties:
        return self.scenario.properties(self.system, {name: inputs[name] for name in self.scalars})

    def reverse(self, directions: Sequence[Mapping[str, Tensor]]) -> list[float]:
        """One backward pass, dotted with every direction."""
        inputs = {name: value.requires_grad_(True) for name, value in self.base().items()}
        found = torch.autograd.grad(self.run(inputs).sum(), list(inputs.values()), materialize_grads=True)
        gradients = dict(zip(inputs, found, strict=True))
        for name, gradient in gradients.items():
            assert torch.isfinite(gradient).all(), name
        return [float(sum((gradients[name] * change).sum() for name, change in d.items())) for d in directions]

    def forward(self, directions: Sequence[Mapping[str, Tensor]]) -> list[float]:
        """All directions carried along in one rollout."""
        inputs, count = self.base(), len(directions)
        stacked = {
            name: torch.cat([d.get(name, torch.zeros_like(value)) for d in directions]) for name, value in inputs.items()
        }
        with forward_ad.dual_level():
            dual = {n: forward_ad.make_dual(v.repeat(count, *[1] * (v.dim() - 1)), stacked[n]) for n, v in inputs.items()}
            pairs = [forward_ad.unpack_dual(t) for t in self.properties(dual).tensors()]
            tangents = Properties(*(torch.zeros_like(p) if t is None else t for p, t in pairs))
        _, tangent = rollout_tangents(
            self.system,
            self.steps,
            properties=self.properties(inputs),
            tangents=tangents,
            state=init(self.system, 1, positions=inputs["positions"], velocities=inputs["velocities"]),
            state_tangents=State(stacked["positions"], stacked["velocities"]),
            track=inputs["track"],
            track_tangents=stacked["track"],
        )
        assert torch.isfinite(tangent).all()
        return (tangent[:, 0] * self.weights).sum((1, 2, 3)).tolist()

    def central(self, directions: Sequence[Mapping[str, Tensor]], steps: Sequence[float]) -> list[list[float]]:
        """Central differences over a sweep of steps, a batch per direction."""
        signs = torch.tensor([s * h for h in steps for s in (1.0, -1.0)], dtype=torch.float64)
        found = []
        for direction in directions:
            inputs = {}
            for name, value in self.base().items():
                change = direction.get(name, torch.zeros_like(value))
                inputs[name] = value + signs.view(-1, *[1] * (value.dim() - 1)) * change
            with torch.no_grad():
                values = self.run(inputs)
            found.append([float((values[2 * i] - values[2 * i + 1]) / (2 * h)) for i, h in enumerate(steps)])
        return found


def directions(episode: Episode, *, seed: int = 1, per_field: int = 3) -> dict[str, dict[str, Tensor]]:
    """A direction for each scalar, and a few random ones for each field, scaled to sensible perturbations."""
    generator = torch.Generator().manual_seed(seed)
    base = episode.base()
    found = {name: {name: base[name].clone()} for name in episode.scalars}
    for name, scale in (("positions", 1e-3), ("velocities", 1e-2), ("track", 1e-3)):
        for index in range(per_field):
            random = torch.randn(base[name].shape, dtype=torch.float64, generator=generator)
            found[f"{name}{index}"] = {name: scale * random}
    return found
