"""The loss of parameter sets: simulate, sample, one-sided Chamfer to the recorded clouds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffcloud.clouds.losses import one_sided_chamfer
from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfaceSampler
from diffcloud.errors import DivergedError, EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import Rollout, rollout

_CHUNK = 20
"""Parameter sets whose motions, derivatives and sampled clouds are in memory at the same time."""


@dataclass(frozen=True)
class _Target:
    """One episode's clouds in the loss."""

    times: Tensor
    """[L] of the loss frames [s]."""
    clouds: tuple[NeighbourIndex, ...]
    centre: Tensor
    """[3] about which the yaw of the offset turns."""
    track: Tensor | None
    """[1, S, G, 3] displacement of the grippers."""


class Objective:
    """Losses of a batch of parameter sets on one or several episodes of one scenario."""

    def __init__(
        self,
        scenario: Scenario,
        episodes: Sequence[Episode],
        *,
        frames: Sequence[int] | None = None,
        points: int | None = None,
        seed: int = 0,
    ) -> None:
        """
        Args:
            episodes: one, or several for a joint fit; their losses are averaged.
            frames: loss frames instead of the scenario's; negative ones count from the end.
            points: sampled per frame instead of the scenario's.
            seed: of the common random numbers.

        Raises:
            EpisodeError: a loss frame that an episode lacks, or one after the end of the simulation.
        """
        self.scenario = scenario
        self.system, _ = scenario.scene.build()
        self.frames = tuple(scenario.loss_frames if frames is None else frames)
        self.point_count = points or scenario.points
        self.reseed(seed)
        self._targets = [self._target(episode) for episode in episodes]
        last = max(float(target.times.max()) for target in self._targets)
        self.loss_steps = min(int(np.ceil(last / self.system.time_step - 1e-6)), scenario.steps)

    @property
    def episode_count(self) -> int:
        return len(self._targets)

    def reseed(self, seed: int) -> None:
        """Draw the common random numbers anew."""
        subset = self.scenario.loss_faces
        self.sampler = SurfaceSampler.build(
            torch.as_tensor(self.system.mesh.faces),
            self.point_count,
            generator=torch.Generator().manual_seed(seed),
            subset=None if subset is None else torch.as_tensor(subset),
            dtype=torch.float64,
        )

    def __call__(self, parameters: Mapping[str, Tensor], offset: Mapping[str, Tensor] | None = None) -> Tensor:
        """Losses [B] in squared length units of the scene, differentiable.

        Args:
            parameters: name -> [B].
            offset: name -> [B] rigid offset of the target (see `parameters.NUISANCE`).

        Raises:
            DivergedError: names step and batch entries.
        """
        batch = len(next(iter(parameters.values()))) if parameters else 1
        losses = []
        for begin in range(0, batch, _CHUNK):  # nothing inside loops over the batch
            part = {name: value[begin : begin + _CHUNK] for name, value in parameters.items()}
            shift = {name: value[begin : begin + _CHUNK] for name, value in (offset or {}).items()}
            try:
                terms = [self._loss(index, part, shift) for index in range(len(self._targets))]
            except DivergedError as error:
                entries = [begin + entry for entry in error.entries]
                raise DivergedError(error.step, entries, error.reason, error.parameters) from error
            losses.append(torch.stack(terms).mean(0))
        return torch.cat(losses)

    @property
    def residual_count(self) -> int:
        """M points of all episodes and loss frames."""
        return self.episode_count * len(self.frames) * self.point_count

    def simulate_to_loss(self, parameters: Mapping[str, Tensor], *, episode: int = 0) -> Rollout:
        """The rollout up to the last loss frame."""
        return self.simulate(parameters, episode=episode, steps=self.loss_steps)

    def simulate(self, parameters: Mapping[str, Tensor], *, episode: int = 0, steps: int | None = None) -> Rollout:
        """The rollout of parameter sets with an episode's gripper track, by default over the whole scenario."""
        steps = self.scenario.steps if steps is None else steps
        properties = self.scenario.properties(self.system, parameters)
        track = self._targets[episode].track
        track = None if track is None else track[:, :steps]
        return rollout(self.system, steps, properties=properties, track=track)

    def points(self, run: Rollout, offset: Mapping[str, Tensor] | None = None, *, episode: int = 0) -> Tensor:
        """[B, L, N, 3] points sampled on a rollout's cloth at the times of the loss frames.

        Args:
            offset: name -> [B] rigid offset of the target, by which the points are displaced.
        """
        return self.points_of(run.at(self.times(episode)), offset, episode=episode)

    def points_of(self, positions: Tensor, offset: Mapping[str, Tensor] | None = None, *, episode: int = 0) -> Tensor:
        """The same of node positions [B, L, V, 3]."""
        points = self.sampler.sample(positions)
        return _displaced(points, self._targets[episode].centre, offset) if offset else points

    def times(self, episode: int) -> Tensor:
        """[L] of the loss frames [s]."""
        return self._targets[episode].times

    def track(self, episode: int) -> Tensor | None:
        """[1, S, G, 3] displacement of the grippers up to the last loss frame [m]; None: the scene's own motion."""
        track = self._targets[episode].track
        return None if track is None else track[:, : self.loss_steps]

    def clouds(self, *, episode: int = 0) -> tuple[NeighbourIndex, ...]:
        """The recorded clouds of the L loss frames."""
        return self._targets[episode].clouds

    def frame_losses(self, run: Rollout, offset: Mapping[str, Tensor] | None = None, *, episode: int = 0) -> Tensor:
        """[B, L] one-sided Chamfer loss of a rollout at each loss frame."""
        points = self.points(run, offset, episode=episode)
        clouds = self.clouds(episode=episode)
        return torch.stack([one_sided_chamfer(points[:, index], cloud) for index, cloud in enumerate(clouds)], dim=-1)

    def _loss(self, episode: int, parameters: Mapping[str, Tensor], offset: Mapping[str, Tensor]) -> Tensor:
        run = self.simulate_to_loss(parameters, episode=episode)
        return self.frame_losses(run, offset, episode=episode).mean(-1)

    def _target(self, episode: Episode) -> _Target:
        system = self.system
        times, clouds = [], []
        for frame in self.frames:
            cloud = episode.frame(frame)
            times.append(episode.times[frame])
            clouds.append(NeighbourIndex(torch.as_tensor(cloud, dtype=torch.float64)))
        end = self.scenario.steps * system.time_step
        if max(times) > end + 0.5 * self.scenario.scene.frame_time:
            raise EpisodeError(
                f"A loss frame lies at {max(times):.3f} s, but scenario {self.scenario.name} simulates only {end:.3f} s. "
                "Use a scenario with more frames, or another loss frame."
            )
        track = None
        if episode.gripper is not None:
            track = torch.as_tensor(
                track_displacement(episode, system.handles.grippers, self.scenario.steps, system.time_step),
                dtype=torch.float64,
            )[None]
        centre = torch.cat([cloud.points for cloud in clouds]).mean(0)
        return _Target(torch.as_tensor(np.array(times), dtype=torch.float64), tuple(clouds), centre, track)


