"""Obstacles that contact forces do not move: static ones, and those that follow a given motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.sim.motion import Motion


@dataclass(frozen=True)
class MovingObstacle:
    """An obstacle that follows keyframes, regardless of contact."""

    mesh: SurfaceMesh
    """Mesh before the motion is applied [m]."""
    motion: Motion
    start: float = 0.0
    """The obstacle does not move before this time [s]."""
    end: float = float("inf")
    """The obstacle does not move after this time [s]."""

    def at(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Nodes [T, P, 3] [m] at times [T] [s]."""
        linear, translation = self.motion.at(np.clip(times, self.start, self.end))
        return np.asarray(np.einsum("tij,oj->toi", linear, self.mesh.nodes) + translation[:, None])


@dataclass(frozen=True)
class Scenery:
    """The points of all static obstacles, followed by those of all moving ones."""

    fixed: NDArray[np.float64]
    """[O, 3] points [m]; moving obstacles are here without their motion."""
    moving: tuple[tuple[slice, MovingObstacle], ...] = ()

    @staticmethod
    def build(static: Sequence[SurfaceMesh], moving: Sequence[MovingObstacle]) -> Scenery:
        parts = [mesh.nodes for mesh in static] + [obstacle.mesh.nodes for obstacle in moving]
        ends = np.cumsum([0, *(len(part) for part in parts)])[len(static) :]
        slices = [slice(int(a), int(b)) for a, b in pairwise(ends)]
        return Scenery(
            np.concatenate([*parts, np.zeros((0, 3))]),
            tuple(zip(slices, moving, strict=True)),
        )

    def at(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points [T, O, 3] [m] at times [T] [s]."""
        points = np.broadcast_to(self.fixed, (len(times), *self.fixed.shape)).copy()
        for place, obstacle in self.moving:
            points[:, place] = obstacle.at(times)
        return points
