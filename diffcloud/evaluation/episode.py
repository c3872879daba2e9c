"""Comparison of all methods on one episode: metrics, missing methods, transfer, intervals, loss landscape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from diffcloud.errors import DiffCloudError
from diffcloud.estimation.names import of_recording
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import FitRecord
from diffcloud.estimation.solvers import AdamSettings, CmaEsSettings, RandomSearchSettings
from diffcloud.evaluation import methods
from diffcloud.evaluation.intervals import intervals_of
from diffcloud.evaluation.landscape import loss_landscape
from diffcloud.evaluation.methods import Estimate, Gap
from diffcloud.evaluation.metrics import EpisodeMeter, success_threshold
from diffcloud.evaluation.settings import Baseline, ComparisonSettings
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario


@dataclass(frozen=True)
class EpisodeRecord:
    """Result of the comparison on one episode."""

    record: dict[str, Any]
    """Plain values, which depend on the inputs only: scenario, episode, its fit and labels, `gaps`, `transfers`,
    `intervals`, `landscape`. `start` has the metrics of the fit's start, or None if it diverges. `methods` has one row
    each: values, clipped values, metrics, simulations. `nuisance` names the nuisance parameters."""
    seconds: dict[str, dict[str, float]]
    """Method -> phase -> wall time."""


def compare_episode(
    scenario: Scenario,
    episode: Episode,
    fit: FitRecord,
    *,
    name: str,
    fit_name: str | None = None,
    recording: int = 0,
    predictions: Sequence[Estimate | Gap] = (),
    transfers: Mapping[str, Mapping[str, float]] | None = None,
    settings: ComparisonSettings | None = None,
) -> EpisodeRecord:
    """Compare all methods on one episode.

    Args:
        fit: fit of the episode. Its loss, bounds, fixed parameters and number of iterations apply to every method.
        fit_name: name of the fit, if it is a joint fit of several episodes.
        recording: index of the episode in the fit.
        predictions: predictions of networks, and reasons for missing ones.
        transfers: other recording of the same fabric -> parameters fitted to it.
    """
    settings = settings or ComparisonSettings()
    space, _ = methods.space_of(fit).of_recording(recording)
    objective = Objective(scenario, episode, **fit.measured_by(recording))
    told: list[Estimate | Gap] = [methods.fitted(fit, recording)]
    initial_state = fit.initial_state_in(fit.episodes[recording])  # shared by all methods, like the pose
    lying = FitSpace(space.asked.variables, {**space.asked.fixed, **initial_state})
    told += [_run(baseline, objective, lying, fit, settings.seed) for baseline in settings.baselines]
    told += [*predictions, *methods.published(episode.meta)]
    estimates = [entry for entry in told if isinstance(entry, Estimate)]
    gaps = [entry for entry in told if isinstance(entry, Gap)]
    meter = EpisodeMeter(objective, draws=settings.draws, seed=settings.seed)
    sources = dict(transfers or {})
    every = (*(e.values for e in estimates), *sources.values())
    sets = [methods.clipped({**initial_state, **values}, space) for values in every]
    measured = meter.measure([*sets, of_recording(fit.start, recording)])
    rows, transferred = [], []
    for index, estimate in enumerate(estimates):
        if index in measured.diverged:
            gaps.append(Gap(estimate.method, measured.diverged[index]))
            continue
        told_values = {key: float(value) for key, value in estimate.values.items()}
        rows.append(
            {
                "method": estimate.method,
                "values": told_values,
                "clipped": sets[index],
                "inside": all(v.low <= told_values.get(v.name, v.low) <= v.high for v in space.variables),
                "simulations": estimate.simulations,
                "gradients": estimate.gradients,
                "intervals": None if estimate.intervals is None else {k: list(v) for k, v in estimate.intervals.items()},
                **measured.rows[index],
            }
        )
    for index, source in enumerate(sources, start=len(estimates)):
        if index in measured.diverged:
            gaps.append(Gap(f"transfer from {source}", measured.diverged[index]))
        else:
            transferred.append({"source": source, "clipped": sets[index], **measured.rows[index]})
    seconds = {estimate.method: dict(estimate.seconds) for estimate in estimates}
    best = sets[0]
    meta = episode.meta
    record: dict[str, Any] = {
        "scenario": scenario.name,
        "episode": name,
        "fit": fit_name or name,
        **{key: meta.get(key) for key in ("fabric", "category", "repeat", "source")},
        "category_assumed": bool(meta.get("category_assumed", False)),
        "truth": {key: float(value) for key, value in (meta.get("truth") or {}).items()},
        "length_unit_m": scenario.length_unit_m,
        "threshold": success_threshold(scenario),
        "frames": list(objective.frames),
        "nuisance": [variable.name for variable in space.variables if variable.nuisance],
        "start": None if len(sets) in measured.diverged else measured.rows[-1],
        "methods": rows,
        "gaps": [{"method": gap.method, "reason": gap.reason, "expected": gap.expected} for gap in gaps],
        "failures": list(fit.failures),
        "transfers": transferred,
        "intervals": None,
        "landscape": None,
    }
    if 0 in measured.diverged:  # the fit itself diverged
        return EpisodeRecord(record, seconds)
    objective.reseed(fit.measure.seed)
    alone = len(fit.episodes) == 1  # intervals of a joint fit belong to all recordings
    if settings.level is not None and alone and fit.estimate is not None:
        told_intervals = intervals_of(fit, space, scenario, level=settings.level, within=settings.within)
        record["intervals"] = told_intervals.model_dump(mode="json")
    if settings.landscape_size:
        record["landscape"] = loss_landscape(objective, space, best, fit.history, size=settings.landscape_size)
    return EpisodeRecord(record, seconds)


def _run(baseline: Baseline, objective: Objective, space: FitSpace, fit: FitRecord, seed: int) -> Estimate | Gap:
    """Run one baseline with the budget of the fit, or of one start of Adam. Return a gap if its simulations fail."""
    told, by_adam = fit.settings, fit.solver == "adam"
    simulations = int(told["max_steps"] or 0) + 1 if by_adam else methods.simulations_each(fit)
    threshold = float(told.get("threshold") or 0.0)
    objective.reseed(fit.measure.seed)
    try:
        if baseline == "middle":
            return methods.middle(space)
        if baseline == "random_search":
            return methods.searched(objective, space, RandomSearchSettings(simulations, threshold, seed))
        if baseline == "cma_es":
            return methods.searched(objective, space, CmaEsSettings(simulations, threshold, seed))
        known = methods.first_start(fit, space)
        if known is not None:
            return known
        adam = AdamSettings(
            learning_rate=float(told.get("learning_rate") or objective.scenario.learning_rate),
            max_steps=simulations - 1,
            threshold=threshold,
            seed=fit.measure.seed,
            resample=bool(told.get("resample", False)),
        )
        return methods.single_start(objective, space, adam)
    except DiffCloudError as error:
        return Gap(baseline, str(error))