def track_displacement(episode: Episode, grippers: Sequence[str], steps: int, time_step: float) -> np.ndarray:
    """[S, G, 3] displacement of the scene's grippers since time zero at the end of each step [m].

    A cubic spline through the recorded positions, constant after the last. Recorded positions begin with the motion: a
    track whose first frame is later than time zero is held at its first position until then.

    Raises:
        EpisodeError: other grippers were recorded than the scene has. (A single one needs no name.)
    """
    assert episode.gripper is not None
    if len(grippers) == len(episode.grippers) == 1:
        recorded = [0]
    elif set(grippers) == set(episode.grippers):
        recorded = [episode.grippers.index(name) for name in grippers]
    else:
        raise EpisodeError(
            f"The scene's grippers are {', '.join(grippers) or 'none'}, the episode's {', '.join(episode.grippers)}; give "
            "both the same names, in the scenario's `grippers` or in the tracks that are imported."
        )
    if len(episode.times) < 2:
        return np.zeros((steps, len(grippers), 3))
    times, positions = episode.times, episode.gripper[:, recorded]
    at = np.clip(np.cumsum(np.full(steps, time_step)), times[0], times[-1])
    from scipy.interpolate import CubicSpline  # slow to import, and needed for recorded grippers alone

    return np.asarray(CubicSpline(times, positions)(at) - positions[0])


def _displaced(points: Tensor, centre: Tensor, offset: Mapping[str, Tensor]) -> Tensor:
    """Displace the simulated points as the recorded cloud is displaced; so the target's search tree stays as it is.

    Turned by the yaw about the target's centre, then shifted.
    """
    zero = torch.zeros_like(next(iter(offset.values())))
    shift = torch.stack([offset.get(name, zero) for name in ("offset_x", "offset_y", "offset_z")], dim=-1)
    yaw = offset.get("offset_yaw", zero)
    cos, sin, one = yaw.cos(), yaw.sin(), torch.ones_like(yaw)
    turn = torch.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], dim=-1).unflatten(-1, (3, 3))  # for row vectors
    return (points - centre) @ turn[:, None] + (centre + shift)[:, None, None]
