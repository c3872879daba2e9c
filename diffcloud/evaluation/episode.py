"""Everything the comparison says of one episode: methods, gaps, transfer, identifiability, landscape."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from diffcloud.errors import DiffCloudError
from diffcloud.evaluation import methods
from diffcloud.evaluation.identifiability import identify, node_set_note
from diffcloud.evaluation.landscape import loss_landscape
from diffcloud.evaluation.methods import Estimate, Gap, Rival
from diffcloud.evaluation.metrics import EpisodeMeter, success_threshold
from diffcloud.fit import AdamSettings, CmaEsSettings, FitSpace, Objective, RandomSearchSettings
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario

RIVALS: tuple[Rival, ...] = ("single_start", "middle", "random_search", "cma_es")


@dataclass(frozen=True)
class ComparisonSettings:
    """Of `compare_episode`."""

    rivals: Sequence[Rival] = RIVALS
    draws: int = 4
    """Fresh point samples that losses are averaged over."""
    seed: int = 1000
    """Of the first of them; searches use it too."""
    identifiability: bool = True
    landscape_size: int = 0
    """Places along each axis of the loss landscape; 0: none."""


@dataclass(frozen=True)
class EpisodeRecord:
    """What was found."""

    record: dict[str, Any]
    """Plain values, the same for the same inputs: scenario, episode, its fit, labels, `start` (metrics of the fit's start,
    None if that diverges), `methods` (a row each: values, clipped values, metrics, simulations), `gaps`, `transfers`,
    `identifiability`, `landscape`."""
    seconds: dict[str, dict[str, float]]
    """Method -> phase -> wall time."""


def compare_episode(
    scenario: Scenario,
    episode: Episode,
    summary: Mapping[str, Any],
    *,
    name: str,
    fit_name: str | None = None,
    predictions: Sequence[Estimate | Gap] = (),
    transfers: Mapping[str, Mapping[str, float]] | None = None,
    settings: ComparisonSettings | None = None,
) -> EpisodeRecord:
    """Compare all methods on one episode.

    Args:
        summary: the fit of the episode (`fit.result.read_fit`); its frames, points, bounds, given parameters and number of
            iterations hold for every method.
        fit_name: of the fit, if it is another than the episode's: a joint fit has several episodes.
        predictions: of networks, and why those that should be there are not.
        transfers: episode -> parameters fitted on it, of other recordings of the same fabric.
    """
    settings = settings or ComparisonSettings()
    fit = summary["settings"]
    measure = {name: fit[name] for name in ("frames", "points", "paper", "nuisance")}
    space = methods.space_of(summary)
    objective = Objective(scenario, [episode], **measure, seed=int(fit["seed"]))
    told: list[Estimate | Gap] = [methods.fitted(summary)]
    told += [_run(rival, objective, space, summary, settings.seed) for rival in settings.rivals]
    told += [*predictions, *methods.published(episode.meta)]
    estimates = [entry for entry in told if isinstance(entry, Estimate)]
    gaps = [entry for entry in told if isinstance(entry, Gap)]
    meter = EpisodeMeter(scenario, episode, **measure, draws=settings.draws, seed=settings.seed)
    sources = dict(transfers or {})
    sets = [methods.clipped(values, space) for values in (*(e.values for e in estimates), *sources.values())]
    measured = meter.measure([*sets, {key: float(value) for key, value in summary["start"].items()}])
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
        "frames": list(objective.frames()),
        "starts": int(fit.get("starts", 1)),  # a search is one
        "start": None if len(sets) in measured.diverged else measured.rows[-1],
        "methods": rows,
        "gaps": [{"method": gap.method, "reason": gap.reason, "expected": gap.expected} for gap in gaps],
        "failures": list(summary["failures"]),
        "transfers": transferred,
        "identifiability": None,
        "landscape": None,
    }
    if 0 in measured.diverged:  # the fit itself: there is no optimum to look around
        return EpisodeRecord(record, seconds)
    if settings.identifiability:
        record["identifiability"] = identify(objective, space, best, draws=settings.draws)
        record["identifiability"]["note"] = node_set_note(scenario)
    objective.reseed(int(fit["seed"]))
    if settings.landscape_size:
        record["landscape"] = loss_landscape(objective, space, best, summary["history"], size=settings.landscape_size)
    return EpisodeRecord(record, seconds)


def _run(rival: Rival, objective: Objective, space: FitSpace, summary: Mapping[str, Any], seed: int) -> Estimate | Gap:
    """One rival with the budget of the fit, or of one start of Adam; a gap if its simulations fail."""
    fit = summary["settings"]
    by_adam = summary["solver"] == "adam"
    simulations, threshold = int(fit["iterations"]) + 1 if by_adam else int(summary["evaluations"]), float(fit["threshold"])
    objective.reseed(int(fit["seed"]))
    try:
        if rival == "middle":
            return methods.middle(space)
        if rival == "random_search":
            return methods.searched(objective, space, RandomSearchSettings(simulations, threshold, seed))
        if rival == "cma_es":
            return methods.searched(objective, space, CmaEsSettings(simulations, threshold, seed))
        known = methods.first_start(summary, space)
        if known is not None:
            return known
        adam = AdamSettings(
            learning_rate=float(fit["learning_rate"] if by_adam else objective.scenario.learning_rate),
            iterations=simulations - 1,
            threshold=threshold,
            seed=int(fit["seed"]),
            resample=bool(fit.get("resample", False)),
        )
        return methods.single_start(objective, space, adam)
    except DiffCloudError as error:
        return Gap(rival, str(error))
