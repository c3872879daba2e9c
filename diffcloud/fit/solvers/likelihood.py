"""The parameters of a cloth and how well its recordings show them, for a model that cannot predict all of a motion.

A frame t has a mean squared distance m from simulated to recorded points and another from recorded to simulated ones. Each
has a variance v that is known: noise and spacing of the points, one squared millimetre, and the squared half of what a mesh
of half the edge length changes there. What the model lacks beside that is not known, so each frame has a factor s >= 1 on
its variances, which the likelihood chooses. With c the mean of m / v over both ways, s = max(1, c), and

    Φ = Σ_t n (log v_t + ρ(c_t)) + prior,      ρ(c) = c up to 1, 1 + log c above,

is twice the negative logarithm of the likelihood of n independent residuals a frame, and of the priors. Errors of a model
are correlated over a cloth, so n is far below the number of points.

After some time nobody can predict which fold forms: there, derivatives explode. Frames count up to a horizon, where the
finer mesh and the given one part. The finer mesh also corrects the positions: its difference to the given mesh is added to
the simulated nodes. What half of that difference would change is a part of the uncertainty.

The variables are those of the space, the pose of each recording, and the size of the grasp where that is not known. What
the grasp's size changes is interpolated between three sizes; the first start tells which ones. Gauss and Newton's steps,
bounded in each variable, go from three starts; the answers are weighed by their likelihoods.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import DivergedError, SceneError
from diffcloud.fit.bounded import lowest_within
from diffcloud.fit.joint import AnyObjective
from diffcloud.fit.matching import Pairs
from diffcloud.fit.names import plain_name
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.residuals import Axis, moved_by
from diffcloud.fit.solvers.outcome import FitHistory, FitOutcome, Progress
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.threads import map_threads

INDEPENDENT = 10.0
"""Residuals of a frame that count as independent, of frames a tenth of a second apart."""
_FRAME_S = 0.1
"""Frames that are closer share these."""
_MODEL_M = 0.001
"""What no simulator of cloth predicts better."""
_PART_M, _GONE_M = 0.004, 0.010
"""Difference to the finer mesh, RMS over the nodes, at which the horizon is: after `_LEAST_S`, and before it."""
_LEAST_S = 1.2
"""A first guess of the material may part too early."""
_START = math.log(4.5)
"""Between starts, in the logarithm of the stretching."""
_RADIUS = 1.0
"""Of a step, in each variable."""
_SMALL = 0.25
"""A step this small ends a descent, in standard deviations."""
_FEWEST_STEPS = 3
"""Of a descent."""
_RISE = 0.02
"""By which Φ may rise, for each independent residual."""
_HALVINGS = 3
_REFRESH = 1.0
"""Standard deviations after which the finer mesh is simulated anew."""
_NARROW = 0.05
"""Least bound on a step, where a start diverges or rises."""
_GAINS, _BEHIND = 3.0, 20.0
"""A start ends where so many times what its next step promises would leave its Φ so far above the best."""
_TINY = 1e-12
_EDGE = 1e-6
"""Distance from a bound, where nothing would pull back."""
_FAR = 100.0
"""Bound on a pose, in deviations."""
_FAR_GRIP = 2.0
"""And on the size of a grasp: what it changes is known in between -1 and 1."""
_REGRIP = 0.3
"""From there on, it is simulated with the size that the first start has found."""


@dataclass(frozen=True)
class LikelihoodSettings:
    """Of one fit."""

    iterations: int = 12
    """Steps of each start at most."""
    starts: int = 3
    """Descents: from the centres of the priors, then with the first variable, the stretching, above and below."""
    seed: int = 0
    """Of the points that are drawn."""
    init: Mapping[str, float] = field(default_factory=dict)
    """Values of the first start."""


@dataclass(frozen=True)
class Frames:
    """What one recording says at one place: L frames, forth and back, k variables of the motion and d of the pose."""

    squares: Tensor
    """[2, L] mean squared distances."""
    slopes: Tensor
    """[2, L, k + d] half of their slopes."""
    curvatures: Tensor
    """[2, L, k + d, k + d] half of their Gauss–Newton matrices."""
    shifted: Tensor
    """[2, L, k + d] by which half of the slopes change if the nodes move by what was asked for."""
    variances: Tensor
    """[2, L] that are known."""

    @property
    def misfits(self) -> Tensor:
        """[L] mean squares over known variances, c."""
        return (self.squares / self.variances).mean(0)

    @property
    def weights(self) -> Tensor:
        """[2, L] slope of Φ by the mean squares, for one independent residual."""
        return 0.5 / (self.variances * self.misfits.clamp(min=1.0))

    def energy(self) -> float:
        """Φ for one independent residual a frame, but for a constant."""
        c = self.misfits
        return float((self.variances.log().mean(0) + torch.where(c < 1, c, 1 + c.clamp(min=1e-9).log())).sum())


@dataclass(frozen=True)
class Answer:
    """Where one start ended."""

    place: Tensor
    """[K] variables of the space on their axis; then the pose of each recording and, last, the size of the grasp where it
    is not known, in deviations of their priors."""
    covariance: Tensor
    """[K, K]"""
    sources: Mapping[str, Tensor]
    """Source -> its part of the covariance [K, K]."""
    energy: float
    """Φ"""
    converged: bool
    misfits: tuple[list[float], ...]
    """Of each recording, c of its frames."""
    apart_m: tuple[list[float], ...]
    """Of each recording, how far the finer mesh is in its frames, RMS over the nodes."""
    trace: tuple[tuple[float, Tensor], ...]
    """Mean squared distance and place at each step."""


@dataclass(frozen=True)
class Estimate:
    """A fit of one or several recordings."""

    space: FitSpace
    answers: tuple[Answer, ...]
    """Of all starts that were followed to their end, the likeliest first."""
    members: tuple[Objective, ...]
    """The recordings up to their horizons, with the grasp that was found."""
    grip: float | None
    """Of these, in deviations from the size that was given; None: it is known."""
    simulations: int
    interrupted: bool = False

    @property
    def best(self) -> Answer:
        return self.answers[0]

    @property
    def weights(self) -> NDArray[np.float64]:
        """[A] of the answers, by their likelihoods."""
        energies = np.array([one.energy for one in self.answers])
        found = np.exp(-0.5 * (energies - energies.min()))
        return np.asarray(found / found.sum())

    @property
    def mean(self) -> Tensor:
        """[K] of the mixture of all answers."""
        return torch.from_numpy(self.weights) @ torch.stack([one.place for one in self.answers])

    @property
    def sources(self) -> dict[str, Tensor]:
        """Source -> its part of the mixture's covariance [K, K]; `starts` is what the answers differ by."""
        apart, mean = torch.zeros_like(self.best.covariance), self.mean
        found = {name: torch.zeros_like(apart) for name in self.best.sources}
        for weight, one in zip(self.weights.tolist(), self.answers, strict=True):
            apart += weight * torch.outer(one.place - mean, one.place - mean)
            for name, part in one.sources.items():
                found[name] += weight * part
        return {**found, "starts": apart}

    @property
    def covariance(self) -> Tensor:
        """[K, K] of the mixture."""
        return torch.stack([*self.sources.values()]).sum(0)

    @property
    def values(self) -> dict[str, float]:
        """Of the likeliest answer."""
        axis = Axis.of(self.space)
        return dict(zip(self.space.names, axis.bounded(self.best.place[: len(self.space.names)]).tolist(), strict=True))


