"""Descents from several starts, weighted by their likelihoods."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import DivergedError
from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.likelihood.descent import Answer, Descent
from diffcloud.estimation.likelihood.energy import Likelihood, up_to_horizon
from diffcloud.estimation.likelihood.grasp import gripped, known, that_fits
from diffcloud.estimation.likelihood.settings import LikelihoodSettings
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.residuals import Axis

_START = math.log(4.5)
"""Distance between starts, in the logarithm of the first variable (usually stretching)."""
_BESIDE = 2.0
"""Distance of the last two starts from the best result, in standard deviations of the first variable. With these
starts, 9 instead of 7 of ten intervals contain the true value of towels simulated in MuJoCo. Fits take 20 % longer."""
_REGRIP = 0.3
"""The fit continues with a new grasp size if the first start changes it by more standard deviations than this."""


@dataclass(frozen=True)
class Estimate:
    """Result of a fit of one or several recordings."""

    space: FitSpace
    answers: tuple[Answer, ...]
    """Results of all completed starts, the most likely first."""
    members: tuple[Objective, ...]
    """Objectives up to their horizons, with the estimated grasp size."""
    departs: tuple[bool, ...]
    """For each recording, whether its horizon is earlier because the simulation departs from the recording."""
    grip: float | None
    """Estimated grasp size, in standard deviations from the stated size; None if the size is known."""
    simulations: int
    interrupted: bool = False

    @property
    def best(self) -> Answer:
        return self.answers[0]

    @property
    def weights(self) -> NDArray[np.float64]:
        """[A] weights of the results by their likelihoods."""
        energies = np.array([one.energy for one in self.answers])
        found = np.exp(-0.5 * (energies - energies.min()))
        return np.asarray(found / found.sum())

    @property
    def mean(self) -> Tensor:
        """[K] weighted mean of all results."""
        return torch.from_numpy(self.weights) @ torch.stack([one.place for one in self.answers])

    @property
    def sources(self) -> dict[str, Tensor]:
        """Source of uncertainty -> contribution to the covariance [K, K]. `starts` is the spread between results."""
        apart, mean = torch.zeros_like(self.best.covariance), self.mean
        found = {name: torch.zeros_like(apart) for name in self.best.sources}
        for weight, one in zip(self.weights.tolist(), self.answers, strict=True):
            apart += weight * torch.outer(one.place - mean, one.place - mean)
            for name, part in one.sources.items():
                found[name] += weight * part
        return {**found, "starts": apart}

    @property
    def covariance(self) -> Tensor:
        """[K, K] covariance of the mixture."""
        return torch.stack([*self.sources.values()]).sum(0)

    @property
    def values(self) -> dict[str, float]:
        """Parameter values of the most likely result."""
        axis = Axis.of(self.space)
        return dict(zip(self.space.names, axis.bounded(self.best.place[: len(self.space.names)]).tolist(), strict=True))


def places_beside(answer: Answer, likelihood: Likelihood) -> list[Tensor]:
    """Return two points [K] at which the first requested variable is `_BESIDE` standard deviations above and below a
    result. The other variables minimise the quadratic approximation of Φ there."""
    column = answer.covariance[:, likelihood.asked[0]]
    away = _BESIDE * column / column[likelihood.asked[0]].sqrt()
    return [likelihood.inside(answer.place + side * away) for side in (1, -1)]


@torch.no_grad()
def estimate(
    objective: AnyObjective,
    space: FitSpace,
    settings: LikelihoodSettings,
    *,
    progress: Callable[[int, int, float, dict[str, float]], None] | None = None,
) -> Estimate:
    """Estimate parameters and their uncertainty as `estimation.likelihood` describes.

    Ctrl-C ends the fit and keeps the best result so far.

    Args:
        objective: objective of the recordings, with all usable frames.
        space: variables and their priors.
        progress: callback. Its arguments are number of the start, step, mean squared distance and values.

    Raises:
        DivergedError: the motion diverges from every start.
        KeyboardInterrupt: Ctrl-C before the first iterate was evaluated.
    """
    likelihood = up_to_horizon(objective.members, space, settings)
    answers, failures, descent = list[Answer](), list[DivergedError](), None
    simulated = [likelihood]

    def follow(number: int, place: Tensor, likelihood: Likelihood, to_beat: float = math.inf) -> Answer | None:
        nonlocal descent

        def tell(step: int, square: float, place: Tensor) -> None:
            if progress is not None:
                values = likelihood.axis.values(place[: len(space.names)]).tolist()
                progress(number, step, square, dict(zip(space.names, values, strict=True)))

        descent = Descent(likelihood, place, tell)
        try:
            return descent.run(to_beat)
        except DivergedError as error:
            failures.append(error)
            return None

    interrupted, departs = False, [False] * len(objective.members)
    try:
        for number in range(settings.starts):
            away = _START * ((number + 1) // 2) * (1 if number % 2 else -1)
            lowest = min((one.energy for one in answers), default=math.inf)
            found = follow(number, likelihood.start(settings.init, away), likelihood, lowest)
            off = 0.0
            if number == 0 and found is not None and not likelihood.knows_grip:
                off = that_fits(objective.members, float(found.place[-1]))
            if found is not None and abs(off) > _REGRIP:
                place = torch.cat([found.place[:-1], torch.zeros(1, dtype=torch.float64)])
                likelihood = up_to_horizon(objective.members, space, settings, off, place)
                simulated.append(likelihood)
                found = follow(number, place, likelihood)
            if found is not None:
                answers.append(found)
        horizon = likelihood.recordings
        while settings.model_error and answers:
            best = min(answers, key=lambda one: one.energy)
            shorter = likelihood.before_departure(best.chi_squares)
            if shorter is None:
                break
            simulated.append(shorter)
            again = [follow(settings.starts, one.place, shorter) for one in answers]
            if not any(again):
                break
            likelihood, answers = shorter, [one for one in again if one is not None]
            pairs = zip(shorter.recordings, horizon, strict=True)
            departs = [len(one.objective.frames) < len(whole.objective.frames) for one, whole in pairs]
        if settings.model_error and settings.starts > 1 and answers:
            for place in places_beside(min(answers, key=lambda one: one.energy), likelihood):
                found = follow(settings.starts, place, likelihood, min(one.energy for one in answers))
                if found is not None:
                    answers.append(found)
        every = sum(len(one.frames) for one in objective.members)
        if answers and not settings.model_error and likelihood.frames < every:
            best = min(answers, key=lambda one: one.energy)
            whole = Likelihood(objective.members, space, settings)
            simulated.append(whole)
            found = follow(settings.starts, best.place, whole)
            if found is not None and found.converged:
                likelihood, answers = whole, [found]
    except KeyboardInterrupt:
        interrupted = True
        if not answers:
            if descent is None or descent.reached is None:
                raise
            answers.append(descent.answer(converged=False))
            likelihood = descent.of
    if not answers:
        raise failures[0]
    answers.sort(key=lambda one: one.energy)
    if likelihood.knows_grip:
        members, grip = [one.objective for one in likelihood.recordings], None
    else:
        grip = that_fits(objective.members, likelihood.grip + float(answers[0].place[-1]))
        counts = [len(one.objective.frames) for one in likelihood.recordings]
        found_so = [known(one) for one in gripped(objective.members, grip)]
        members = [one.earliest([count]) for one, count in zip(found_so, counts, strict=True)]
    simulations = sum(one.simulations for one in simulated)
    return Estimate(space, tuple(answers), tuple(members), tuple(departs), grip, simulations, interrupted)
