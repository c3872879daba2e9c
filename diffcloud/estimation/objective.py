"""Loss of parameter sets on one recording: simulate, apply the pose, sample the surface, compare with the clouds.

There are two losses. The default loss compares all usable frames in both directions with capped distances. It omits
simulated points that the cameras could not see, and it is minimised over the pose of the scene (`estimation.pose`), so
solvers see material parameters only. The loss of the paper is one-sided, squared, evaluated at the loss frames, and has
no pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfaceSampler
from diffcloud.errors import ConfigError, DivergedError
from diffcloud.estimation.alignment import aligned
from diffcloud.estimation.inputs import Inputs
from diffcloud.estimation.matching import Matcher, Motion, Pairs, Recorded
from diffcloud.estimation.pose import PoseSpace, clocks_of, default_priors, priors_by_clock
from diffcloud.estimation.targets import read_target, track_displacement
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import Rollout

CAP_M = 0.05
"""Distances are capped at this value [m], so outliers do not pull on the cloth."""
_CHUNK = 20
"""Number of parameter sets that are simulated at once. It bounds the memory for motions and derivatives."""
_FEWEST = 200
"""Minimum number of sampled points per frame."""
_NEAR_M = 0.008
"""A cloth layer closer than this [m] does not occlude a point, since a camera cannot separate the two layers."""
_FEW = 5
"""Number of frames for the coarse pose search, before all frames are used."""
_FIRST_CAPS = (np.inf, np.inf, 4.0, 4.0, 2.0, 2.0, *[1.0] * 10)
"""Factors of the distance cap in each step from the zero pose. The first are large, because the cloth may be far from
the recorded points."""
_CAPS = (2.0, *[1.0] * 8)
_LAST_CAPS = (1.0, 1.0)


class Objective:
    """Losses of a batch of parameter sets on one episode."""

    def __init__(
        self,
        scenario: Scenario,
        episode: Episode,
        *,
        paper: bool = False,
        nuisance: Mapping[str, float] | None = None,
        frames: Sequence[int] | None = None,
        points: int | None = None,
        seed: int = 0,
    ) -> None:
        """Read the episode and choose the compared frames and sample points.

        Args:
            paper: use the loss of the paper.
            nuisance: free pose variables -> standard deviation of the prior [m, rad, s]. `lag` applies to every
                camera's clock. Default: the episode's `default_priors`, or none with the loss of the paper.
            frames: frames to compare; negative numbers count from the end. Default: the scenario's, or all usable
                frames.
            points: number of sampled points per frame. Default: the scenario's, which in the default loss is divided
                among the frames.
            seed: seed of the sampled points, which all evaluations share.

        Raises:
            EpisodeError: a loss frame is missing or after the end of the simulation, no frame is usable, or meta is
                damaged.
            ConfigError: a pose variable is unknown, or the loss of the paper is requested with pose variables.
        """
        self.scenario, self.episode, self.paper = scenario, episode, paper
        self.system, _ = scenario.scene.build()
        if nuisance is None:
            nuisance = {} if paper else default_priors(episode)
        self.nuisance = dict(nuisance) if paper else priors_by_clock(nuisance, clocks_of(episode))
        if paper and self.nuisance:
            raise ConfigError(f"The paper's measure knows no pose; leave out the nuisance {', '.join(self.nuisance)}.")
        self._unit = scenario.length_unit_m
        self.cap = torch.inf if paper else CAP_M / self._unit
        self._first: Tensor | None = None
        self.asked_frames = None if frames is None else tuple(frames)
        self.asked_points = points
        beside = torch.as_tensor(scenario.scene.bodies.faces) + len(self.system.mesh.nodes)
        self._faces = torch.cat([torch.as_tensor(self.system.mesh.faces), beside])
        self._bodies = torch.as_tensor(scenario.scene.bodies.nodes, dtype=torch.float64)
        named = scenario.loss_frames if paper or not scenario.every_frame else None
        self._target = read_target(
            scenario,
            self.system,
            episode,
            named if frames is None else frames,
            whole=paper,
            nuisance=self.nuisance,
        )
        self.reseed(seed)
        self.loss_steps = self._steps_to_loss()

    @property
    def members(self) -> tuple[Objective, ...]:
        """Objectives of the single recordings: here only this one, in a `JointObjective` one per recording."""
        return (self,)

    @property
    def length_unit_m(self) -> float:
        return self.scenario.length_unit_m

    @property
    def point_count(self) -> int:
        """Number of points sampled per frame."""
        if self.asked_points is not None:
            return self.asked_points
        share = 1 if self.paper else len(self._target.frames)
        return max(self.scenario.points // share, min(_FEWEST, self.scenario.points))

    @property
    def frames(self) -> tuple[int, ...]:
        """Numbers of the compared frames in the episode, from 0."""
        return self._target.frames

    @property
    def cut(self) -> float | None:
        """Crop height of the recording in scene units, or None. Simulated points below it are omitted."""
        return None if self._target.crop is None else self._target.crop.height

    @property
    def pose_space(self) -> PoseSpace:
        return self._target.space

    @property
    def times(self) -> Tensor:
        """[L] times of the compared frames [s]."""
        return self._target.times

    @property
    def track(self) -> Tensor | None:
        """[1, S, G, 3] gripper displacements up to the last compared frame. None: the scene's own motion."""
        track = self._target.track
        return None if track is None else track[:, : self.loss_steps]

    @property
    def clouds(self) -> tuple[NeighbourIndex, ...]:
        """Recorded clouds of the L compared frames."""
        return self._target.clouds

    def of(self, scenario: Scenario) -> Objective:
        """Return the objective of the same recording for another variant of its scenario."""
        found = Objective(
            scenario,
            self.episode,
            paper=self.paper,
            nuisance=self.nuisance,
            frames=self.frames,
            points=self.asked_points,
            seed=self._seed,
        )
        found.asked_frames = self.asked_frames
        return found

    def reseed(self, seed: int) -> None:
        """Sample new points on the cloth and in the clouds."""
        self._seed = seed
        generator = torch.Generator().manual_seed(seed)
        cloth = torch.as_tensor(self.system.mesh.faces)
        subset = self.scenario.loss_faces if self.paper else None
        self.sampler = SurfaceSampler.build(
            cloth,
            self.point_count,
            generator=generator,
            subset=None if subset is None else torch.as_tensor(subset),
            dtype=torch.float64,
        )
        if self.paper:
            return
        self._recorded = self._drawn(generator)

    def __call__(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return losses [B] in squared length units of the scene, including the pose prior.

        The losses are differentiable. The pose is held fixed, because the loss is already minimal over it.

        Args:
            parameters: name -> [B].

        Raises:
            DivergedError: a simulation diverged; names the step and the batch entries.
        """
        batch = len(next(iter(parameters.values()))) if parameters else 1
        losses = []
        for begin in range(0, batch, _CHUNK):  # each chunk is simulated as one batch
            part = {name: value[begin : begin + _CHUNK] for name, value in parameters.items()}
            try:
                motion = self.match(self.simulate_to_loss(part))
                losses.append(self.losses(motion).mean(-1) * self.pose_space.prior_factor(motion.pose))
            except DivergedError as error:
                entries = [begin + entry for entry in error.entries]
                raise DivergedError(error.step, entries, error.reason, error.parameters) from error
        return torch.cat(losses)

    def simulate_to_loss(self, parameters: Mapping[str, Tensor]) -> Rollout:
        """Simulate up to the last compared frame."""
        return self.simulate(parameters, steps=self.loss_steps)

    def simulate(self, parameters: Mapping[str, Tensor], *, steps: int | None = None) -> Rollout:
        """Simulate parameter sets with the episode's gripper track; by default for all steps of the scenario."""
        return self.inputs(parameters, self.scenario.steps if steps is None else steps).rollout()

    def inputs(self, parameters: Mapping[str, Tensor], steps: int) -> Inputs:
        """Return the simulator inputs of parameter sets, with the episode's gripper track."""
        return Inputs.of(self.scenario, self.system, steps, parameters, self._target.track)

    def frame_losses(self, run: Rollout, *, pose: Tensor | None = None) -> Tensor:
        """Return losses [B, L] of a rollout at each compared frame, at its best pose or at the given poses [B, d]."""
        return self.losses(self.match(run, pose=pose))

    def losses(self, motion: Motion) -> Tensor:
        """Return losses [B, L] of a matched motion at each compared frame."""
        found = [pairs.losses(self._moved(motion, pairs), self.cap) for pairs in motion.pairs]
        return len(self.frames) * torch.stack(found).sum(0)

    def squares(self, motion: Motion) -> Tensor:
        """Return mean squared distances [B, L] of a matched motion at each compared frame, in squared length units."""
        found = [pairs.squares(self._moved(motion, pairs), self.cap) for pairs in motion.pairs]
        return len(self.frames) * torch.stack(found).sum(0)

    def way_squares(self, motion: Motion) -> list[float]:
        """Return the capped mean squared distance of each direction for one matched motion, in squared length units.
        The first value is from simulated to recorded points. The default loss adds the value from recorded points to
        the cloth."""
        return [float(pairs.squares(self._moved(motion, pairs), self.cap).mean() / pairs.share) for pairs in motion.pairs]

    def points(self, run: Rollout, *, pose: Tensor | None = None) -> Tensor:
        """Return points [B, L, N, 3] sampled on a rollout's cloth at the compared frames, in the recording's frame."""
        motion = self.match(run, pose=pose)
        return self._moved(motion, motion.pairs[0])

    def pose(self, run: Rollout) -> Tensor:
        """Return the best poses [B, d] of a rollout. They remain valid if the sample points are resampled."""
        return self.match(run).pose

    def posed_nodes(self, run: Rollout, pose: Tensor, *, steps: bool = False) -> NDArray[np.float64]:
        """Return the cloth nodes [T + 1, V, 3] of a rollout of one motion in the recording's frame.

        Args:
            steps: return every simulation step instead of every frame of the scenario.
        """
        times = run.times[:: 1 if steps else self.scenario.scene.frame_steps]
        return self._target.space.moved_motion(run.at, times, pose).numpy()

    def posed_bodies(self, pose: Tensor) -> NDArray[np.float64]:
        """Return the nodes [V, 3] of the other bodies in the recording's frame."""
        return self._target.space.moved(self._bodies[None], pose)[0].numpy()

    def match(self, run: Rollout, *, pose: Tensor | None = None) -> Motion:
        """Match a rollout to the recording at its pose of lowest loss, or at poses [B, d]."""
        velocities = self.still_bodies(self.velocities(run)) if self.pose_space.moves_clocks else None
        return self.matched(self.with_bodies(self.looked_at(run)), velocities, pose)

    def looked_at(self, run: Rollout) -> Tensor:
        """Return a rollout's nodes [B, L, C · V', 3] at the compared frames, at the offset of each of the C clocks. The
        nodes of one clock follow those of the previous clock."""
        return torch.cat([run.at(self.times + offset) for offset in self.pose_space.clocks.values()], dim=-2)

    def way_to(self, variant: Scenario, parameters: Mapping[str, Tensor], nodes: Tensor) -> Tensor:
        """Return displacements [B, L, C · V, 3] from the given nodes to the nodes of a scenario variant.

        Args:
            variant: scenario with another time step, or with a mesh whose first nodes are those of this scenario.
            nodes: cloth nodes in the layout of `looked_at`.

        Raises:
            DivergedError: the variant's motion diverges.
        """
        system, _ = variant.scene.build()
        steps, track = self.loss_steps * variant.scene.frame_steps // self.scenario.scene.frame_steps, None
        if self.episode.gripper is not None:
            moved = track_displacement(self.episode, system.handles.grippers, steps, system.time_step)
            track = torch.as_tensor(moved)[None]
        there = self.looked_at(Inputs.of(variant, system, steps, parameters, track).rollout())
        clocks = len(self.pose_space.clocks)
        return there.unflatten(-2, (clocks, -1))[..., : nodes.shape[-2] // clocks, :].flatten(-3, -2) - nodes

    def velocities(self, run: Rollout) -> Tensor:
        """Return velocities [B, L, C · V', 3] of the nodes that `looked_at` returns. They are central differences over
        one step to each side. Velocities before the start of the motion are zero."""
        step, last, found = float(run.times[1]), float(run.times[-1]), []
        for offset in self.pose_space.clocks.values():
            before, after = ((self.times + offset + way * step).clamp(0.0, last) for way in (-1, 1))
            found.append((run.at(after) - run.at(before)) / (after - before).clamp(min=1e-9)[:, None, None])
        return torch.cat(found, dim=-2)

    def matched(self, nodes: Tensor, velocities: Tensor | None, pose: Tensor | None) -> Motion:
        """Match nodes [B, L, C · V, 3] and their velocities to the recording, as `match` does. The nodes are at the
        compared frames and include those of the other bodies."""
        with torch.no_grad():
            still = nodes.detach(), None if velocities is None else velocities.detach()
            if pose is None and self.pose_space.names:
                pose, matcher = self._lowest(*still)
            else:
                pose = torch.zeros(len(nodes), 0, dtype=torch.float64) if pose is None else pose
                matcher = self._matcher(*still, range(nodes.shape[1]))
            return replace(matcher(pose), nodes=nodes, velocities=velocities)

    def _lowest(self, nodes: Tensor, velocities: Tensor | None) -> tuple[Tensor, Matcher]:
        """Return the best poses [B, d] and their matcher, starting from the pose of the nominal material. With a free
        scale the loss has several minima in the pose. Then a second search starts at scale 0, and the lower minimum is
        used."""
        space, first = self.pose_space, self._first_pose().expand(len(nodes), -1)
        pose, matcher = self._follow(nodes, velocities, first, _CAPS)
        if "scale" in space.names:
            other, _ = self._follow(nodes, velocities, first * space.unscaled, _CAPS)
            losses = []
            for one in (pose, other):
                losses.append(self.terms(matcher(one))[0] * space.prior_factor(one))
                matcher.look_anew()
            pose = torch.where((losses[1] < losses[0])[:, None], other, pose)
        return pose, matcher

    def _first_pose(self) -> Tensor:
        """Return the best pose [1, d] of the nominal material, searched from the zero pose. The result is cached."""
        if self._first is None:
            self._first = torch.zeros(1, len(self.pose_space.names), dtype=torch.float64)
            with suppress(DivergedError):  # without a nominal motion, all searches start at the zero pose
                run = self.simulate_to_loss({})
                nodes = self.with_bodies(self.looked_at(run))
                self._first, _ = self._follow(nodes, torch.zeros_like(nodes), self._first, _FIRST_CAPS)
                if len(self.pose_space.clocks) > 1 and self.pose_space.moves_clocks:  # clocks may be far off
                    velocities = self.still_bodies(self.velocities(run))
                    self._first, _ = self._follow(nodes, velocities, self._first, _CAPS)
        return self._first

    def _follow(
        self, nodes: Tensor, velocities: Tensor | None, start: Tensor, caps: Sequence[float]
    ) -> tuple[Tensor, Matcher]:
        """Return the poses [B, d] of lowest loss that a search from `start` finds, and a matcher of all frames. The
        search uses a few frames first and then all."""
        space, every = self.pose_space, range(nodes.shape[1])
        few = np.unique(np.linspace(0, len(every) - 1, _FEW).round().astype(int)).tolist()
        pose = start
        for frames, factors in ((few, caps), (every, _LAST_CAPS)):
            matcher = self._matcher(nodes, velocities, frames)

            def terms(
                poses: Tensor, factor: float, entries: Tensor | None, matcher: Matcher = matcher
            ) -> tuple[Tensor, Tensor, Tensor]:
                return self.terms(matcher(poses, entries), factor=factor)

            pose = aligned(space, pose, terms, factors)
        matcher.look_anew()
        return pose, matcher

    def _matcher(self, nodes: Tensor, velocities: Tensor | None, frames: Sequence[int]) -> Matcher:
        """Return a matcher of motions [B, L, C · V, 3] for a subset of the compared frames."""
        chosen, clocks = list(frames), len(self.pose_space.clocks)
        still, moving = nodes[:, chosen], None if velocities is None else velocities[:, chosen]
        return Matcher(
            self._target.at(chosen),
            still,
            moving,
            self.sampler.draw(still[:, :, : still.shape[2] // clocks]),
            self._faces,
            None if self.paper else self._recorded_in(chosen),
            near=_NEAR_M / self._unit,
        )

    def terms(self, motion: Motion, *, factor: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
        """Return the loss [B], half its gradient [B, d] and half its Hessian approximation [B, d, d] in the pose,
        without prior.

        Args:
            factor: factor of the distance cap.
        """
        return motion.terms(self.pose_space, self.cap * factor)

    def columns(self, motion: Motion, rates: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """Return the surface points [B, L, N, 3] of each kind of pair in the recording's frame, and their derivatives.

        The derivatives [k + d, B, L, N, 3] are with respect to the k variables and the d pose variables.

        Args:
            rates: derivatives [k, B, L, C · V', 3] of the cloth nodes with respect to the k variables.
        """
        space = self._target.space
        here = motion.shown(space)
        rates, moved, every = self.still_bodies(rates), [], []
        nodes = here.shape[-2] // len(space.clocks)
        for pairs in motion.pairs:
            clock = pairs.places.nodes[..., 0] // nodes
            points = pairs.places.of(here)
            velocities = None if motion.velocities is None else pairs.places.of(motion.velocities)
            own = [space.carried(pairs.places.of(rate), motion.pose) for rate in rates]
            moved.append(space.moved(points, motion.pose))
            every.append(torch.cat([torch.stack(own), space.rates(points, motion.pose, velocities, clock)]))
        return moved, every

    def earliest(self, counts: Sequence[int]) -> Objective:
        """Return the same objective restricted to its earliest compared frames.

        Args:
            counts: a single number of frames. A `JointObjective` takes one number per recording.
        """
        (count,) = counts
        found, chosen = copy(self), sorted(self.times.argsort(stable=True)[:count].tolist())
        found._target, found._first = self._target.at(chosen), None
        found.asked_frames = found.frames
        found.reseed(self._seed)
        found.loss_steps = found._steps_to_loss()
        return found

    def with_bodies(self, positions: Tensor) -> Tensor:
        """Append the nodes of the other bodies to cloth nodes [..., C · V', 3]; the loss of the paper has none."""
        return self._beside(positions, self._bodies)

    def still_bodies(self, rates: Tensor) -> Tensor:
        """Append zeros for the other bodies to derivatives [..., C · V', 3] of the cloth nodes."""
        return self._beside(rates, torch.zeros_like(self._bodies))

    def _beside(self, cloth: Tensor, bodies: Tensor) -> Tensor:
        if self.paper or not len(bodies):
            return cloth
        views = cloth.unflatten(-2, (len(self.pose_space.clocks), -1))
        return torch.cat([views, bodies.expand(*views.shape[:-2], -1, -1)], dim=-2).flatten(-3, -2)

    def _recorded_in(self, chosen: list[int]) -> Recorded:
        whole = self._recorded
        return Recorded(whole.points[chosen], whole.sure[chosen], whole.counts)

    def _steps_to_loss(self) -> int:
        space = self._target.space
        last = float(self._target.times.max()) + max(space.clocks.values())
        steps = int(np.ceil(last / self.system.time_step - 1e-6)) + space.moves_clocks  # central differences need one more
        return min(max(steps, 1), self.scenario.steps)

    def _moved(self, motion: Motion, pairs: Pairs) -> Tensor:
        space = self._target.space
        return space.moved(pairs.places.of(motion.shown(space)), motion.pose)

    def _drawn(self, generator: torch.Generator) -> Recorded:
        """Sample the recorded points that are compared with the cloth, about as many as simulated points. Each clock
        has the same number of points in every frame, at least one. Their weights correct for the clock's share of the
        frame's points."""
        target = self._target
        every = np.array([[len(of) if of.any() else 0 for of in sure] for sure in target.sure])  # [C, L]
        counts = np.maximum(np.floor(self.point_count * every.sum(1) / every.sum()).astype(int), 1)
        counts[0] = max(self.point_count - counts[1:].sum(), 1)
        shares = every / every.sum(0) / (counts / counts.sum())[:, None]
        points, sure = [], []
        for frame, whole in enumerate(target.clouds):
            for clock, count in enumerate(counts):
                cloud = target.views[clock][frame] if every[clock, frame] else whole  # these points get zero weight
                index = torch.randint(len(cloud.points), (int(count),), generator=generator)
                points.append(cloud.points[index])
                weights = target.sure[clock][frame] if every[clock, frame] else torch.zeros(len(whole.points)).double()
                sure.append(shares[clock, frame] * weights[index])
        frames = len(target.clouds)
        return Recorded(
            torch.cat(points).unflatten(0, (frames, -1)), torch.cat(sure).unflatten(0, (frames, -1)), tuple(counts.tolist())
        )
