"""Descent of Φ from one start, with the uncertainty at its end. Φ is defined in `estimation.likelihood`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.estimation.bounded import lowest_within
from diffcloud.estimation.initial_state import asked_as
from diffcloud.estimation.likelihood.energy import Correction, Likelihood, Terms
from diffcloud.estimation.likelihood.frames import squared
from diffcloud.estimation.likelihood.grasp import in_powers
from diffcloud.estimation.likelihood.recording import Changes, Linear
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.threads import map_threads

_RADIUS = 1.0
"""Largest step in each variable, in fit coordinates."""
_SMALL = 0.25
"""A descent ends if its step is smaller than this, in standard deviations."""
_FEWEST_STEPS = 3
"""Minimum number of steps in a descent."""
_RISE = 0.02
"""Allowed increase of Φ in a step, per independent residual."""
_BACKTRACKS = 3
_NEAR = 0.5
"""Where the next step is smaller than this, in standard deviations, the refined mesh is simulated. If that was done at a
point within this distance, its result is used again."""
_GAINS, _BEHIND = 3.0, 20.0
"""A start is abandoned if its expected Φ is above the best one by more than the second number. The expected Φ is its
current value minus the first number times the gain that the next step predicts."""


@dataclass(frozen=True)
class Answer:
    """Result of one start."""

    place: Tensor
    """[K] fit coordinates of the space, then the pose of each recording and the grasp size if unknown, the latter two
    in standard deviations of their priors."""
    covariance: Tensor
    """[K, K] covariance of the variables."""
    sources: Mapping[str, Tensor]
    """Source of uncertainty -> its contribution to the covariance [K, K]."""
    energy: float
    """Value of Φ."""
    converged: bool
    chi_squares: tuple[list[float], ...]
    """For each recording, c of its frames."""
    apart_m: tuple[list[float], ...]
    """For each recording, the RMS node displacement by mesh refinement in its frames [m]."""
    trace: tuple[tuple[float, Tensor], ...]
    """Mean squared distance and coordinates at each step."""


@dataclass(frozen=True)
class Reached:
    """Last accepted iterate of a descent."""

    place: Tensor
    linear: list[Linear]
    terms: Terms

    @property
    def energy(self) -> float:
        return self.terms.energy


class Descent:
    """Descent of Φ from one start."""

    def __init__(self, likelihood: Likelihood, place: Tensor, tell: Callable[[int, float, Tensor], None]) -> None:
        """Prepare a descent.

        Args:
            tell: progress callback. Its arguments are step, mean squared distance and coordinates.
        """
        self.of, self.place, self._tell = likelihood, place, tell
        self.reached: Reached | None = None
        self._correction: Correction | None = None
        self._trace: list[tuple[float, Tensor]] = []

    def run(self, to_beat: float) -> Answer | None:
        """Return the result, or None if the start is abandoned.

        Args:
            to_beat: Φ of the best result of other starts.
        """
        of, place, radius, tried = self.of, self.place, _RADIUS, 0
        allowed = _RISE * sum(one.independent * len(one.objective.frames) for one in of.recordings)
        for _ in range(of.settings.max_steps):
            best = self.reached
            try:
                linear = self._linear(place)
            except DivergedError:
                if best is None:
                    raise
                place, radius = 0.5 * (place + best.place), 0.5 * radius
                continue
            if self._correction is None:
                self._correction = of.nearest(place) or self._corrected(linear, place)
            terms = self._terms(linear, place)
            if best is not None and terms.energy > best.energy + allowed:
                tried += 1
                if tried > _BACKTRACKS:
                    break
                place, radius = 0.5 * (place + best.place), 0.5 * radius
                continue
            tried = 0
            step = self._step(terms, place, radius)
            within = (_NEAR * terms.deviations).clamp(max=radius)
            if bool((step.abs() < within)[of.asked].all()) and self._correction.distance(place, terms.deviations) > _NEAR:
                near = of.nearest(place, terms.deviations)
                known = near is not None and near.distance(place, terms.deviations) <= _NEAR
                self._correction = near if known else self._corrected(linear, place)
                terms = self._terms(linear, place)
                step = self._step(terms, place, radius)
            self.reached = Reached(place, linear, terms)
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

    def _step(self, terms: Terms, place: Tensor, radius: float) -> Tensor:
        box = torch.full_like(place, radius)
        low, high = torch.maximum(-box, self.of.low - place), torch.minimum(box, self.of.high - place)
        return lowest_within(terms.matrix, terms.slope, low, high)

    def _linear(self, place: Tensor) -> list[Linear]:
        self.of.simulations += len(self.of.recordings)
        return map_threads(lambda one: Linear.at(one, place), self.of.recordings)

    def _corrected(self, linear: Sequence[Linear], place: Tensor) -> Correction:
        """Simulate the refined mesh and the other grasp sizes at this point."""

        def changes(one: Linear, old: Changes) -> Changes:
            finer = self._refined(one, place) if one.recording.model_error else None
            grips = [self._changed(one, place, other) for other in one.recording.regripped]
            return Changes(old.finer if finer is None else finer, in_powers(grips) or old.grip)

        before = self._correction.changes if self._correction else [Changes()] * len(linear)
        found = Correction(
            place, self.of.asked, map_threads(lambda pair: changes(*pair), [*zip(linear, before, strict=True)])
        )
        self.of.corrections.append(found)
        return found

    def _refined(self, one: Linear, place: Tensor) -> Tensor | None:
        """Return the node displacements by mesh refinement; None if the simulation of the refined mesh diverges."""
        known = one.recording.refined
        return known[1] if known and torch.equal(known[0], place) else self._changed(one, place, one.recording.finer)

    def _changed(self, one: Linear, place: Tensor, variant: Scenario) -> Tensor | None:
        """Return the node displacements that a scenario variant causes; None if its simulation diverges."""
        self.of.simulations += 1
        try:
            return one.recording.change(place, one.nodes, variant)
        except DivergedError:
            return None

    def _terms(self, linear: Sequence[Linear], place: Tensor) -> Terms:
        assert self._correction is not None
        of, squares = self.of, list[float]()
        off = of.off_centre(place)
        energy, slope, matrix = float((of.precision * off.square()).sum()), of.precision * off, torch.diag(of.precision)
        for one, changes in zip(linear, self._correction.changes, strict=True):
            frames, n, columns = one.frames(place, changes), one.recording.independent, one.recording.columns
            energy += n * frames.energy()
            weights = n * frames.weights
            slope[columns] += torch.einsum("wl,wlk->k", weights, frames.slopes)
            matrix[columns[:, None], columns] += torch.einsum("wl,wlab->ab", weights, frames.curvatures)
            squares.append(float(frames.squares.mean()))
        return Terms(energy, slope, matrix, float(np.mean(squares)))

    def answer(self, *, converged: bool) -> Answer:
        """Return the result at the last accepted iterate."""
        assert self.reached is not None
        assert self._correction is not None
        place, terms, of = self.reached.place, self.reached.terms, self.of
        covariance = terms.covariance
        precision = torch.diag(of.precision)
        sources = {"recording": covariance @ (terms.matrix - precision) @ covariance}
        for index, variable in enumerate(of.space.variables):
            name = asked_as(variable.name) if variable.nuisance else "prior"
            part = of.precision[index] * torch.outer(covariance[index], covariance[index])
            sources[name] = sources[name] + part if name in sources else part
        poses = covariance[len(of.space.names) : len(of.space.names) + of.poses]
        sources["pose"] = poses.T @ poses
        if not of.knows_grip:
            sources["grasp"] = torch.outer(covariance[-1], covariance[-1])
        sources |= {name: torch.zeros_like(covariance) for name in ("mesh", "time step")}
        chi_squares, apart = [], []
        for one, known in zip(self.reached.linear, self._correction.changes, strict=True):
            recording, shift = one.recording, known.finer
            changes = dict[str, Tensor | None]()
            if recording.model_error:
                stepped = recording.objective.scenario.with_steps(2)
                changes = {"mesh": None if shift is None else shift / 2, "time step": self._changed(one, place, stepped)}
            frames = one.frames(place, known)
            weights = recording.independent * frames.weights
            for name, change in changes.items():
                if change is not None:
                    pulled = torch.einsum("wl,wlk->k", weights, one.frames(place, known, change).shifted)
                    moved = covariance[:, recording.columns] @ pulled
                    sources[name] = sources[name] + torch.outer(moved, moved)
            chi_squares.append(frames.chi_squares.tolist())
            away = torch.zeros(len(frames.chi_squares)).double() if shift is None else squared(shift).sqrt()
            apart.append((away * recording.objective.length_unit_m).tolist())
        total = torch.stack([*sources.values()]).sum(0)
        return Answer(
            place, total, sources, self.reached.energy, converged, tuple(chi_squares), tuple(apart), tuple(self._trace)
        )