def _regripped(scenario: Scenario) -> list[Scenario]:
    """With a smaller grasp and, where its pad fits and holds the same nodes, a larger one; none where its size is known, or
    no smaller pad fits on the mesh."""
    if scenario.regrip is None:
        return []
    found = list[Scenario]()
    try:
        found.append(scenario.regrip(-1.0))
        larger = scenario.regrip(1.0)
    except SceneError:
        return found
    return [*found, larger] if larger.scene.handles.nodes == scenario.scene.handles.nodes else found


class _Recording:
    """One recording up to its horizon, on the given mesh and the finer one."""

    def __init__(self, objective: Objective, space: FitSpace, columns: Tensor, first_pose: int, grip: int) -> None:
        """
        Args:
            space: of this recording, and the places of its variables among all.
            first_pose: place of the first variable of its pose.
            grip: place of the grasp's size.
        """
        self.objective, self.space, self.axis = objective, space, Axis.of(space)
        poses = len(objective.pose_space.names)
        self.regripped, self.grip = _regripped(objective.scenario), grip
        of_grip = [grip] if self.regripped else []
        self.columns = torch.cat([columns, torch.tensor(of_grip, dtype=torch.long), first_pose + torch.arange(poses)])
        self.motion = columns
        self.poses = slice(first_pose, first_pose + poses)
        unit = objective.length_unit_m
        self.known = torch.tensor([cloud.from_surface for cloud in objective.clouds], dtype=torch.float64).T
        self.known = self.known + (_MODEL_M / unit) ** 2
        self.finer = objective.scenario.finer()
        times = objective.times.sort().values
        gap = float(times.diff().median()) if len(times) > 1 else _FRAME_S
        self.independent = INDEPENDENT * min(1.0, gap / _FRAME_S)

    def parameters(self, place: Tensor) -> dict[str, Tensor]:
        return self.space.parameters(self.axis.bounded(place[None, self.motion]))

    def nodes(self, place: Tensor) -> Tensor:
        """[1, L, C · V, 3] of the cloth in the scene."""
        return self.objective.looked_at(self.objective.simulate_to_loss(self.parameters(place)))

    def change(self, place: Tensor, nodes: Tensor, variant: Scenario) -> Tensor:
        """[1, L, C · V, 3] by which a variant of the scenario moves the nodes."""
        return self.objective.way_to(variant, self.parameters(place), nodes)


