"""Simulator inputs of parameter sets, and the scaling of motions for a cloth of another size.

A cloth s times as large as the scene's, x = c + s (ξ - c), moves like the scene's own cloth ξ if

    stretching is k / s²,  bending B / s⁴,  gravity g / s,  air density ρ s,  added mass m s,
    and the gripper's displacement u / s.

Written in ξ, inertia gains a factor s⁴, weight s³, stretching energy s² and bending energy 1. The work of quadratic
drag and the inertia of the air gain s⁵. All terms are then divided by s⁴. Linear drag scales like inertia. Shear,
compression and friction are ratios, and damping is a time. So the mesh and everything computed from it stay the same.

c is below the centre of the cloth, on the table, so the table does not move. The grasped nodes do move, which the pose
compensates. Three quantities become wrong: the contact thickness (s times too large), the stiffness of soft handles
(s²), and the curvature at which a bending table is read (s). For size changes of a few percent this is negligible.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffcloud.estimation.initial_state import check_resizable, initial_nodes, is_initial_state, sizes_of
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import Properties
from diffcloud.sim.simulate import Rollout, init, rollout, rollout_tangents, still
from diffcloud.sim.system import State, System


@dataclass(frozen=True)
class Inputs:
    """Simulator inputs of B motions over a number of steps, at the scene's size."""

    system: System
    steps: int
    properties: Properties
    state: State | None
    """State at the start; None: that of the scene."""
    track: Tensor | None
    """[B, S, G, 3] gripper displacements; None: the scene's own motion."""
    size: Tensor | None
    """[B] size of the cloth relative to the scene; None: the same size."""

    @staticmethod
    def of(scenario: Scenario, system: System, steps: int, values: Mapping[str, Tensor], track: Tensor | None) -> Inputs:
        """Return the inputs of parameter sets.

        Args:
            values: name -> [B], for parameters and initial-state variables (`estimation.initial_state`).
            track: [1, S or more, G, 3] recorded gripper displacements, in scene units; None: the scene's own motion.

        Raises:
            ConfigError: a parameter is unknown, or a size is given for a scene with more than a level table.
            SceneError: a size or path length is given, but neither the recording nor the scene has a gripper path.
        """
        size, reach = sizes_of(values)
        count = len(next(iter(values.values()))) if values else 1
        nodes = initial_nodes(system.mesh, values)
        properties = scenario.properties(
            system, {name: value for name, value in values.items() if not is_initial_state(name)}
        )
        properties = properties.repeated(count) if properties.batch < count else properties
        if size is not None:
            check_resizable(scenario)
            properties = replace(
                properties,
                stretching=properties.stretching / size[:, None] ** 2,
                bending=properties.bending / size[:, None] ** 4,
                node_mass=properties.weight + (properties.node_mass - properties.weight) * size[:, None],
                weight=properties.weight / size[:, None],
                air_density=properties.air_density * size,
            )
        if reach is not None and system.handles.grippers:
            if track is None:
                track = torch.as_tensor(system.handles.own_track(np.cumsum(np.full(steps, system.time_step))))[None]
            track = track * _beside(reach)
        track = None if track is None else track[:, :steps].expand(count, -1, -1, -1)
        state = None if nodes is None else init(system, len(nodes), positions=nodes)
        return Inputs(system, steps, properties, state, track, size)

    def rollout(self, *, progress: Callable[[int], None] | None = None) -> Rollout:
        """Simulate the motions; see `sim.rollout`."""
        run = rollout(
            self.system, self.steps, properties=self.properties, state=self.state, track=self.track, progress=progress
        )
        return self._shown(run)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return the tensors [B, ...] that may depend on fitted variables, with their derivatives."""
        positions = None if self.state is None else self.state.positions
        return *self.properties.tensors(), *(one for one in (positions, self.track, self.size) if one is not None)

    def rollout_tangents(self, rates: Sequence[Tensor]) -> tuple[Rollout, Tensor]:
        """Simulate the motions and their forward-mode derivatives d positions [K, B, S + 1, V, 3].

        Args:
            rates: [K · B, ...] derivatives of each of `tensors` in K directions, directions outermost.
        """
        own = len(self.properties.tensors())
        further = iter(rates[own:])
        start, track, size = (None if one is None else next(further) for one in (self.state, self.track, self.size))
        run, moves = rollout_tangents(
            self.system,
            self.steps,
            properties=self.properties,
            tangents=Properties(*rates[:own]),
            state=self.state,
            state_tangents=None if start is None else still(self.system, start),
            track=self.track,
            track_tangents=track,
        )
        if size is None or self.size is None:
            return run, moves
        grown = size.reshape(len(moves), -1, 1, 1, 1) * (run.positions - self._centre)
        return self._shown(run), _beside(self.size) * moves + grown

    @property
    def _centre(self) -> Tensor:
        """[3] fixed point of the scaling."""
        mesh, obstacles = self.system.mesh, self.system.setup.surrounding.obstacles
        table = obstacles[0].nodes if obstacles else mesh.nodes
        return torch.as_tensor([*mesh.nodes[:, :2].mean(0), table[:, 2].mean()])

    def _shown(self, run: Rollout) -> Rollout:
        """Scale a rollout to the size of the real cloth."""
        if self.size is None:
            return run
        size, centre = _beside(self.size), self._centre
        return replace(run, positions=centre + size * (run.positions - centre), velocities=size * run.velocities)


def _beside(size: Tensor) -> Tensor:
    """Reshape [B] to [B, 1, 1, 1]."""
    return size[:, None, None, None]
