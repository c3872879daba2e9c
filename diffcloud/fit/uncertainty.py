"""How far a fit may be off, and why: one covariance, added up from stated sources.

At the fitted place, let H be half of the loss's curvature over the fitted variables and the free pose, priors included,
and s_i what pair i adds to half of its slope. A disturbance that adds g to the slope moves the fit by -H⁻¹ g. So

    noise           H⁻¹ (Σ_c s_c s_cᵀ) H⁻¹,   s_c: the sum over a cluster of pairs (sandwich; Huber 1967, White 1980)
    a prior         H⁻¹ P Σ P H⁻¹,            P: what it adds to H, Σ: its variance
    a known doubt   b bᵀ,  b = -H⁻¹ h,        h: the slope's change if what is not fitted is one deviation off

Residuals of one place on the cloth have much in common, over both directions and all frames: an edge that curls, a fold in
the wrong place. So pairs are clustered by place. A misfit that the recording's own noise does not explain is inside of the
residuals, and widens the interval with them. More than that: the part e of the loss that is above what noise explains
has a cause which nobody stated, and which all C clusters may share. So their variance counts 1 + e (C - 1) times.

Doubtful material (`fit.doubts`) and the pose (`fit.pose`) are fitted too, and the prior of each is a source. Other doubts
are what the fit takes for known: what of the pose is not free. The size of the simulator's step moves the fit to one side;
for it, h is the slope's change between this motion and the one with four times the steps.

What has no curvature at all, because nothing that was recorded moves by it and no prior knows of it, is `unseen`: one
deviation is as long as the longest range.

Changes of the slope are differences between motions to both sides, each matched with the recording anew, with nodes moved
along the derivatives of one simulation: as a surface moves, its points find other partners, which Gauss and Newton's
curvature of fixed pairs knows only roughly.

The pose is solved for as in `residuals`; recordings of a joint fit add up with the weights of `joint`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.fit.joint import AnyObjective, loss_weights, mean_loss
from diffcloud.fit.laid import asked_as
from diffcloud.fit.matching import Motion
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.pose import NUISANCE, TRIED, kind_of, priors_by_clock, set_up_of, unit_of
from diffcloud.fit.residuals import Axis, moved_by
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import Rollout
from diffcloud.sim.threads import map_threads

REFINED = 4
"""Times as many steps show what the step size does."""
STEP_SIZE = "step size"
"""Name of that source."""
_STEP = 0.05
"""On the axis, by which the slope's change is measured."""
_ROUGH = 4.0
"""The largest factor between measured and Gauss and Newton's curvature that is believed."""
_CHUNK = 16
"""Motions matched together."""
_ROUNDING, _UNSEEN = 1e-12, 1e-9
"""Parts of the largest curvature: what has less is rounding, before and after pose and priors."""
_PATCHES = 16
_NOISE_M = 0.002
"""Of recorded points whose own uncertainty is not stated."""


@dataclass(frozen=True)
class Uncertainty:
    """Of k variables that were asked for, on the axis of `residuals.Axis`."""

    names: tuple[str, ...]
    places: NDArray[np.float64]
    """[k] fitted."""
    losses: NDArray[np.float64]
    """[n] of the recordings, without priors."""
    loss: float
    """Of all, with the priors of parameters and poses."""
    sources: Mapping[str, NDArray[np.float64]]
    """Name -> [k, k] covariance."""
    refined: NDArray[np.float64]
    """[k] how far the fit moves where the simulator takes four times the steps."""
    clusters: int
    """Of residuals, over all recordings."""
    step: NDArray[np.float64]
    """[k] that Gauss and Newton would take next: small against the deviations where the fit has arrived."""
    curvature: NDArray[np.float64]
    """Half of the loss's, priors included, by all that is fitted, doubtful material too."""
    besides: frozenset[str] = frozenset()
    """What was fitted too, under priors: doubtful material and the pose."""

    @property
    def covariance(self) -> NDArray[np.float64]:
        """[k, k]"""
        return np.sum(list(self.sources.values()), axis=0)