@dataclass(frozen=True)
class _Changes:
    """By how much variants of one scenario move the nodes, [1, L, C · V, 3] each; None: not known."""

    finer: Tensor | None = None
    grip: tuple[Tensor, Tensor] | None = None
    """By a grasp g standard deviations larger, in powers of g: the first and the second one."""


@dataclass(frozen=True)
class _Linear:
    """The motion of one recording at a place, and how it changes."""

    recording: _Recording
    nodes: Tensor
    rates: Tensor
    velocities: Tensor | None

    @staticmethod
    def at(recording: _Recording, place: Tensor) -> _Linear:
        objective = recording.objective
        moved = moved_by(objective, recording.space, place[None, recording.motion])
        velocities = None
        if objective.pose_space.moves_clocks:
            velocities = objective.still_bodies(objective.velocities(moved.run))
        return _Linear(recording, objective.looked_at(moved.run), moved.rates, velocities)

    def frames(self, place: Tensor, changes: _Changes, asked: Tensor | None = None) -> Frames:
        """
        Args:
            asked: [1, L, C · V, 3] of the nodes, whose effect on the slopes is wanted.
        """
        one = self.recording
        objective, space = one.objective, one.objective.pose_space
        pose = (place[one.poses] * space.deviations)[None]
        nodes, rates, shift = self.nodes, self.rates, changes.finer
        if shift is not None:
            nodes = nodes + shift
        if one.regripped:
            first, second = changes.grip or (torch.zeros_like(nodes), torch.zeros_like(nodes))
            off = place[one.grip]
            nodes, rates = nodes + off * first + off**2 * second, torch.cat([rates, (first + 2 * off * second)[None]])
        motion = objective.matched(objective.with_bodies(nodes), self.velocities, pose)
        points, columns = objective.columns(motion, rates)
        views, ways = motion.shown(space), list[tuple[Tensor, Tensor, Tensor, Tensor]]()
        units = torch.cat([torch.ones(len(rates)).double(), space.deviations])[:, None, None, None, None]
        for pairs, at, moves in zip(motion.pairs, points, columns, strict=True):
            normals = pairs.normals
            if normals is None:
                first, second, third = pairs.places.corners(views).unbind(-2)
                normals = torch.linalg.cross(second - first, third - first)
                normals = space.carried(normals / normals.norm(dim=-1, keepdim=True).clamp(min=_TINY), pose)
            moved = None if asked is None else space.carried(pairs.places.of(objective.still_bodies(asked)), pose)
            ways.append(_way(pairs, at - pairs.partners, normals, units * moves, moved, objective.cap))
        squares, slopes, curvatures, shifted = (torch.stack(part) for part in zip(*ways, strict=True))
        variances = one.known if shift is None else one.known + _squared(shift / 2)
        return Frames(squares, slopes, curvatures, shifted, variances)


