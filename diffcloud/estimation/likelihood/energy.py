"""Φ of all recordings as a function of parameters, poses and grasp size. `estimation.likelihood` defines Φ."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from diffcloud.estimation.likelihood.frames import squared
from diffcloud.estimation.likelihood.grasp import gripped
from diffcloud.estimation.likelihood.recording import Changes, Recording
from diffcloud.estimation.likelihood.settings import LikelihoodSettings
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.residuals import Axis
from diffcloud.sim.threads import map_threads

FOLLOWS = 1.5
"""Largest c of a frame in which the simulation follows the recording. Beyond it, unknown model errors exceed half of the
known variance."""
_PART_M, _GONE_M = 0.004, 0.010
"""RMS displacement by mesh refinement [m] at the horizon, after `_LEAST_S` and before."""
_LEAST_S = 1.2
"""Time [s] up to which the horizon is less strict, because a poor initial material may diverge too early."""
_EARLY_S = 1.5
"""The horizon is first sought in the frames up to this time [s], because it is seldom later."""
_FEWEST = 5
"""Minimum number of frames. A simulation that departs from the first frame on would otherwise be fitted to that frame
alone."""
_FAR = 100.0
"""Bound on a pose variable, in standard deviations."""
_FAR_GRIP = 2.0
"""Bound on the grasp size, in standard deviations. Its effect is interpolated between -1 and 1."""
_EDGE = 1e-6
"""Minimum distance from a bound, in fit coordinates."""


@dataclass(frozen=True)
class Correction:
    """Effect of the refined mesh and of other grasp sizes on the motion, simulated at one point."""

    place: Tensor
    """[K] coordinates."""
    asked: Tensor
    """Indices of the requested variables."""
    changes: Sequence[Changes]
    """Node displacements of each recording."""

    def distance(self, place: Tensor, deviations: Tensor | float) -> float:
        """Return the largest distance from a point among the requested variables, divided by these deviations."""
        away = ((place - self.place) / deviations)[self.asked].abs()
        return float(away.max()) if len(away) else 0.0

    def at(self, chosen: Sequence[Sequence[int]]) -> Correction:
        """Return the correction for a subset of the frames of each recording."""
        return Correction(self.place, self.asked, [one.at(own) for one, own in zip(self.changes, chosen, strict=True)])


class Likelihood:
    """Objective Φ of all recordings, with its variables and their priors."""

    def __init__(
        self, objectives: Sequence[Objective], space: FitSpace, settings: LikelihoodSettings, grip: float = 0.0
    ) -> None:
        """Set up the variables of all recordings.

        Args:
            grip: grasp size of the scenarios, in standard deviations from the stated size.
        """
        self.space, self.axis, self.settings = space, Axis.of(space), settings
        self.recordings, self.simulations, self.grip = list[Recording](), 0, grip
        variables = count = len(space.names)
        last = variables + sum(len(one.pose_space.names) for one in objectives)
        for index, objective in enumerate(objectives):
            own, columns = space.of_recording(index)
            self.recordings.append(Recording(objective, own, columns, count, last, model_error=settings.model_error))
            count += len(objective.pose_space.names)
        asked = [index for index, one in enumerate(space.variables) if not one.nuisance]
        self.asked = torch.tensor(asked, dtype=torch.long)
        self.corrections = list[Correction]()
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

    @property
    def frames(self) -> int:
        """Number of compared frames in all recordings."""
        return sum(len(one.objective.frames) for one in self.recordings)

    def inside(self, place: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(place, self.low), self.high)

    def off_centre(self, place: Tensor) -> Tensor:
        return torch.where(self.precision > 0, place - self.centre, 0.0)

    def horizons(self, place: Tensor) -> list[int]:
        """Return for each recording the number of frames before the motions of both meshes differ."""

        def one(recording: Recording) -> int:
            recording.refined = place, recording.change(place, recording.nodes(place), recording.finer)
            apart = squared(recording.refined[1]).sqrt() * recording.objective.length_unit_m
            times = recording.objective.times
            return _before(apart > torch.where(times > _LEAST_S, _PART_M, _GONE_M), times)

        self.simulations += 2 * len(self.recordings)
        return map_threads(one, self.recordings)

    def before_departure(self, chi_squares: Sequence[Sequence[float]]) -> Likelihood | None:
        """Return the likelihood of the frames before the simulation departs from a recording; None if it does not.

        Args:
            chi_squares: for each recording, c of its frames.
        """
        found = zip(self.recordings, chi_squares, strict=True)
        counts = [_before(torch.tensor(squares) > FOLLOWS, one.objective.times) for one, squares in found]
        return self.earliest(counts) if sum(counts) < self.frames else None

    def earliest(self, counts: Sequence[int]) -> Likelihood:
        """Return the likelihood of the earliest frames, with this number of frames of each recording."""
        members = [one.objective.earliest([count]) for one, count in zip(self.recordings, counts, strict=True)]
        found = Likelihood(members, self.space, self.settings, self.grip)
        chosen = list[list[int]]()
        for one, whole in zip(found.recordings, self.recordings, strict=True):
            chosen.append([whole.objective.frames.index(frame) for frame in one.objective.frames])
            one.refined = whole.refined_in(chosen[-1])
        found.corrections = [one.at(chosen) for one in self.corrections]
        return found

    def nearest(self, place: Tensor, deviations: Tensor | float = 1.0) -> Correction | None:
        """Return the correction nearest to a point, with distances in these deviations; None if there is none."""
        return min(self.corrections, key=lambda one: one.distance(place, deviations), default=None)

    def start(self, init: Mapping[str, float], offset: float) -> Tensor:
        """Return start coordinates [K] from these values, or else from the centres of the priors.

        Args:
            init: name -> value.
            offset: shift of the first variable, in fit coordinates.
        """
        place = self.centre.clone()
        for index, name in enumerate(self.space.names):
            if name in init:
                place[index] = self.axis.places(torch.full((len(self.space.names),), init[name]).double())[index]
        place[0] += offset
        place[len(self.space.names) :] = 0.0
        return self.inside(place)


@dataclass(frozen=True)
class Terms:
    """Φ at one point, with half its gradient and half its Gauss–Newton matrix."""

    energy: float
    slope: Tensor
    """[K] half the gradient."""
    matrix: Tensor
    """[K, K] half the Gauss–Newton matrix."""
    square: float
    """Mean squared distance."""

    @cached_property
    def covariance(self) -> Tensor:
        return torch.linalg.inv(self.matrix)

    @property
    def deviations(self) -> Tensor:
        return self.covariance.diagonal().sqrt()


def up_to_horizon(
    members: Sequence[Objective],
    space: FitSpace,
    settings: LikelihoodSettings,
    grip: float = 0.0,
    place: Tensor | None = None,
) -> Likelihood:
    """Return the likelihood of the frames up to the horizon.

    Args:
        grip: grasp size, in standard deviations from the stated size.
        place: coordinates at which the horizon is determined; by default those of the first start.
    """
    members, simulations = gripped(members, grip), 0
    for last in (_EARLY_S, math.inf):
        tested = Likelihood([_until(one, last) for one in members], space, settings, grip)
        place = tested.start(settings.init, 0.0) if place is None else place
        horizons = tested.horizons(place)
        simulations += tested.simulations
        found = zip(horizons, tested.recordings, members, strict=True)
        if not any(count == len(part.objective.times) < len(whole.times) for count, part, whole in found):
            break
    likelihood = tested.earliest(horizons)
    likelihood.simulations = simulations
    return likelihood


def _before(gone: Tensor, times: Tensor) -> int:
    """Return the number of frames earlier than the first marked one, but at least `_FEWEST`."""
    places = torch.nonzero(gone[times.argsort(stable=True)])
    return min(max(int(places[0]), _FEWEST), len(gone)) if len(places) else len(gone)


def _until(objective: Objective, last: float) -> Objective:
    """Return the objective restricted to frames up to a time [s], but at least `_FEWEST` frames."""
    return objective.earliest([max(int((objective.times <= last).sum()), _FEWEST)])
