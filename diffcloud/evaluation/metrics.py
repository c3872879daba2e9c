"""Metrics of a parameter set on an episode: distances to the recorded clouds, success, error of known parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import torch

from diffcloud.clouds.losses import chamfer
from diffcloud.estimation.batches import without_diverged
from diffcloud.estimation.objective import Objective
from diffcloud.scene.scenarios import PAPER_THRESHOLD, RELEASE_UNIT_M, Scenario


def success_threshold(scenario: Scenario) -> float:
    """Return the paper's threshold, 0.0005 squared release units, in the scenario's squared length unit."""
    return PAPER_THRESHOLD * (RELEASE_UNIT_M / scenario.length_unit_m) ** 2


@dataclass(frozen=True)
class Measured:
    """Metrics of a batch of parameter sets."""

    rows: list[dict[str, Any]]
    """Metric -> value for each set, empty if it diverged; see `EpisodeMeter.measure`."""
    diverged: dict[int, str]
    """Index of a set -> message."""


class EpisodeMeter:
    """Measures parameter sets on one episode with the same simulator, frames and sample points. The points are newly
    sampled, so no method was fitted to them."""

    def __init__(self, objective: Objective, *, draws: int = 4, seed: int = 1000) -> None:
        """Prepare the measurement.

        Args:
            objective: objective whose loss is used; it is not changed.
            draws: number of point samples over which distances are averaged.
            seed: seed of the first sample.
        """
        scenario, episode = objective.scenario, objective.episode
        self.scenario, self.episode = scenario, episode
        self._own = copy(objective)
        last = scenario.steps * scenario.scene.time_step + 1e-6
        # frame 0 is before the motion and the same for all parameters
        used = objective.frames
        others = [f for f in range(1, episode.frame_count) if f not in used and episode.times[f] <= last]
        measure: dict[str, Any] = {
            "points": objective.asked_points,
            "paper": objective.paper,
            "nuisance": objective.nuisance,
        }
        self._others = Objective(scenario, episode, frames=others, seed=seed, **measure) if others else None
        self._seeds = range(seed, seed + draws)

    def measure(self, sets: Sequence[Mapping[str, float]]) -> Measured:
        """Return metrics of parameter sets, each within its bounds.

        Rows have
            loss, loss_deviation: mean and standard deviation over the samples, at the fit's frames [squared length
                unit];
            rms_mm: root mean square distance in millimetres;
            loss_other_frames, rms_other_frames_mm: at the frames that the fit did not use, for one sample; missing if
                there are none, or if the motion diverges after the fit's frames;
            two_sided: Chamfer distance in both directions at the fit's frames, for one sample;
            success, error_<parameter> (relative), error_ratio (stretching over density): if the true parameters are
                known.
        """
        with torch.no_grad():
            found, kept, late = without_diverged(len(sets), lambda index: self._distances([sets[i] for i in index]))
            of_all, rest = kept.tolist(), list(late)
            # sets that diverge after the fit's own frames are measured at these frames only
            at_own, kept, lost = without_diverged(
                len(rest), lambda index: self._distances([sets[rest[i]] for i in index], others=False)
            )
        rows: list[dict[str, Any]] = [{} for _ in sets]
        every = [*of_all, *(rest[index] for index in kept.tolist())]
        for index, distances in zip(every, [*(found or []), *(at_own or [])], strict=True):
            rows[index] = distances | self._against_truth(sets[index], distances["loss"])
        return Measured(rows, {rest[index]: message for index, message in lost.items()})

    def _distances(self, sets: Sequence[Mapping[str, float]], *, others: bool = True) -> list[dict[str, Any]]:
        """Return the distance metrics.

        Args:
            others: include the frames that the fit did not use.
        """
        own = self._own
        names = dict.fromkeys(name for values in sets for name in values)
        tensors = {name: torch.tensor([values.get(name, 0.0) for values in sets], dtype=torch.float64) for name in names}
        run = own.simulate(tensors, steps=None if others else own.loss_steps)
        own.reseed(self._seeds[0])
        pose = own.pose(run)
        points = own.points(run, pose=pose)  # [B, L, N, 3]
        both = [chamfer(points[:, frame], [cloud] * len(sets)) for frame, cloud in enumerate(own.clouds)]
        losses, squares = [], []
        for seed in self._seeds:
            own.reseed(seed)
            motion = own.match(run, pose=pose)
            losses.append(own.losses(motion).mean(-1))
            squares.append(own.squares(motion).mean(-1))
        every = torch.stack(losses)  # [draws, B]
        to_mm = 1e3 * self.scenario.length_unit_m
        columns = {
            "loss": every.mean(0),
            "loss_deviation": every.std(0, correction=1 if len(losses) > 1 else 0),
            "rms_mm": to_mm * torch.stack(squares).mean(0).sqrt(),
            "two_sided": torch.stack(both).mean(0),
        }
        if others and self._others is not None:
            motion = self._others.match(run, pose=pose)
            elsewhere = self._others.squares(motion).mean(-1)
            columns |= {
                "loss_other_frames": self._others.losses(motion).mean(-1),
                "rms_other_frames_mm": to_mm * elsewhere.sqrt(),
            }
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return [dict(zip(columns, row, strict=True)) for row in rows]

    def _against_truth(self, values: Mapping[str, float], loss: float) -> dict[str, Any]:
        truth = {name: float(value) for name, value in (self.episode.meta.get("truth") or {}).items() if name in values}
        if not truth:
            return {}
        row: dict[str, Any] = {"success": bool(loss < success_threshold(self.scenario))}
        row |= {f"error_{name}": abs(values[name] / value - 1) for name, value in truth.items() if value}
        if {"stretching", "density"} <= truth.keys():
            row["error_ratio"] = abs(
                values["stretching"] * truth["density"] / (values["density"] * truth["stretching"]) - 1
            )
        return row