def uncertainty(objective: AnyObjective, space: FitSpace, values: Mapping[str, float]) -> Uncertainty:
    """
    Args:
        values: the fitted ones, of doubtful material too.

    Raises:
        DivergedError: the motion, or the refined one, diverges.
    """
    axis = Axis.of(space)
    places = axis.places(torch.tensor([[values[name] for name in space.names]], dtype=torch.float64))
    with torch.no_grad():
        parts = map_threads(lambda index: _part(objective, space, places, index), range(len(objective.members)))
    losses, factors = torch.tensor([[part.loss, part.factor] for part in parts], dtype=torch.float64).T[:, :, None]
    weights = loss_weights(losses, paper=objective.paper)[:, 0].numpy()
    loss = float(mean_loss(losses, paper=objective.paper))
    prior = loss * space.prior_weights(len(parts)).numpy()
    normal = sum(w * part.normal for w, part in zip(weights, parts, strict=True)) + np.diag(prior)
    off = space.off_centre(axis.values(places))[0].numpy()
    whole = float(mean_loss(losses * factors, paper=objective.paper) * space.prior_factor(axis.values(places), len(parts)))
    slope = sum(w * part.slope for w, part in zip(weights, parts, strict=True)) + prior * off
    asked = np.array([not variable.doubtful for variable in space.variables])
    inverse = np.linalg.pinv(normal, hermitian=True)[:, asked]

    def spread(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        """[n, all that is fitted] additions to the slope -> [k, k]."""
        moved = rows @ inverse
        return moved.T @ moved

    clusters = np.concatenate([w * part.scores for w, part in zip(weights, parts, strict=True)])
    clusters = clusters[np.abs(clusters).max(axis=1) > 0]
    sources = {"noise": spread(clusters) * len(clusters) / max(len(clusters) - 1, 1)}
    if (unseen := _unseen(normal)[asked]).size:
        sources["unseen"] = float((axis.ends[1] - axis.ends[0]).max()) ** 2 * unseen @ unseen.T
    of_priors = np.diag(prior * space.prior_steps().numpy())
    if prior[asked].any():
        sources["prior"] = spread(of_priors[asked])
    doubts: dict[str, list[NDArray[np.float64]]] = {}
    for row, variable in zip(of_priors, space.variables, strict=True):
        if variable.doubtful:
            doubts.setdefault(asked_as(variable.name), []).append(row)
    sources |= {name: spread(np.stack(rows)) for name, rows in doubts.items()}
    for name in dict.fromkeys(key for part in parts for key in part.doubts if key != STEP_SIZE):
        each = [w * part.doubts[name] for w, part in zip(weights, parts, strict=True) if name in part.doubts]
        sources[name] = spread(np.stack(each))
    refined = -np.sum([w * part.doubts[STEP_SIZE] for w, part in zip(weights, parts, strict=True)], axis=0) @ inverse
    sources[STEP_SIZE] = np.outer(refined, refined) / 3  # mean square of a uniform share of it
    return Uncertainty(
        names=space.asked.names,
        places=places[0, asked].numpy(),
        losses=losses[:, 0].numpy(),
        loss=whole,
        sources=sources,
        refined=refined,
        clusters=len(clusters),
        step=-slope @ inverse,
        curvature=normal * whole / max(loss, 1e-300),
        besides=frozenset(doubts).union(*(m.nuisance for m in objective.members)),
    )


def _unseen(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """[k, u] directions of which neither recording nor prior knows, of the curvature [k, k]."""
    values, vectors = np.linalg.eigh(normal)
    return np.asarray(vectors[:, values <= _UNSEEN * values.max()])


def finer_steps(scenario: Scenario) -> Scenario:
    """With `REFINED` times the steps."""
    return scenario.with_steps(REFINED)


def noise_mm(objective: Objective) -> float:
    """RMS distance that noise and spacing of the recorded points account for [mm]."""
    to_mm = 1e3 * objective.length_unit_m
    spacing = to_mm * float(np.sqrt(np.mean([cloud.spacing**2 for cloud in objective.clouds])))
    sigma = objective.episode.sigma
    return float(np.hypot(spacing, 1e3 * (_NOISE_M if sigma is None else float(np.median(sigma)))))


@dataclass(frozen=True)
class _Part:
    """One recording's share, the pose eliminated."""

    loss: float
    factor: float
    """By which the prior of the pose multiplies it."""
    slope: NDArray[np.float64]
    """[k]"""
    normal: NDArray[np.float64]
    """[k, k]"""
    scores: NDArray[np.float64]
    """[C, k] of the clusters, as often as they count."""
    doubts: Mapping[str, NDArray[np.float64]]
    """Name -> [k] the slope's change at one deviation."""

    @staticmethod
    def of(objective: Objective, space: FitSpace, places: Tensor) -> _Part:
        k = len(space.names)
        moved = moved_by(objective, space, places)
        run, rates = moved.run, moved.rates
        refined = _refined(objective, space.parameters(Axis.of(space).values(places)), run)
        fitted_pose = objective.match(run).pose[0]
        set_up = priors_by_clock(set_up_of(objective.episode), objective.pose_space.clocks)
        free = objective.freed({**set_up, **objective.nuisance})
        pose_names = free.pose_space.names
        values = free.pose_space.of(objective.pose_space.described(fitted_pose, length_unit_m=1.0), length_unit_m=1.0)
        motion = free.match(run, pose=values[None])
        # what is tried, to both sides: variables move nodes, pose variables the pose
        ways = torch.cat([rates * _STEP, refined[None]])[:, 0]
        ways = free.still_bodies(ways)
        small = torch.tensor([TRIED[kind_of(name)] / unit_of(name, objective.length_unit_m) for name in pose_names])
        still = torch.zeros(len(pose_names), *ways.shape[1:], dtype=torch.float64)
        ways, turns = torch.cat([ways, still]), torch.cat([torch.zeros(k + 1, len(pose_names)), small.diag()]).double()
        both = torch.cat([torch.zeros_like(ways[:1]), ways, -ways])
        poses = values + torch.cat([torch.zeros_like(turns[:1]), turns, -turns])
        loss, slopes, normal = _slopes(free, motion, rates, motion.nodes + both, poses)
        change = (slopes[1 : 1 + len(ways)] - slopes[1 + len(ways) :]) / 2
        names = [*space.names, STEP_SIZE, *pose_names]
        own = [*range(k), *(names.index(name) for name in objective.pose_space.names)]
        felt = [*range(k), *(k + pose_names.index(name) for name in objective.pose_space.names)]
        steps = np.concatenate([np.full(k, _STEP), small.numpy()[[index - k for index in felt[k:]]]])
        prior = loss * np.concatenate([np.zeros(k), objective.pose_space.prior_weights.numpy()])
        measured = change[np.ix_(own, felt)] / steps[:, None]
        curved = _between(measured, normal[np.ix_(felt, felt)]) + np.diag(prior)
        slope = slopes[0, felt] + prior * np.concatenate([np.zeros(k), fitted_pose.numpy()])
        onto = np.eye(k, len(felt))  # of what is added to the slope of all that is fitted, what the parameters feel
        if len(felt) > k:
            onto[:, k:] = -np.linalg.solve(curved[k:, k:], curved[k:, :k]).T
        found = {
            name: onto @ change[index, felt] * (set_up[name] / TRIED[kind_of(name)] if name in set_up else 1.0)
            for index, name in enumerate(names)
            if index not in own and not (kind_of(name) in NUISANCE and objective.paper)
        }
        for index, name in enumerate(objective.pose_space.names, k):  # what a prior about another centre would add
            found[name] = onto[:, index] * prior[index] * float(objective.pose_space.deviations[index - k])
        scores = _clustered(free, motion, rates)[:, felt] @ onto.T
        factor = float(objective.pose_space.prior_factor(fitted_pose[None]))
        return _Part(loss, factor, onto @ slope, onto @ curved[:, :k], scores * _times(objective, loss, scores), found)


def _part(objective: AnyObjective, space: FitSpace, places: Tensor, recording: int) -> _Part:
    """Of one recording, over all variables; those of the others do nothing here."""
    own, columns = space.of_recording(recording)
    part = _Part.of(objective.members[recording], own, places[:, columns])
    spread = np.eye(len(space.names))[columns.numpy()]
    return replace(
        part,
        slope=part.slope @ spread,
        normal=spread.T @ part.normal @ spread,
        scores=part.scores @ spread,
        doubts={name: change @ spread for name, change in part.doubts.items()},
    )


def _slopes(
    objective: Objective, motion: Motion, rates: Tensor, nodes: Tensor, poses: Tensor
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """The loss at the first of B motions, half of its slopes [B, k + d] at all, each matched anew, and half of the
    curvature [k + d, k + d] at the first.

    Args:
        rates: [k, 1, L, C · V, 3] of the nodes, the same for all motions.
    """
    slopes, first = [], None
    for begin in range(0, len(nodes), _CHUNK):
        part, at = nodes[begin : begin + _CHUNK], poses[begin : begin + _CHUNK]
        velocities = None if motion.velocities is None else motion.velocities.expand(len(part), -1, -1, -1)
        every = rates.expand(-1, len(part), -1, -1, -1)
        loss, slope, normal = objective.terms(objective.matched(part, velocities, at), every)
        first = first or (float(loss[0]), normal[0].numpy())
        slopes.append(slope)
    assert first is not None
    return first[0], torch.cat(slopes).numpy(), first[1]


def _between(measured: NDArray[np.float64], normal: NDArray[np.float64]) -> NDArray[np.float64]:
    """The measured curvature, which knows that pairs change, but no more than a stated factor off Gauss and Newton's along
    any direction: where a loss is rough, its measured one may be anything. Zero where Gauss and Newton's is rounding."""
    values, vectors = np.linalg.eigh(normal)
    root = vectors * np.sqrt(np.where(values > _ROUNDING * values.max(), values, 0.0))
    inverse = np.linalg.pinv(root)
    factors, axes = np.linalg.eigh(inverse @ ((measured + measured.T) / 2) @ inverse.T)
    clipped = np.clip(factors, 1 / _ROUGH, _ROUGH)
    return np.asarray(root @ (axes * clipped) @ axes.T @ root.T)


def _refined(objective: Objective, parameters: Mapping[str, Tensor], run: Rollout) -> Tensor:
    """[1, L, C · V, 3] from the motion to that with finer steps, at the compared frames; zero for the paper's measure,
    which takes the published step as it is."""
    if objective.paper:
        return torch.zeros_like(objective.looked_at(run))
    return objective.way_to(finer_steps(objective.scenario), parameters, objective.looked_at(run))


def _times(objective: Objective, loss: float, scores: NDArray[np.float64]) -> float:
    """How often deviations by clusters count, because their misfit may have a common cause where noise does not explain it;
    once where it is not known what the recording misses, and thus what explains it."""
    if not objective.knows_gaps:
        return 1.0
    above, clusters = max(1 - objective.noise_loss / loss, 0.0), int((np.abs(scores).max(axis=1) > 0).sum())
    return float(np.sqrt(1 + above * max(clusters - 1, 0)))


def _clustered(objective: Objective, motion: Motion, rates: Tensor) -> NDArray[np.float64]:
    """[C, n] sums of what pairs add to the slope over each cluster."""
    patch = torch.from_numpy(patches(objective.system.mesh.nodes, _PATCHES))
    clocks = len(objective.pose_space.clocks)
    bodies = motion.nodes.shape[-2] // clocks - len(patch)
    patch = torch.cat([patch, torch.full((bodies,), _PATCHES)]).repeat(clocks)
    sums = None
    for pairs, moved, columns in zip(motion.pairs, *objective.columns(motion, rates), strict=True):
        scores = pairs.scores(moved, columns, objective.cap)[:, 0]  # [n, L, N]
        where = patch[pairs.places.nodes[0, ..., 0]]  # [L, N]
        found = scores.new_zeros(len(scores), _PATCHES + 1)
        found.index_add_(1, where.flatten(), scores.flatten(1))
        sums = found if sums is None else sums + found
    assert sums is not None
    return sums.T.numpy()


def patches(nodes: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """[V] which of `count` patches of equal size each node belongs to: halves of halves, each across its longest side.

    Args:
        count: a power of two.
    """
    found = np.zeros(len(nodes), dtype=np.int64)
    groups: list[NDArray[np.int64]] = [np.arange(len(nodes))]
    while len(groups) < count:
        halved = []
        for group in groups:
            side = int(np.ptp(nodes[group], axis=0).argmax()) if len(group) else 0
            order = group[np.argsort(nodes[group, side], kind="stable")]
            halved += [order[: len(order) // 2], order[len(order) // 2 :]]
        groups = halved
    for index, group in enumerate(groups):
        found[group] = index
    return found
