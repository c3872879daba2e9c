"""Cloth displacement between neighbouring parameter sets, compared with what a camera can resolve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.estimation.targets import track_displacement
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import rollout


@dataclass(frozen=True)
class VisibilityMap:
    """Displacements on a grid of stretching (rows) and density (columns) multipliers."""

    grid: NDArray[np.float64]
    """[n] multipliers of both parameters."""
    along_stretching_mm: NDArray[np.float64]
    """[n - 1, n] RMS node distance between neighbours in stretching [mm]."""
    along_density_mm: NDArray[np.float64]
    """[n, n - 1] RMS node distance between neighbours in density [mm]."""

    def visible_fraction(self, noise_mm: float) -> float:
        """Return the fraction of neighbouring pairs that differ by more than the noise."""
        pairs = np.concatenate([self.along_stretching_mm.ravel(), self.along_density_mm.ravel()])
        return float((pairs > noise_mm).mean())


def visibility_map(
    scenario: Scenario, *, episode: Episode | None = None, size: int = 5, linear: bool = False
) -> VisibilityMap:
    """Simulate a grid of multipliers from 0.1 to 10 and compare neighbouring motions.

    Only nodes of the loss surface are compared. Without an episode, the first loss frame of the scenario's own motion
    is used. With an episode, all frames of the motion with its gripper track are used.

    Args:
        size: number of grid points along each axis.
        linear: space the multipliers linearly instead of logarithmically.

    Raises:
        EpisodeError: the episode has no gripper track.
    """
    grid = np.linspace(0.1, 10, size) if linear else np.logspace(-1, 1, size)
    stretch, mass = (torch.as_tensor(axis.ravel()) for axis in np.meshgrid(grid, grid, indexing="ij"))
    system, _ = scenario.scene.build()
    properties = scenario.properties(system, {"stretching": stretch, "density": mass})
    per_frame = scenario.scene.frame_steps
    if episode is None:
        steps, track = scenario.loss_frames[0] % (scenario.frames + 1) * per_frame, None
        first = steps
    elif episode.gripper is None:
        raise EpisodeError("The episode has no gripper track: leave it out to test the scenario's own motion.")
    else:
        frames = min(scenario.frames, int(np.ceil(episode.times[-1] / scenario.scene.frame_time - 1e-6)))
        steps, first = frames * per_frame, per_frame
        track = torch.as_tensor(track_displacement(episode, system.handles.grippers, steps, system.time_step))
        track = track.expand(size * size, *track.shape)
    with torch.no_grad():
        run = rollout(system, steps, properties=properties, track=track)
    faces = system.mesh.faces if scenario.loss_faces is None else system.mesh.faces[scenario.loss_faces]
    nodes = run.positions[:, first::per_frame, np.unique(faces)].numpy().reshape(size, size, -1, 3)

    def distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        rms: NDArray[np.float64] = 1e3 * scenario.length_unit_m * np.sqrt(((a - b) ** 2).sum(-1).mean(-1))
        return rms

    return VisibilityMap(grid, distance(nodes[1:], nodes[:-1]), distance(nodes[:, 1:], nodes[:, :-1]))
