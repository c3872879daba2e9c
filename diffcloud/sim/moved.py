"""Positions of moving obstacles and rigid bodies during a rollout, for rendering and export."""

from __future__ import annotations

import numpy as np

from diffcloud.mesh.topology import FloatArray, IntArray
from diffcloud.sim.simulate import Rollout
from diffcloud.sim.system import System


def moved_surfaces(system: System, run: Rollout) -> tuple[FloatArray, IntArray]:
    """Surface of all moving obstacles, followed by all rigid bodies, as one mesh.

    Returns:
        Nodes [B, S + 1, P, 3] in the world frame [m] and faces [F, 3]. P and F are zero if there are none. If a batch entry
        diverged, its bodies are NaN.
    """
    around, batch, times = system.setup.surrounding, len(run.positions), run.times.numpy()
    parts = [np.broadcast_to(moving.at(times), (batch, len(times), len(moving.mesh.nodes), 3)) for moving in around.moving]
    if run.bodies is not None:
        centre, orientation = (part.detach().numpy() for part in (run.bodies.centre, run.bodies.orientation))
        parts.append(system.bodies.placed(centre, orientation))
    meshes = [*(moving.mesh for moving in around.moving), *(body.mesh for body in around.bodies)]
    first = np.cumsum([0, *(len(mesh.nodes) for mesh in meshes)])
    faces = [np.zeros((0, 3), np.int64), *(mesh.faces + n for mesh, n in zip(meshes, first[:-1], strict=True))]
    return np.concatenate([np.zeros((batch, len(times), 0, 3)), *parts], axis=2), np.concatenate(faces)
