"""One fit of one or several recordings of a cloth, from its settings to its result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from diffcloud.errors import DivergedError
from diffcloud.estimation.batches import batch_losses
from diffcloud.estimation.initial_state import with_initial_state
from diffcloud.estimation.joint import AnyObjective, JointObjective
from diffcloud.estimation.left_out import Tell, leave_each_out
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.priors import parameter_priors
from diffcloud.estimation.record import FitRecord, LeftOut
from diffcloud.estimation.result import FitResult, describe_fit
from diffcloud.estimation.settings import FitSettings
from diffcloud.estimation.solvers import FitHistory, FitOutcome, LikelihoodSettings, Progress, Settings, solve
from diffcloud.estimation.uncertain import with_uncertain
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario


@dataclass(frozen=True)
class Recording:
    """An episode and the scenario that simulates it."""

    scenario: Scenario
    name: str
    episode: Episode


def compared(record: FitRecord, recordings: Sequence[Recording]) -> AnyObjective:
    """Return the `Objective` with which a finished fit was made, for the frames that its record lists.

    Args:
        recordings: recordings of the fit, in the same order.

    Raises:
        ConfigError, EpisodeError: the episodes lack these frames, or are of different cloths.
    """
    return _joined(
        [Objective(one.scenario, one.episode, **record.measured_by(place)) for place, one in enumerate(recordings)]
    )


def _joined(members: Sequence[Objective]) -> AnyObjective:
    """Return the objective of a single recording, or the joint objective of several."""
    return members[0] if len(members) == 1 else JointObjective(members)


@dataclass(frozen=True)
class FitTask:
    """Fit of one parameter set to one or several recordings."""

    recordings: Sequence[Recording]
    settings: FitSettings = field(default_factory=FitSettings)
    init: Mapping[str, float] = field(default_factory=dict)
    """Multipliers of the first start; by default the centre of the range."""

    @property
    def scenario(self) -> Scenario:
        """Scenario of the first recording."""
        return self.recordings[0].scenario

    @cached_property
    def space(self) -> FitSpace:
        """The fitted variables.

        Raises:
            ConfigError: bounds, priors, uncertain material or fixed values are invalid for these parameters, or the
                scenes do not support the requested initial state.
        """
        settings = self.settings
        for recording in self.recordings:
            recording.scenario.check_parameters([*settings.parameters, *settings.fixed])
        fixed = self.scenario.multipliers(settings.fixed, "fixed")
        bounds = self.scenario.search_range(settings.bounds)
        space = FitSpace.build(settings.parameters, bounds=bounds, fixed=fixed)
        ranges = {variable.name: (variable.low, variable.high) for variable in space.variables}
        priors = parameter_priors("none" if settings.paper else settings.prior, space.names, ranges)
        space = FitSpace.build(settings.parameters, bounds=bounds, fixed=fixed, priors=priors)
        scenarios = [recording.scenario for recording in self.recordings]
        space = with_uncertain(space, settings.known_within(scenarios), scenarios)
        return with_initial_state(space, settings.initial_state_within(scenarios), scenarios)

    def objective(self) -> AnyObjective:
        """Build the objective.

        Raises:
            ConfigError, EpisodeError: an episode lacks a requested frame, or the recordings are of different cloths.
        """
        measure = self.settings.measure()
        return _joined([Objective(one.scenario, one.episode, **measure) for one in self.recordings])

    def check(self) -> None:
        """Check settings and recordings without simulating.

        Raises:
            ConfigError, EpisodeError: see `space` and `objective`.
        """
        _ = self.space
        self.objective()

    @property
    def solver_settings(self) -> Settings:
        return replace(self.settings.solver_settings(self.scenario), init=self.init)

    def solved(self, progress: Callable[[Progress], None] | None = None) -> tuple[AnyObjective, FitOutcome]:
        """Run the solver. Return the objective and the outcome; nothing is written.

        Raises:
            ConfigError, EpisodeError: see `space` and `objective`.
            DivergedError, KeyboardInterrupt: see `solve`.
        """
        objective = self.objective()
        outcome = solve(objective, self.space, self.solver_settings, progress=progress)
        if outcome.estimate is not None:  # frames beyond the horizon were not used
            objective = _joined(outcome.estimate.members)
        return objective, outcome

    def fitted(self, progress: Callable[[Progress], None] | None = None, left_out: Tell | None = None) -> FitResult:
        """Run the fit and return its full result. Ctrl-C ends the fit, and the best result so far is returned.

        Args:
            progress: callback for the fit.
            left_out: callback for the leave-one-out fits.

        Raises:
            ConfigError, EpisodeError: see `space` and `objective`.
            DivergedError: every start diverged.
            KeyboardInterrupt: Ctrl-C before the first loss, or a second Ctrl-C while the result is prepared.
        """
        space, settings = self.space, self.solver_settings
        objective, outcome = self.solved(progress)
        left, failures, interrupted = list[LeftOut](), list[str](), outcome.stop_reason == "interrupted"
        if isinstance(objective, JointObjective) and isinstance(settings, LikelihoodSettings) and not interrupted:
            try:
                left = leave_each_out(objective, space, outcome.values, settings, progress=left_out)
            except DivergedError as error:
                failures.append(f"leaving one recording out: {error}")
            except KeyboardInterrupt:
                interrupted = True
        names = [one.name for one in self.recordings]
        try:
            result = describe_fit(objective, space, settings, outcome, episodes=names)
        except KeyboardInterrupt:  # finish the description, which takes about a second, to keep a fit of minutes
            result = replace(describe_fit(objective, space, settings, outcome, episodes=names), pressed=True)
        record = result.record
        record.failures += failures
        record.stop_reason = "interrupted" if interrupted else record.stop_reason
        for recording, told in zip(record.episodes, left, strict=bool(left)):
            recording.left_out = told
        return result

    def begun(self) -> FitResult:
        """Return the start point as a result, in the form of a fit that was interrupted there.

        Raises:
            DivergedError: the motion diverges at the start point.
        """
        objective, space, settings, began = self.objective(), self.space, self.solver_settings, time.perf_counter()
        values = space.starts(1, seed=settings.seed, first=self.init)[0].double()
        losses = batch_losses(objective, space, values)
        history = FitHistory(space.names, [losses], [values])
        outcome = FitOutcome(
            values=dict(zip(space.names, values[0].tolist(), strict=True)),
            loss=float(losses[0]),
            best_start=0,
            simulations=len(objective.members),
            stop_reason="interrupted",
            seconds=time.perf_counter() - began,
            history=history,
        )
        return describe_fit(objective, space, settings, outcome, episodes=[one.name for one in self.recordings])
