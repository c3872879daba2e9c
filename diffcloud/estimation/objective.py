"""The loss of parameter sets on a recording: simulate, lay the scene as it lies, sample, compare with its clouds.

There are two measures. The default one compares every usable frame in both directions, each distance capped, counts
simulated points only where the recording could have some, and takes the lowest loss over the pose of the scene
(`estimation.pose`), so that solvers see parameters alone. The paper's is one-sided and squared, at the loss frames, and
knows no pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
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
"""A larger distance counts as this one."""
_CHUNK = 20
"""Parameter sets whose motions, derivatives and sampled clouds are in memory at the same time."""
_FEWEST = 200
"""Points of a frame, however many frames share the scenario's."""
_NEAR_M = 0.008
"""A layer of cloth that lies so close over another does not hide it: a camera sees both as one."""
_FEW = 5
"""Frames by which a pose is found before all have their say."""
_FIRST_CAPS = (np.inf, np.inf, 4.0, 4.0, 2.0, 2.0, *[1.0] * 10)
"""Factors of the cap in the steps from no pose at all: a cloth that lies elsewhere is far from all that was recorded."""
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
        """
        Args:
            paper: the published measure.
            nuisance: free variables of the pose, with the standard deviations of their priors [m, rad, s]; by default
                the episode's `default_priors`, in the paper's measure none. `lag` is that of every camera's clock.
            frames: to compare; negative ones count from the end. By default every usable one, unless the scenario names
                some.
            points: sampled per frame; by default the scenario's, which all frames share in the default measure.
            seed: of the common random numbers.

        Raises:
            EpisodeError: a loss frame that an episode lacks, one after the end of the simulation, none that is usable, or
                a damaged meta.
            ConfigError: an unknown variable of the pose, or any in the paper's measure.
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
        """This one alone; of a `JointObjective` one for each recording."""
        return (self,)

    @property
    def length_unit_m(self) -> float:
        return self.scenario.length_unit_m

    @property
    def point_count(self) -> int:
        """Sampled per frame."""
        if self.asked_points is not None:
            return self.asked_points
        share = 1 if self.paper else len(self._target.frames)
        return max(self.scenario.points // share, min(_FEWEST, self.scenario.points))

    @property
    def frames(self) -> tuple[int, ...]:
        """The compared frames of an episode, from 0."""
        return self._target.frames

    @property
    def cut(self) -> float | None:
        """Height below which nothing was recorded; simulated points do not count there."""
        return self._target.cut

    @property
    def pose_space(self) -> PoseSpace:
        return self._target.space

    @property
    def times(self) -> Tensor:
        """[L] of the compared frames [s]."""
        return self._target.times

    @property
    def track(self) -> Tensor | None:
        """[1, S, G, 3] displacement of the grippers up to the last compared frame [m]; None: the scene's own motion."""
        track = self._target.track
        return None if track is None else track[:, : self.loss_steps]

    @property
    def clouds(self) -> tuple[NeighbourIndex, ...]:
        """The recorded clouds of the L compared frames."""
        return self._target.clouds

    def of(self, scenario: Scenario) -> Objective:
        """The same recording compared with another scenario of it."""
        found = self._anew(scenario, self.frames)
        found.asked_frames = self.asked_frames
        return found

    def _anew(self, scenario: Scenario, frames: Sequence[int]) -> Objective:
        return Objective(
            scenario,
            self.episode,
            paper=self.paper,
            nuisance=self.nuisance,
            frames=frames,
            points=self.asked_points,
            seed=self._seed,
        )

    def reseed(self, seed: int) -> None:
        """Draw the common random numbers anew."""
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
        """Losses [B] in squared length units of the scene, with the prior of the pose. Differentiable, with the pose held
        fixed: it is where this loss is lowest.

        Args:
            parameters: name -> [B].

        Raises:
            DivergedError: names step and batch entries.
        """
        batch = len(next(iter(parameters.values()))) if parameters else 1
        losses = []
        for begin in range(0, batch, _CHUNK):  # nothing inside loops over the batch
            part = {name: value[begin : begin + _CHUNK] for name, value in parameters.items()}
            try:
                motion = self.match(self.simulate_to_loss(part))
                losses.append(self.losses(motion).mean(-1) * self.pose_space.prior_factor(motion.pose))
            except DivergedError as error:
                entries = [begin + entry for entry in error.entries]
                raise DivergedError(error.step, entries, error.reason, error.parameters) from error
        return torch.cat(losses)

    def simulate_to_loss(self, parameters: Mapping[str, Tensor]) -> Rollout:
        """The rollout up to the last compared frame."""
        return self.simulate(parameters, steps=self.loss_steps)

    def simulate(self, parameters: Mapping[str, Tensor], *, steps: int | None = None) -> Rollout:
        """The rollout of parameter sets with an episode's gripper track, by default over the whole scenario."""
        return self.inputs(parameters, self.scenario.steps if steps is None else steps).rollout()

    def inputs(self, parameters: Mapping[str, Tensor], steps: int) -> Inputs:
        """Of parameter sets, with an episode's gripper track."""
        return Inputs.of(self.scenario, self.system, steps, parameters, self._target.track)

    def frame_losses(self, run: Rollout, *, pose: Tensor | None = None) -> Tensor:
        """[B, L] losses of a rollout at each compared frame, at its pose or at poses [B, d]."""
        return self.losses(self.match(run, pose=pose))

    def losses(self, motion: Motion) -> Tensor:
        """[B, L] losses of a matched motion at each compared frame."""
        found = [pairs.losses(self._moved(motion, pairs), self.cap) for pairs in motion.pairs]
        return len(self.frames) * torch.stack(found).sum(0)

    def squares(self, motion: Motion) -> Tensor:
        """[B, L] mean squared distances of a matched motion at each compared frame, in squared length units."""
        found = [pairs.squares(self._moved(motion, pairs), self.cap) for pairs in motion.pairs]
        return len(self.frames) * torch.stack(found).sum(0)

    def way_squares(self, motion: Motion) -> list[float]:
        """Return the capped mean squared distances of one matched motion over all frames, in squared length units. The
        first is from simulated to recorded points; the default measure adds one from recorded points to the cloth."""
        return [float(pairs.squares(self._moved(motion, pairs), self.cap).mean() / pairs.share) for pairs in motion.pairs]

    def points(self, run: Rollout, *, pose: Tensor | None = None) -> Tensor:
        """[B, L, N, 3] points sampled on a rollout's cloth at the compared frames, in the recording's frame."""
        motion = self.match(run, pose=pose)
        return self._moved(motion, motion.pairs[0])

    def pose(self, run: Rollout) -> Tensor:
        """[B, d] the pose of a rollout. It belongs to the motion: where points are drawn anew, it may stay."""
        return self.match(run).pose

    def posed_nodes(self, run: Rollout, pose: Tensor, *, steps: bool = False) -> NDArray[np.float64]:
        """[T + 1, V, 3] the cloth's nodes of a rollout of one motion at every frame of the scenario, or at every step, in
        the recording's frame."""
        times = run.times[:: 1 if steps else self.scenario.scene.frame_steps]
        return self._target.space.moved_motion(run.at, times, pose).numpy()

    def posed_bodies(self, pose: Tensor) -> NDArray[np.float64]:
        """[V, 3] the nodes of the bodies beside the cloth, in the recording's frame."""
        return self._target.space.moved(self._bodies[None], pose)[0].numpy()

    def match(self, run: Rollout, *, pose: Tensor | None = None) -> Motion:
        """Match a rollout to the recording, at its pose of lowest loss or at poses [B, d]."""
        velocities = self.still_bodies(self.velocities(run)) if self.pose_space.moves_clocks else None
        return self.matched(self.with_bodies(self.looked_at(run)), velocities, pose)

    def looked_at(self, run: Rollout) -> Tensor:
        """[B, L, C · V', 3] a rollout's nodes at the compared frames, at the offset of each of the C clocks: those of one
        clock after those of another."""
        return torch.cat([run.at(self.times + offset) for offset in self.pose_space.clocks.values()], dim=-2)

    def way_to(self, variant: Scenario, parameters: Mapping[str, Tensor], nodes: Tensor) -> Tensor:
        """[B, L, C · V, 3] from nodes of the cloth, as `looked_at` has them, to where a variant of the scenario has them.

        Args:
            variant: with other steps, or with a mesh whose first nodes are those of the scenario's.

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
        """[B, L, C · V', 3] velocities of the nodes that `looked_at` returns, by central differences over one step to
        each side. Velocities before the start of the motion are zero."""
        step, last, found = float(run.times[1]), float(run.times[-1]), []
        for offset in self.pose_space.clocks.values():
            before, after = ((self.times + offset + way * step).clamp(0.0, last) for way in (-1, 1))
            found.append((run.at(after) - run.at(before)) / (after - before).clamp(min=1e-9)[:, None, None])
        return torch.cat(found, dim=-2)

    def matched(self, nodes: Tensor, velocities: Tensor | None, pose: Tensor | None) -> Motion:
        """Match nodes and their velocities [B, L, C · V, 3] at the compared frames to the recording, as `match` does. They
        include the nodes of bodies."""
        with torch.no_grad():
            still = nodes.detach(), None if velocities is None else velocities.detach()
            if pose is None and self.pose_space.names:
                pose, matcher = self._lowest(*still)
            else:
                pose = torch.zeros(len(nodes), 0, dtype=torch.float64) if pose is None else pose
                matcher = self._matcher(*still, range(nodes.shape[1]))
            return replace(matcher(pose), nodes=nodes, velocities=velocities)

    def _lowest(self, nodes: Tensor, velocities: Tensor | None) -> tuple[Tensor, Matcher]:
        """As of `_follow`, from the pose of the nominal material. With a scale, poses have several minima: then the lower
        one of two, reached from the nominal material's scale and from none."""
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
        """[1, d] of the nominal material, from zero on."""
        if self._first is None:
            self._first = torch.zeros(1, len(self.pose_space.names), dtype=torch.float64)
            with suppress(DivergedError):  # then steps begin at zero, whatever the parameters
                run = self.simulate_to_loss({})
                nodes = self.with_bodies(self.looked_at(run))
                self._first, _ = self._follow(nodes, torch.zeros_like(nodes), self._first, _FIRST_CAPS)
                if len(self.pose_space.clocks) > 1 and self.pose_space.moves_clocks:  # may be far off their offsets
                    velocities = self.still_bodies(self.velocities(run))
                    self._first, _ = self._follow(nodes, velocities, self._first, _CAPS)
        return self._first

    def _follow(
        self, nodes: Tensor, velocities: Tensor | None, start: Tensor, caps: Sequence[float]
    ) -> tuple[Tensor, Matcher]:
        """[B, d] poses of lowest loss of nodes [B, L, C · V, 3], from a start on, on a few frames and then on all; and what
        matches all of them there."""
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
        """Of motions [B, L, C · V, 3] at some of the compared frames."""
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
        """Loss [B], half of its slope [B, d] and curvature [B, d, d] by the pose, without its prior.

        Args:
            factor: of the cap.
        """
        return motion.terms(self.pose_space, self.cap * factor)

    def columns(self, motion: Motion, rates: Tensor) -> tuple[list[Tensor], list[Tensor]]:
        """For each kind of pairs, where its places lie in the recording [B, L, N, 3], and their rates [k + d, B, L, N, 3].

        Args:
            rates: [k, B, L, C · V', 3] of the cloth's nodes by k variables.
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
        """The same on its earliest compared frames.

        Args:
            counts: one number, of these; a `JointObjective` takes one for each recording.
        """
        (count,) = counts
        chosen = sorted(self.times.argsort(stable=True)[:count].tolist())
        return self._anew(self.scenario, [self.frames[each] for each in chosen])

    def with_bodies(self, positions: Tensor) -> Tensor:
        """[..., C · V', 3] nodes of the cloth -> with those of the bodies beside it, in the default measure."""
        return self._beside(positions, self._bodies)

    def still_bodies(self, rates: Tensor) -> Tensor:
        """[..., C · V', 3] derivatives of the cloth's nodes -> with those of the bodies, which stand still."""
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
        steps = int(np.ceil(last / self.system.time_step - 1e-6)) + space.moves_clocks  # a velocity has two sides
        return min(max(steps, 1), self.scenario.steps)

    def _moved(self, motion: Motion, pairs: Pairs) -> Tensor:
        space = self._target.space
        return space.moved(pairs.places.of(motion.shown(space)), motion.pose)

    def _drawn(self, generator: torch.Generator) -> Recorded:
        """Recorded points that look for the cloth, as many as there are sampled ones, at least one of each clock: in every
        frame the same number of a clock, which count as much as their share of the frame's points."""
        target = self._target
        every = np.array([[len(of) if of.any() else 0 for of in sure] for sure in target.sure])  # [C, L]
        counts = np.maximum(np.floor(self.point_count * every.sum(1) / every.sum()).astype(int), 1)
        counts[0] = max(self.point_count - counts[1:].sum(), 1)
        shares = every / every.sum(0) / (counts / counts.sum())[:, None]
        points, sure = [], []
        for frame, whole in enumerate(target.clouds):
            for clock, count in enumerate(counts):
                cloud = target.views[clock][frame] if every[clock, frame] else whole  # whose points do not count here
                index = torch.randint(len(cloud.points), (int(count),), generator=generator)
                points.append(cloud.points[index])
                weights = target.sure[clock][frame] if every[clock, frame] else torch.zeros(len(whole.points)).double()
                sure.append(shares[clock, frame] * weights[index])
        frames = len(target.clouds)
        return Recorded(
            torch.cat(points).unflatten(0, (frames, -1)), torch.cat(sure).unflatten(0, (frames, -1)), tuple(counts.tolist())
        )
