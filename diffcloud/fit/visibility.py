"""How far neighbouring parameter sets drive the cloth apart: what a camera could tell from one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import rollout


@dataclass(frozen=True)
class VisibilityMap:
    """A grid of stretch (rows) x mass (columns) multipliers."""

    grid: NDArray[np.float64]
    """[n] multipliers of both axes."""
    along_stretch_mm: NDArray[np.float64]
    """[n - 1, n] RMS node distance between neighbours in stretch [mm]."""
    along_mass_mm: NDArray[np.float64]
    """[n, n - 1]"""

    def visible_fraction(self, noise_mm: float) -> float:
        """Part of all neighbouring pairs that differ by more than the noise."""
        pairs = np.concatenate([self.along_stretch_mm.ravel(), self.along_mass_mm.ravel()])
        return float((pairs > noise_mm).mean())


def visibility_map(scenario: Scenario, *, size: int = 5, linear: bool = False) -> VisibilityMap:
    """Simulate the grid over the bounds [0.1, 10]² and compare neighbours at the first loss frame.

    Only nodes of the loss surface count.
    """
    grid = np.linspace(0.1, 10, size) if linear else np.logspace(-1, 1, size)
    stretch, mass = (torch.as_tensor(axis.ravel()) for axis in np.meshgrid(grid, grid, indexing="ij"))
    system, _ = scenario.scene.build()
    properties = scenario.properties(system, {"stretch": stretch, "mass": mass})
    frame = scenario.loss_frames[0] % (scenario.frames + 1)
    with torch.no_grad():
        run = rollout(system, frame * scenario.scene.frame_steps, properties=properties)
    faces = system.mesh.faces if scenario.loss_faces is None else system.mesh.faces[scenario.loss_faces]
    nodes = run.positions[:, -1, np.unique(faces)].numpy().reshape(size, size, -1, 3)

    def distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        rms: NDArray[np.float64] = 1e3 * scenario.length_unit_m * np.sqrt(((a - b) ** 2).sum(-1).mean(-1))
        return rms

    return VisibilityMap(grid, distance(nodes[1:], nodes[:-1]), distance(nodes[:, 1:], nodes[:, :-1]))
