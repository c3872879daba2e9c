"""From parameter sets to the simulator's inputs, and from its motion to what a cloth of another size does.

A cloth s times as large as the scene's, x = c + s (ξ - c), moves as the scene's own cloth ξ does where

    stretching is k / s²,  bending B / s⁴,  gravity g / s,  air density ρ s,  added mass m s,
    and the gripper's displacement u / s.

Written in ξ, inertia gains a factor s⁴, weight s³, the energy of stretching s², that of bending none, and the work of
quadratic drag and the inertia of the air s⁵; all is divided by s⁴. Linear drag gains what inertia does; shear, compression
and friction are ratios, and damping is a time. So the mesh and all that is computed from it stay.

c is below the cloth's middle, on the table, so the table does not move. The grasped nodes do, and the pose takes that up.
Contact and the gap below the cloth are s times as thick, soft handles s² times as stiff, and a bending table is read at a
curvature s times too large: for sizes off by a few percent, this hardly matters.
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
    """Of B motions of a cloth over some steps, at the scene's size."""

    system: System
    steps: int
    properties: Properties
    state: State | None
    """At the start; None: that of the scene."""
    track: Tensor | None
    """[B, S, G, 3] displacement of the grippers; None: the scene's own motion."""
    size: Tensor | None
    """[B] how many times as large the cloth is; None: as large."""

    @staticmethod
    def of(scenario: Scenario, system: System, steps: int, values: Mapping[str, Tensor], track: Tensor | None) -> Inputs:
        """Of parameter sets.

        Args:
            system: of the scenario's scene.
            values: name -> [B], of parameters and of how the cloth lies (`estimation.initial_state`).
            track: [1, S or more, G, 3] recorded displacement of the grippers [m]; None: the scene's own motion.

        Raises:
            ConfigError: an unknown parameter, or a size where there is more around the cloth than a table.
            SceneError: a size or a longer path, but neither a track nor a motion of the scene that is one.
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
        """See `sim.rollout`."""
        run = rollout(
            self.system, self.steps, properties=self.properties, state=self.state, track=self.track, progress=progress
        )
        return self._shown(run)

    def tensors(self) -> tuple[Tensor, ...]:
        """[B, ...] all that may depend on what is fitted, with its derivatives."""
        positions = None if self.state is None else self.state.positions
        return *self.properties.tensors(), *(one for one in (positions, self.track, self.size) if one is not None)

    def rollout_tangents(self, rates: Sequence[Tensor]) -> tuple[Rollout, Tensor]:
        """The motions, and d positions [K, B, S + 1, V, 3] along rates [K · B, ...] of `tensors`, directions outermost."""
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
        """[3] that stays where it is."""
        mesh, obstacles = self.system.mesh, self.system.setup.surrounding.obstacles
        table = obstacles[0].nodes if obstacles else mesh.nodes
        return torch.as_tensor([*mesh.nodes[:, :2].mean(0), table[:, 2].mean()])

    def _shown(self, run: Rollout) -> Rollout:
        """At the cloth's own size."""
        if self.size is None:
            return run
        size, centre = _beside(self.size), self._centre
        return replace(run, positions=centre + size * (run.positions - centre), velocities=size * run.velocities)


def _beside(size: Tensor) -> Tensor:
    """[B] -> [B, 1, 1, 1]"""
    return size[:, None, None, None]
