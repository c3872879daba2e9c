"""One recording: its motion at a place, and how that changes."""

from __future__ import annotations

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
"""Residuals of a frame that count as independent, of frames a tenth of a second apart."""
_FRAME_S = 0.1
"""Frames that are closer share these."""
_MODEL_M = 0.001
"""What no simulator of cloth predicts better."""


class Recording:
    """One recording up to its horizon, on the given mesh and the finer one."""

    def __init__(
        self, objective: Objective, space: FitSpace, columns: Tensor, first_pose: int, grip: int, *, model_error: bool
    ) -> None:
        """
        Args:
            space: of this recording, and the places of its variables among all.
            first_pose: place of the first variable of its pose.
            grip: place of the grasp's size.
            model_error: as of `LikelihoodSettings`.
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

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        return self.space.parameters(self.axis.bounded(place[None, self.motion]))

    def nodes(self, place: Tensor) -> Tensor:
        """[1, L, C · V, 3] of the cloth in the scene."""
        return self.objective.looked_at(self.objective.simulate_to_loss(self.parameters(place)))

    @cached_property
    def finer(self) -> Scenario:
        """On the finer mesh."""
        return self.objective.scenario.finer()

    def change(self, place: Tensor, nodes: Tensor, variant: Scenario) -> Tensor:
        """[1, L, C · V, 3] by which a variant of the scenario moves the nodes."""
        return self.objective.way_to(variant, self.parameters(place), nodes)


@dataclass(frozen=True)
class Changes:
    """By how much variants of one scenario move the nodes, [1, L, C · V, 3] each; None: not known."""

    finer: Tensor | None = None
    grip: tuple[Tensor, Tensor] | None = None
    """By a grasp g standard deviations larger, in powers of g: the first and the second one."""


@dataclass(frozen=True)
class Linear:
    """The motion of one recording at a place, and how it changes."""

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
        """
        Args:
            asked: [1, L, C · V, 3] of the nodes, whose effect on the slopes is wanted.
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
