"""Batches of simulations: converts tensors to arrays for the kernels, runs one thread per cloth and collects failures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.sim import status
from diffcloud.sim.compiled.data import Floats, Parameters
from diffcloud.sim.handles import HandleSchedule
from diffcloud.sim.held import Held
from diffcloud.sim.integrators import Derivatives, Episode, Outcome
from diffcloud.sim.plausibility import Motion as Course
from diffcloud.sim.plausibility import implausible
from diffcloud.sim.properties import Properties
from diffcloud.sim.scenery import Scenery
from diffcloud.sim.system import System
from diffcloud.sim.threads import run_all

FACTOR_MEMORY = 256 * 2**20
"""Memory for the matrix factors that a batch keeps for its derivatives [bytes]. Further factors are recomputed."""
_BLOCK = 9 * 8

_PROPERTIES = tuple(field.name for field in fields(Properties))
"""Fields of `Parameters` that are constant over an episode."""


class Batch:
    """A batch of B episodes of one system over S steps. Inputs have a leading batch axis: positions and velocities
    [B, V, 3], poses of the N bodies [B, N, 18], tracks of the G grippers [B, S, G, 3], and the fields of `Properties`."""

    def __init__(self, system: System, steps: int, *, tracked: bool, progress: Callable[[int], None] | None = None) -> None:
        self.system, self.steps = system, steps
        times = np.cumsum(np.full(steps, system.time_step))  # repeated addition, as ARCSim accumulates time
        self.schedule = system.handles.tracked_schedule(times) if tracked else system.handles.schedule(times)
        self.held = _held(system, self.schedule)
        all_times = np.concatenate([[0.0], times])
        self.times = torch.as_tensor(all_times)
        self._integrator = system.integrator
        self._scenery = _scenery(system).at(all_times)
        self._progress = progress

    def simulate(self, inputs: Sequence[Tensor], *, keep: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Simulate the batch. `diverged` lists the entries that failed.

        Args:
            inputs: as the class describes, in this order.
            keep: store the matrix factors that derivatives need.

        Returns:
            Positions [B, S + 1, V, 3], velocities [B, S + 1, V, 3] and poses of the bodies [B, S + 1, N, 18].
        """
        self._inputs = [np.ascontiguousarray(tensor.detach().numpy()) for tensor in inputs]
        positions, velocities, poses, self._track, *properties = self._inputs
        count = len(positions)
        self.positions, self.velocities, self.poses = (self._over_time(first) for first in (positions, velocities, poses))
        self._parameters = [self._read([one[entry] for one in properties]) for entry in range(count)]
        self._control = np.zeros((count, 2), np.int64)
        self._anchors = np.zeros((count, len(self.held.node), 3))
        self._ends: list[Outcome] = [Outcome(status.INTERRUPTED, 0, None)] * count
        limit = FACTOR_MEMORY // (_BLOCK * count) if keep else -1

        def job(entry: int) -> None:
            episode = self._episode(entry)
            self._ends[entry] = self._integrator.simulate(self.system.scene, episode, limit, self._control[entry])

        self._run(job, count)
        return tuple(torch.from_numpy(array) for array in (self.positions, self.velocities, self.poses))  # type: ignore[return-value]

    def gradients(self, outputs: Sequence[Tensor]) -> list[Tensor]:
        """Gradients of a loss with respect to the inputs, given its gradients with respect to the results of `simulate`."""
        position, velocity, pose = (np.array(tensor.detach().numpy(), dtype=np.float64, order="C") for tensor in outputs)
        count = len(position)
        found = [np.zeros_like(array) for array in self._inputs]

        def job(entry: int) -> None:
            outcome = self._ends[entry]
            done = outcome.step + 1  # steps after a failure hold NaN, so they are left out of the sweep
            gradients = Parameters(*(np.zeros_like(array) for array in self._parameters[entry]))
            states = (array[entry, :done] for array in (position, velocity, pose))
            self._integrator.reverse(
                self.system.scene,
                self._episode(entry, done),
                outcome,
                Derivatives(gradients, found[3][entry], *states),
            )
            for array, first in zip(found, (position, velocity, pose), strict=False):
                array[entry] = first[entry, 0]
            for array, name in zip(found[4:], _PROPERTIES, strict=True):
                array[entry] = getattr(gradients, name).reshape(array[entry].shape)

        self._run(job, count)
        return [torch.from_numpy(array) for array in found]

    def tangents(self, rates: Sequence[Tensor]) -> Tensor:
        """Directional derivatives of the positions [K, B, S + 1, V, 3] along K directions [K, B, ...] of the inputs."""
        position, velocity, pose, track, *properties = (np.ascontiguousarray(tensor.numpy()) for tensor in rates)
        directions, count = position.shape[:2]
        found = np.empty((count, self.steps + 1, *position.shape[:1], *position.shape[2:]))

        def job(entry: int) -> None:
            moves = self._read_rates(self._parameters[entry], [one[:, entry] for one in properties])
            velocity_rates = np.empty_like(found[entry])
            found[entry, 0], velocity_rates[0] = position[:, entry], velocity[:, entry]
            pose_rates = np.empty((self.steps + 1, directions, *pose.shape[2:]))
            pose_rates[0] = pose[:, entry]
            self._integrator.tangents(
                self.system.scene,
                self._episode(entry),
                self._ends[entry],
                Derivatives(moves, np.ascontiguousarray(track[:, entry]), found[entry], velocity_rates, pose_rates),
            )

        self._run(job, count)
        return torch.from_numpy(np.moveaxis(found, 2, 0))

    def diverged(self) -> dict[int, DivergedError]:
        """Batch entries whose last simulation failed or is implausible, each with its error."""
        found = {}
        for entry, outcome in enumerate(self._ends):
            fault = self._failed(entry, outcome) if outcome.status != status.DONE else None
            last = self.steps if fault is None else outcome.step
            earlier = implausible(self._course(entry, last), partial(self._stored, entry)) if last else None
            if earlier is not None:
                fault = DivergedError(earlier[0], [entry], earlier[1])
            if fault is not None:
                found[entry] = fault
        return found

    # --- arrays ------------------------------------------------------------------------------------------------------

    def _episode(self, entry: int, states: int | None = None) -> Episode:
        """Arrays of one batch entry, optionally only its first `states` states."""
        return Episode(
            self.held,
            self._parameters[entry],
            self._track[entry],
            self._scenery,
            self._anchors[entry],
            self.positions[entry, :states],
            self.velocities[entry, :states],
            self.poses[entry, :states],
        )

    def _over_time(self, first: Floats) -> Floats:
        """Allocate [B, S + 1, ...]. Fill the first state from [B, ...] and the others with NaN."""
        whole = np.full((len(first), self.steps + 1, *first.shape[1:]), np.nan)
        whole[:, 0] = first
        return whole

    def _read(self, properties: Sequence[Floats]) -> Parameters:
        """Parameters of one batch entry, from arrays in the order of `_PROPERTIES`."""
        fields = dict(zip(_PROPERTIES, map(np.atleast_1d, properties), strict=True))
        inverse = np.zeros(self._integrator.points(self.system.scene))
        inverse[: len(fields["node_mass"])] = 1 / fields["node_mass"]
        handles = len(self.held.node)
        return Parameters(**fields, inverse_mass=inverse, hold=np.zeros(handles), target=np.zeros((handles, 3)))

    def _read_rates(self, parameters: Parameters, properties: Sequence[Floats]) -> Parameters:
        """Derivatives of `_read` along K directions. Each array has a leading axis K."""
        flat = (np.ascontiguousarray(one.reshape(len(one), -1)) for one in properties)
        fields = dict(zip(_PROPERTIES, flat, strict=True))
        directions, nodes = fields["node_mass"].shape
        inverse = np.zeros((directions, self._integrator.points(self.system.scene)))
        inverse[:, :nodes] = -fields["node_mass"] / parameters.node_mass**2
        hold = np.zeros((directions, len(self.held.node)))
        return Parameters(**fields, inverse_mass=inverse, hold=hold, target=np.zeros((*hold.shape, 3)))

    # --- running -----------------------------------------------------------------------------------------------------

    def _run(self, job: Callable[[int], None], count: int) -> None:
        def look() -> None:
            if self._progress is not None:
                self._progress(int(self._control[:, 0].sum()) // count)

        def stop() -> None:
            self._control[:, 1] = 1

        run_all([partial(job, entry) for entry in range(count)], look=look, stop=stop)

    # --- failures ----------------------------------------------------------------------------------------------------

    def _failed(self, entry: int, outcome: Outcome) -> DivergedError:
        if outcome.status >= status.FIRST_OWN:
            return self._integrator.fault(entry, self._episode(entry), outcome)
        return DivergedError(outcome.step + 1, [entry], "positions are not finite")

    def _course(self, entry: int, last: int) -> Course:
        """Motion of one entry up to step `last`, as `implausible` takes it."""
        system, schedule = self.system, self.schedule
        followed = schedule.gripper >= 0
        translation = schedule.translation[:last].copy()
        translation[:, followed] += self._track[entry, :last, schedule.gripper[followed]].swapaxes(0, 1)
        targets = translation + np.einsum("shij,hj->shi", schedule.linear[:last], self._anchors[entry])
        moving = self._scenery[: last + 1, len(self._scenery[0]) - system.moving_points :]
        poses = self.poses[entry, : last + 1]
        bodies = system.bodies.placed(poses[..., :3], poses[..., 3:12].reshape(*poses.shape[:2], 3, 3))
        return Course(
            positions=self.positions[entry, : last + 1],
            time_step=system.time_step,
            mass=self._parameters[entry].node_mass,
            size=system.mesh.size,
            places=np.concatenate([self.positions[entry, :1][:, self.held.node], targets]),
            held=schedule.active[:last],
            gravity=np.array(system.setup.surrounding.gravity, dtype=np.float64),
            wind=float(np.linalg.norm(system.setup.surrounding.wind)),
            velocities=self.velocities[entry, 0],
            others=np.concatenate([moving, bodies], axis=1),
            push=sum(term.push(system.setup) for term in self._integrator.terms),
        )

    def _stored(self, entry: int, step: int) -> float:
        """Elastic energy after a step [J]."""
        return self._integrator.energy(self.system.scene, self._parameters[entry], self.positions[entry, step])


def _scenery(system: System) -> Scenery:
    around = system.setup.surrounding
    static = [obstacle for obstacle in around.obstacles if obstacle.plane() is None]
    return Scenery.build(static, around.moving)


def _held(system: System, schedule: HandleSchedule) -> Held:
    """Convert the handle schedule to arrays for the kernels."""
    steps, count = schedule.strength.shape
    inverse: NDArray[np.float64] = np.zeros((count, 3, 3))
    for h, first in enumerate(schedule.first_step):
        if first < steps:
            inverse[h] = np.linalg.inv(schedule.linear[first, h])
    return Held(
        node=np.array(system.handles.nodes, dtype=np.int64),
        hard=system.handles.hard,
        stiffness=float(system.handles.stiffness),
        strength=np.ascontiguousarray(schedule.strength),
        linear=np.ascontiguousarray(schedule.linear),
        translation=np.ascontiguousarray(schedule.translation),
        first_step=schedule.first_step.astype(np.int64),
        inverse=inverse,
        gripper=schedule.gripper.astype(np.int64),
    )
