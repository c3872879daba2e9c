"""One recording of a likelihood fit: its motion at one parameter set, and the derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from diffcloud.estimation.likelihood.frames import TINY, Frames, one_way, squared
from diffcloud.estimation.likelihood.grasp import regripped
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.residuals import Axis, moved_by
from diffcloud.scene.scenarios import Scenario

INDEPENDENT = 10.0
"""Assumed number of independent residuals per frame, for frames 0.1 s apart."""
_FRAME_S = 0.1
"""Frames with a smaller distance in time [s] have proportionally fewer independent residuals."""
_MODEL_M = 0.001
"""Minimum model error [m] of any cloth simulator."""


class Recording:
    """One recording up to its horizon, on the given mesh and the refined one."""

    def __init__(
        self, objective: Objective, space: FitSpace, columns: Tensor, first_pose: int, grip: int, *, model_error: bool
    ) -> None:
        """Set up the variables of one recording.

        Args:
            space: variables of this recording.
            columns: indices of these variables in the joint fit.
            first_pose: index of the first pose variable of this recording.
            grip: index of the grasp size.
            model_error: see `LikelihoodSettings`.
        """
        self.objective, self.space, self.axis = objective, space, Axis.of(space)
        poses = len(objective.pose_space.names)
        self.regripped, self.grip = regripped(objective.scenario) if model_error else [], grip
        of_grip = [grip] if self.regripped else []
        self.columns = torch.cat([columns, torch.tensor(of_grip, dtype=torch.long), first_pose + torch.arange(poses)])
        self.motion = columns
        self.poses = slice(first_pose, first_pose + poses)
        unit = objective.length_unit_m
        self.known = torch.tensor([cloud.from_surface for cloud in objective.clouds], dtype=torch.float64).T
        if model_error:
            self.known = self.known + (_MODEL_M / unit) ** 2
        self.model_error = model_error
        times = objective.times.sort().values
        gap = float(times.diff().median()) if len(times) > 1 else _FRAME_S
        self.independent = INDEPENDENT * min(1.0, gap / _FRAME_S)
        self.refined: tuple[Tensor, Tensor] | None = None
        """Coordinates [K] and, in the scene's unit, the node displacements [1, L, C · V, 3] that mesh refinement causes
        at them. None before the refined mesh was simulated."""

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        return self.space.parameters(self.axis.bounded(place[None, self.motion]))

    def nodes(self, place: Tensor) -> Tensor:
        """Return the cloth nodes [1, L, C · V, 3] in the scene."""
        return self.objective.looked_at(self.objective.simulate_to_loss(self.parameters(place)))

    @cached_property
    def finer(self) -> Scenario:
        """The scenario with the refined mesh."""
        return self.objective.scenario.finer()

    def refined_in(self, chosen: Sequence[int]) -> tuple[Tensor, Tensor] | None:
        """Return `refined` for the frames with these indices."""
        return None if self.refined is None else (self.refined[0], self.refined[1][:, chosen])

    def change(self, place: Tensor, nodes: Tensor, variant: Scenario) -> Tensor:
        """Return the node displacements [1, L, C · V, 3] that a scenario variant causes."""
        return self.objective.way_to(variant, self.parameters(place), nodes)


@dataclass(frozen=True)
class Changes:
    """Node displacements [1, L, C · V, 3] that variants of one scenario cause; None: unknown."""

    finer: Tensor | None = None
    grip: tuple[Tensor, Tensor] | None = None
    """Linear and quadratic coefficient for a grasp that is g standard deviations larger."""

    def at(self, chosen: Sequence[int]) -> Changes:
        """Return the changes for the frames with these indices."""
        grip = None if self.grip is None else (self.grip[0][:, chosen], self.grip[1][:, chosen])
        return Changes(None if self.finer is None else self.finer[:, chosen], grip)


@dataclass(frozen=True)
class Linear:
    """Motion of one recording at one parameter set, with its derivatives."""

    recording: Recording
    nodes: Tensor
    rates: Tensor
    velocities: Tensor | None

    @staticmethod
    def at(recording: Recording, place: Tensor) -> Linear:
        objective = recording.objective
        moved = moved_by(objective, recording.space, place[None, recording.motion])
        velocities = None
        if objective.pose_space.moves_clocks:
            velocities = objective.still_bodies(objective.velocities(moved.run))
        return Linear(recording, objective.looked_at(moved.run), moved.rates, velocities)

    def frames(self, place: Tensor, changes: Changes, asked: Tensor | None = None) -> Frames:
        """Return the terms of Φ.

        Args:
            asked: [1, L, C · V, 3] node shifts whose effect on the gradients is needed.
        """
        one = self.recording
        objective, space = one.objective, one.objective.pose_space
        pose = (place[one.poses] * space.deviations)[None]
        nodes, rates, shift = self.nodes, self.rates, changes.finer
        if shift is not None:
            nodes = nodes + shift
        if one.regripped:
            first, second = changes.grip or (torch.zeros_like(nodes), torch.zeros_like(nodes))
            off = place[one.grip]
            nodes, rates = nodes + off * first + off**2 * second, torch.cat([rates, (first + 2 * off * second)[None]])
        motion = objective.matched(objective.with_bodies(nodes), self.velocities, pose)
        points, columns = objective.columns(motion, rates)
        views, ways = motion.shown(space), list[tuple[Tensor, Tensor, Tensor, Tensor]]()
        units = torch.cat([torch.ones(len(rates)).double(), space.deviations])[:, None, None, None, None]
        for pairs, at, moves in zip(motion.pairs, points, columns, strict=True):
            normals = pairs.normals
            if normals is None:
                first, second, third = pairs.places.corners(views).unbind(-2)
                normals = torch.linalg.cross(second - first, third - first)
                normals = space.carried(normals / normals.norm(dim=-1, keepdim=True).clamp(min=TINY), pose)
            moved = None if asked is None else space.carried(pairs.places.of(objective.still_bodies(asked)), pose)
            ways.append(one_way(pairs, at - pairs.partners, normals, units * moves, moved, objective.cap))
        squares, slopes, curvatures, shifted = (torch.stack(part) for part in zip(*ways, strict=True))
        variances = one.known if shift is None else one.known + squared(shift / 2)
        return Frames(squares, slopes, curvatures, shifted, variances)
