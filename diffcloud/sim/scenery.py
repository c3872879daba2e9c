"""Obstacles that nothing can push: static ones, and those that follow a motion."""

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
    """An obstacle that follows keyframes, whatever it meets."""

    mesh: SurfaceMesh
    """At the motion's identity [m]."""
    motion: Motion
    start: float = 0.0
    """Before it, the motion stands as at this time [s]."""
    end: float = float("inf")
    """After it, the motion stands as at this time [s]."""

    def at(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points [T, P, 3] [m] at times [T] [s]."""
        linear, translation = self.motion.at(np.clip(times, self.start, self.end))
        return np.asarray(np.einsum("tij,oj->toi", linear, self.mesh.nodes) + translation[:, None])


@dataclass(frozen=True)
class Scenery:
    """The points of all static and all moving obstacles, in this order."""

    fixed: NDArray[np.float64]
    """[O, 3] [m]; of the moving ones, before their motion."""
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
        """[T, O, 3] at times [T] [s]."""
        points = np.broadcast_to(self.fixed, (len(times), *self.fixed.shape)).copy()
        for place, obstacle in self.moving:
            points[:, place] = obstacle.at(times)
        return points