def _way(
    pairs: Pairs, away: Tensor, normals: Tensor, moves: Tensor, moved: Tensor | None, cap: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One way's parts of `Frames`, the curvature as `fit.matching` has it.

    Args:
        away: [1, L, N, 3] from the recorded points to the simulated ones; likewise the surfaces' normals.
        moves: [K, 1, L, N, 3] of the simulated points by the variables.
        moved: [1, L, N, 3] of them, whose effect on the slopes is wanted.
    """
    across = (away * normals).sum(-1, keepdim=True) * normals
    along = away - across
    along = along / (along.square().sum(-1, keepdim=True) + pairs.spacing[:, None, None].square()).sqrt().clamp(min=_TINY)
    counts = (pairs.weights / pairs.weights.sum(-1, keepdim=True).clamp(min=_TINY))[0]
    squares = away.square().sum(-1)[0]
    near = torch.where(squares < cap**2, counts, 0.0)
    mean = torch.where(counts.sum(-1) > 0, (counts * squares.clamp(max=cap**2)).sum(-1), cap**2)
    slope = torch.einsum("kln,ln->lk", (moves * away).sum(-1)[:, 0], near)
    matrix, shifted = torch.zeros_like(slope)[..., None] * slope[:, None], torch.zeros_like(slope)
    for direction in (normals, along):
        part = (moves * direction).sum(-1)[:, 0]
        matrix = matrix + torch.einsum("aln,bln,ln->lab", part, part, near)
        if moved is not None:
            shifted = shifted + torch.einsum("kln,ln,ln->lk", part, (moved * direction).sum(-1)[0], near)
    return mean, slope, matrix, shifted


def _squared(shift: Tensor) -> Tensor:
    """[L] mean over nodes of a displacement [1, L, N, 3]."""
    return shift[0].square().sum(-1).mean(-1)


def _in_powers(grips: Sequence[Tensor | None]) -> tuple[Tensor, Tensor] | None:
    """What a smaller grasp changes, and maybe a larger one, in powers of its size."""
    known = [one for one in grips if one is not None]
    if not grips or len(known) < len(grips):
        return None
    if len(known) == 1:
        return -known[0], torch.zeros_like(known[0])
    smaller, larger = known
    return (larger - smaller) / 2, (larger + smaller) / 2


class _Likelihood:
    """Φ of all recordings."""

    def __init__(self, objectives: Sequence[Objective], space: FitSpace, iterations: int, grip: float = 0.0) -> None:
        """
        Args:
            grip: of the scenarios, in deviations from the size that was given.
        """
        self.space, self.axis, self.iterations = space, Axis.of(space), iterations
        self.recordings, self.simulations, self.grip = list[_Recording](), 0, grip
        variables = count = len(space.names)
        last = variables + sum(len(one.pose_space.names) for one in objectives)
        for index, objective in enumerate(objectives):
            own, columns = space.of_recording(index)
            self.recordings.append(_Recording(objective, own, columns, count, last))
            count += len(objective.pose_space.names)
        asked = [index for index, one in enumerate(space.variables) if not one.doubtful]
        self.asked = torch.tensor(asked, dtype=torch.long)
        self.changes = [_Changes() for _ in self.recordings]
        self.looked: Tensor | None = None
        """Where these were last found."""
        self.knows_grip = not any(one.regripped for one in self.recordings)
        self.poses = count - variables
        steps, poses = space.prior_steps(), torch.ones(self.poses + (not self.knows_grip), dtype=torch.float64)
        self.precision = torch.cat([torch.where(steps > 0, 1 / steps.square(), 0.0), poses])
        low, high = self.axis.ends
        far = _FAR * poses
        far[self.poses :] = _FAR_GRIP
        self.low, self.high = torch.cat([low + _EDGE, -far]), torch.cat([high - _EDGE, far])
        centres = [0.0 if one.deviation is not None else one.centre for one in space.variables]
        self.centre = torch.cat([self.axis.places(torch.tensor(centres, dtype=torch.float64)), 0 * poses])
        self.centre[count:] = -grip

    def inside(self, place: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(place, self.low), self.high)

    def off_centre(self, place: Tensor) -> Tensor:
        return torch.where(self.precision > 0, place - self.centre, 0.0)

    def horizons(self, place: Tensor) -> tuple[int, ...]:
        """Of each recording, how many of its frames come before the finer mesh parts from the given one."""

        def one(recording: _Recording) -> int:
            change = recording.change(place, recording.nodes(place), recording.finer)
            apart = _squared(change).sqrt() * recording.objective.length_unit_m
            times, order = recording.objective.times.sort(stable=True)
            gone = torch.nonzero(apart[order] > torch.where(times > _LEAST_S, _PART_M, _GONE_M))
            return max(int(gone[0]), 1) if len(gone) else len(apart)

        self.simulations += 2 * len(self.recordings)
        return tuple(map_threads(one, self.recordings))

    def start(self, init: Mapping[str, float], offset: float) -> Tensor:
        """[K] these values, else the centres of the priors, and with the first variable so far off on its axis."""
        place = self.centre.clone()
        for index, name in enumerate(self.space.names):
            if name in init:
                place[index] = self.axis.places(torch.full((len(self.space.names),), init[name]).double())[index]
        place[0] += offset
        place[len(self.space.names) :] = 0.0
        return self.inside(place)


@dataclass(frozen=True)
class _Terms:
    """Φ at a place, and how it changes."""

    energy: float
    slope: Tensor
    """[K] half of it."""
    matrix: Tensor
    """[K, K] half of the Gauss–Newton matrix."""
    square: float
    """Mean squared distance."""

    @cached_property
    def covariance(self) -> Tensor:
        return torch.linalg.inv(self.matrix)

    @property
    def deviations(self) -> Tensor:
        return self.covariance.diagonal().sqrt()


@dataclass(frozen=True)
class _Reached:
    """The last place of a descent that counts."""

    place: Tensor
    linear: list[_Linear]
    terms: _Terms

    @property
    def energy(self) -> float:
        return self.terms.energy


class _Descent:
    """From one start."""

    def __init__(self, likelihood: _Likelihood, place: Tensor, tell: Callable[[int, float, Tensor], None]) -> None:
        """
        Args:
            tell: takes step, mean squared distance, and place.
        """
        self.of, self.place, self._tell = likelihood, place, tell
        self.reached: _Reached | None = None
        self._trace: list[tuple[float, Tensor]] = []

    def run(self, to_beat: float) -> Answer | None:
        """Where it ends; None where it falls behind.

        Args:
            to_beat: Φ of a better answer.
        """
        of, place, radius, tried = self.of, self.place, _RADIUS, 0
        allowed = _RISE * sum(one.independent * len(one.objective.frames) for one in of.recordings)
        for _ in range(of.iterations):
            best = self.reached
            try:
                linear = self._linear(place)
            except DivergedError:
                if best is None:
                    raise
                place, radius = 0.5 * (place + best.place), max(0.5 * radius, _NARROW)
                continue
            if of.looked is None:
                self._look(linear, place)
            terms = self._terms(linear, place)
            if best is not None and terms.energy > best.energy + allowed:
                tried += 1
                if tried > _HALVINGS:
                    break
                place, radius = 0.5 * (place + best.place), max(0.5 * radius, _NARROW)
                continue
            tried = 0
            step = self._step(terms, place, radius)
            if bool((step[of.asked].abs() < radius).all()) and self._stale(terms, place):  # on its way it need not know
                self._look(linear, place)
                terms = self._terms(linear, place)
                step = self._step(terms, place, radius)
            self.reached = _Reached(place, linear, terms)
            self._trace.append((terms.square, place))
            self._tell(len(self._trace), terms.square, place)
            if len(self._trace) >= _FEWEST_STEPS:
                if bool((step.abs() < _SMALL * terms.deviations).all()):
                    return self.answer(converged=True)
                gain = -float(2 * terms.slope @ step + step @ terms.matrix @ step)
                if terms.energy - _GAINS * gain > to_beat + _BEHIND:
                    return None
            place, radius = of.inside(place + step), min(1.5 * radius, _RADIUS)
        return self.answer(converged=False)

    def _step(self, terms: _Terms, place: Tensor, radius: float) -> Tensor:
        box = torch.full_like(place, radius)
        low, high = torch.maximum(-box, self.of.low - place), torch.minimum(box, self.of.high - place)
        return lowest_within(terms.matrix, terms.slope, low, high)

    def _linear(self, place: Tensor) -> list[_Linear]:
        self.of.simulations += len(self.of.recordings)
        return map_threads(lambda one: _Linear.at(one, place), self.of.recordings)

    def _stale(self, terms: _Terms, place: Tensor) -> bool:
        """Whether the finer mesh was last simulated too far away."""
        assert self.of.looked is not None
        away = (place - self.of.looked).abs() / terms.deviations
        return bool((away[self.of.asked] > _REFRESH).any())

    def _look(self, linear: Sequence[_Linear], place: Tensor) -> None:
        """Simulate the finer mesh here, and another grasp."""
        self.of.looked = place

        def look(one: _Linear, old: _Changes) -> _Changes:
            finer = self._changed(one, place, one.recording.finer)
            grips = [self._changed(one, place, other) for other in one.recording.regripped]
            return _Changes(old.finer if finer is None else finer, _in_powers(grips) or old.grip)

        self.of.changes = map_threads(lambda pair: look(*pair), [*zip(linear, self.of.changes, strict=True)])

    def _changed(self, one: _Linear, place: Tensor, variant: Scenario) -> Tensor | None:
        """By how much a variant of the scenario moves the nodes; None where it diverges."""
        self.of.simulations += 1
        try:
            return one.recording.change(place, one.nodes, variant)
        except DivergedError:
            return None

    def _terms(self, linear: Sequence[_Linear], place: Tensor) -> _Terms:
        of, squares = self.of, list[float]()
        off = of.off_centre(place)
        energy, slope, matrix = float((of.precision * off.square()).sum()), of.precision * off, torch.diag(of.precision)
        for one, changes in zip(linear, self.of.changes, strict=True):
            frames, n, columns = one.frames(place, changes), one.recording.independent, one.recording.columns
            energy += n * frames.energy()
            weights = n * frames.weights
            slope[columns] += torch.einsum("wl,wlk->k", weights, frames.slopes)
            matrix[columns[:, None], columns] += torch.einsum("wl,wlab->ab", weights, frames.curvatures)
            squares.append(float(frames.squares.mean()))
        return _Terms(energy, slope, matrix, float(np.mean(squares)))

    def answer(self, *, converged: bool) -> Answer:
        """Of the place that was reached."""
        assert self.reached is not None
        place, terms, of = self.reached.place, self.reached.terms, self.of
        covariance = terms.covariance
        precision = torch.diag(of.precision)
        sources = {"recording": covariance @ (terms.matrix - precision) @ covariance}
        for index, variable in enumerate(of.space.variables):
            name = plain_name(variable.name) if variable.doubtful else "prior"
            part = of.precision[index] * torch.outer(covariance[index], covariance[index])
            sources[name] = sources[name] + part if name in sources else part
        poses = covariance[len(of.space.names) : len(of.space.names) + of.poses]
        sources["pose"] = poses.T @ poses
        if not of.knows_grip:
            sources["grasp"] = torch.outer(covariance[-1], covariance[-1])
        sources |= {name: torch.zeros_like(covariance) for name in ("mesh", "time step")}
        misfits, apart = [], []
        for one, known in zip(self.reached.linear, self.of.changes, strict=True):
            recording, shift = one.recording, known.finer
            stepped = recording.objective.scenario.with_steps(2)
            changes = {"mesh": None if shift is None else shift / 2, "time step": self._changed(one, place, stepped)}
            frames = one.frames(place, known)
            weights = recording.independent * frames.weights
            for name, change in changes.items():
                if change is not None:
                    pulled = torch.einsum("wl,wlk->k", weights, one.frames(place, known, change).shifted)
                    moved = covariance[:, recording.columns] @ pulled
                    sources[name] = sources[name] + torch.outer(moved, moved)
            misfits.append(frames.misfits.tolist())
            away = torch.zeros(len(frames.misfits)).double() if shift is None else _squared(shift).sqrt()
            apart.append((away * recording.objective.length_unit_m).tolist())
        total = torch.stack([*sources.values()]).sum(0)
        return Answer(
            place, total, sources, self.reached.energy, converged, tuple(misfits), tuple(apart), tuple(self._trace)
        )


@torch.no_grad()
def estimate(
    objective: AnyObjective,
    space: FitSpace,
    settings: LikelihoodSettings,
    *,
    progress: Callable[[int, int, float, dict[str, float]], None] | None = None,
) -> Estimate:
    """The parameters that recordings show, by the rules at the head of this module. Ctrl-C ends the fit and keeps the best
    so far.

    Args:
        objective: of the recordings, with the frames that may count.
        space: variables and their priors.
        progress: takes the number of the start, the step, the mean squared distance and the values.

    Raises:
        DivergedError: the motion diverges from every start.
        KeyboardInterrupt: before the first place was compared.
    """
    likelihood = _up_to_horizon(objective.members, space, settings)
    answers, failures, descent = list[Answer](), list[DivergedError](), None

    def follow(number: int, place: Tensor) -> Answer | None:
        nonlocal descent

        def tell(step: int, square: float, place: Tensor) -> None:
            if progress is not None:
                values = likelihood.axis.values(place[: len(space.names)]).tolist()
                progress(number, step, square, dict(zip(space.names, values, strict=True)))

        descent = _Descent(likelihood, place, tell)
        try:
            return descent.run(min((one.energy for one in answers), default=math.inf))
        except DivergedError as error:
            failures.append(error)
            return None

    interrupted, simulations = False, 0
    try:
        for number in range(settings.starts):
            away = _START * ((number + 1) // 2) * (1 if number % 2 else -1)
            found = follow(number, likelihood.start(settings.init, away))
            off = 0.0
            if number == 0 and found is not None and not likelihood.knows_grip:
                off = _that_fits(objective.members, float(found.place[-1]))
            if found is not None and abs(off) > _REGRIP:
                simulations += likelihood.simulations
                place = torch.cat([found.place[:-1], torch.zeros(1, dtype=torch.float64)])
                likelihood = _up_to_horizon(objective.members, space, settings, off, place)
                found = follow(number, place)
            if found is not None:
                answers.append(found)
    except KeyboardInterrupt:
        interrupted = True
        if not answers:
            if descent is None or descent.reached is None:
                raise
            answers.append(descent.answer(converged=False))
    if not answers:
        raise failures[0]
    answers.sort(key=lambda one: one.energy)
    simulations += likelihood.simulations
    if likelihood.knows_grip:
        members, grip = [one.objective for one in likelihood.recordings], None
    else:
        grip = _that_fits(objective.members, likelihood.grip + float(answers[0].place[-1]))
        counts = [len(one.objective.frames) for one in likelihood.recordings]
        found_so = [_known(one) for one in _gripped(objective.members, grip)]
        members = [one.earliest([count]) for one, count in zip(found_so, counts, strict=True)]
    return Estimate(space, tuple(answers), tuple(members), grip, simulations, interrupted)


def _gripped(members: Sequence[Objective], grip: float) -> Sequence[Objective]:
    """With a grasp so many deviations larger than stated, where its size is not known."""
    return [one.of(one.scenario.regrip(grip)) if grip and one.scenario.regrip else one for one in members]


def _that_fits(members: Sequence[Objective], grip: float) -> float:
    """So much of a change of the grasp that its pad fits on the cloth and on the mesh."""
    for part in (1.0, 0.75, 0.5, 0.25):
        try:
            for one in members:
                if one.scenario.regrip is not None:
                    one.scenario.regrip(part * grip)
        except SceneError:
            continue
        return part * grip
    return 0.0


def _known(objective: Objective) -> Objective:
    """With the grasp as its scenario has it."""
    return objective.of(replace(objective.scenario, regrip=None))


def _up_to_horizon(
    members: Sequence[Objective],
    space: FitSpace,
    settings: LikelihoodSettings,
    grip: float = 0.0,
    place: Tensor | None = None,
) -> _Likelihood:
    """Of the frames that count.

    Args:
        grip: in deviations from the size that was given.
        place: where the horizon is looked for; by default where the first start begins.
    """
    members = _gripped(members, grip)
    whole = _Likelihood(members, space, settings.iterations, grip)
    horizons = whole.horizons(whole.start(settings.init, 0.0) if place is None else place)
    known = [one.earliest([count]) for one, count in zip(members, horizons, strict=True)]
    found = _Likelihood(known, space, settings.iterations, grip)
    found.simulations = whole.simulations
    return found


def fit_likelihood(
    objective: AnyObjective,
    space: FitSpace,
    settings: LikelihoodSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """`estimate` as a solver: the likeliest answer, whose losses are mean squared distances.

    Raises:
        DivergedError, KeyboardInterrupt: as of `estimate`.
    """
    began, best = time.perf_counter(), math.inf

    def tell(start: int, step: int, square: float, values: dict[str, float]) -> None:
        nonlocal best
        best = min(best, square)
        if progress is not None:
            progress(Progress(step, square, best, values))

    found = estimate(objective, space, settings, progress=tell)
    squares, places = zip(*found.best.trace, strict=True)
    values = [Axis.of(space).bounded(place[: len(space.names)])[None] for place in places]
    return FitOutcome(
        values=found.values,
        loss=squares[-1],
        best_start=0,
        simulations=found.simulations,
        stop_reason="interrupted" if found.interrupted else "converged" if found.best.converged else "iterations",
        seconds=time.perf_counter() - began,
        history=FitHistory(space.names, [torch.tensor([square]).double() for square in squares], values),
        estimate=found,
    )
