"""Measuring a fit: on its own frames with fresh points, on frames it never saw, and against the truth where known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import NUISANCE
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario


def measure_fit(
    scenario: Scenario, episodes: Sequence[Episode], summary: Mapping[str, Any], *, draws: int, seed: int
) -> dict[str, Any]:
    """One row of the table of fits.

    Args:
        summary: of `result.read_fit`.
        draws: fresh point samples to average over.
        seed: of the first draw.

    Returns:
        Losses in squared length units and as RMS in millimetres; fitted and true parameters; the stretch-to-mass ratio,
        which is what a motion identifies best.
    """
    fitted = {name: float(entry["value"]) for name, entry in summary["parameters"].items()}
    start = {name: float(value) for name, value in summary["start"].items()}
    frames = summary["settings"]["frames"]
    counts = {episode.frame_count for episode in episodes}
    used = {frame % min(counts) for frame in frames}
    last = scenario.steps * scenario.scene.time_step
    others = [f for f in range(1, min(counts)) if f not in used and episodes[0].times[f] <= last + 1e-6]
    points = summary["settings"]["points"]
    own = Objective(scenario, episodes, frames=frames, points=points)
    loss_start, loss = _mean_losses(own, (start, fitted), draws, seed)
    row: dict[str, Any] = {"loss_start": loss_start, "loss": loss}
    if others:
        other = Objective(scenario, episodes, frames=others, points=points)
        row["loss_other_frames"] = _mean_losses(other, (fitted,), 1, seed)[0]
    to_mm = 1e3 * scenario.length_unit_m
    row["rms_start_mm"] = to_mm * loss_start**0.5
    row["rms_mm"] = to_mm * loss**0.5
    row["rms_other_frames_mm"] = to_mm * row["loss_other_frames"] ** 0.5 if others else float("nan")
    row |= {f"fitted_{name}": value for name, value in fitted.items()}
    truth = episodes[0].meta.get("truth") or {}
    row |= {f"true_{name}": float(value) for name, value in truth.items() if name in fitted}
    if {"stretch", "mass"} <= set(fitted):
        row["fitted_ratio"] = fitted["stretch"] / fitted["mass"]
        if {"stretch", "mass"} <= set(truth):
            row["true_ratio"] = float(truth["stretch"]) / float(truth["mass"])
    return row


def _mean_losses(objective: Objective, sets: Sequence[Mapping[str, float]], draws: int, seed: int) -> list[float]:
    """Losses of parameter sets [len(sets)], averaged over fresh points."""
    names = list(sets[0])
    tensors = {
        name: torch.tensor([values.get(name, 0.0) for values in sets], dtype=objective.system.dtype) for name in names
    }
    nuisance = {name: tensors.pop(name) for name in names if name in NUISANCE}
    found = []
    with torch.no_grad():
        runs = [objective.simulate(tensors, episode=index) for index in range(objective.episode_count)]
        for draw in range(draws):
            objective.reseed(seed + draw)
            losses = [objective.frame_losses(run, nuisance, episode=index).mean(-1) for index, run in enumerate(runs)]
            found.append(torch.stack(losses).mean(0).numpy())
    return [float(value) for value in np.mean(found, axis=0)]
