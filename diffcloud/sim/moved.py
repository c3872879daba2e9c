"""Where obstacles that move are in the course of a rollout, to be drawn or written."""

from __future__ import annotations

import numpy as np

from diffcloud.mesh.topology import FloatArray, IntArray
from diffcloud.sim.simulate import Rollout
from diffcloud.sim.system import System


def moved_surfaces(system: System, run: Rollout) -> tuple[FloatArray, IntArray]:
    """Moving obstacles and then rigid bodies, as one mesh.

    Returns:
        Nodes [B, S + 1, P, 3] in the world's axes [m] and faces [F, 3]. Without any, P and F are zero; where a batch entry
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
