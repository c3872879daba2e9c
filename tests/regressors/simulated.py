"""A made-up simulated set: a sheet that sags with its mass and widens with its stretch. No physics, quick to learn."""

from __future__ import annotations

import numpy as np

from diffcloud.io.simulated import SimulatedSet
from diffcloud.mesh.shapes import grid_cloth


def sagging_sheet(runs: int, *, seed: int = 0, frames: int = 6, scenario: str = "lift") -> SimulatedSet:
    rng = np.random.default_rng(seed)
    mesh = grid_cloth(5, 5, 1.0, 1.0)
    parameters = rng.uniform(0.1, 10, (runs, 2))
    stretch, mass = parameters.T[:, :, None, None]
    phase = np.linspace(0, 1, frames)[None, :, None]
    nodes = np.broadcast_to(mesh.nodes, (runs, frames, *mesh.nodes.shape)).copy()
    nodes[..., 2] -= 0.1 * mass * phase * mesh.nodes[:, 0] ** 2
    nodes[..., 0] *= 1 + 0.1 * stretch * phase
    return SimulatedSet(
        scenario=scenario,
        names=("stretching", "density"),
        bounds=np.array([[0.1, 10.0]] * 2),
        parameters=parameters,
        nodes=nodes.astype(np.float32),
        times=np.linspace(0, 0.5, frames),
        faces=mesh.faces,
        loss_faces=None,
        loss_frame=frames - 1,
        first_frame=0,
        obstacle=None,
        length_unit_m=1.0,
    )
