"""A finished fit, as a person reads it and as files keep it."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import diffcloud
from diffcloud.errors import ConfigError
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import NUISANCE, FitSpace
from diffcloud.fit.solvers import SOLVER_NAMES, FitOutcome, Settings
from diffcloud.io.files import read_json, together, write_json, write_npz
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS

_SCHEMA = 2


@dataclass(frozen=True)
class FitResult:
    """What `write_fit` stores."""

    summary: dict[str, Any]
    """The JSON file."""
    positions: NDArray[np.float64]
    """[T + 1, V, 3] fitted nodes at each frame, in the scene's unit."""
    start_positions: NDArray[np.float64]
    """[T + 1, V, 3] nodes at the first start's parameters."""
    faces: NDArray[np.int64]
    """[F, 3]"""
    times: NDArray[np.float64]
    """[T + 1] [s]"""
    bodies: SurfaceMesh
    """Fixed bodies around the cloth, without tables."""


def physical_values(scenario: Scenario, values: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Each parameter with what it means: multiplier, physical value and unit (SI if the scene is)."""
    described: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
        if name in NUISANCE:
            described[name] = {"value": value, "unit": NUISANCE[name], "physical": value, "physical_unit": NUISANCE[name]}
            continue
        parameter = PARAMETERS[name]
        basis = parameter.basis
        described[name] = {
            "value": value,
            "unit": parameter.unit if basis is None else "x basis",
            "physical": value if basis is None else value * scenario.scene.basis(basis),
            "physical_unit": parameter.unit,
            "meaning": parameter.meaning,
        }
    return described


def describe_fit(
    objective: Objective,
    space: FitSpace,
    settings: Settings,
    outcome: FitOutcome,
    *,
    episodes: list[str],
    resampled_seeds: int = 4,
) -> FitResult:
    """Simulate the result and put everything together.

    `loss` is on the fit's own random points; `loss_resampled` is the mean over fresh draws, which the fit could not adapt
    to.
    """
    scenario = objective.scenario
    all_values = {**outcome.values, **space.fixed}
    bounds = {variable.name: [variable.low, variable.high] for variable in space.variables}
    parameters = physical_values(scenario, all_values)
    for name, entry in parameters.items():
        entry |= {"fixed": name in space.fixed, "bounds": bounds.get(name)}
        if name in bounds:
            low, high = bounds[name]
            entry["at_bound"] = bool(min(outcome.values[name] - low, high - outcome.values[name]) < 0.01 * (high - low))

    def batch(values: Mapping[str, float]) -> dict[str, torch.Tensor]:
        return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}

    def split(values: Mapping[str, float]) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        tensors = batch(values)
        return (
            {name: value for name, value in tensors.items() if name not in NUISANCE},
            {name: value for name, value in tensors.items() if name in NUISANCE},
        )

    history = outcome.history
    start_values = outcome.start | dict(space.fixed)
    with torch.no_grad():
        frame_steps = scenario.scene.frame_steps
        fitted, offset = split(all_values)
        runs = [objective.simulate(fitted, episode=index) for index in range(objective.episode_count)]
        run, start = runs[0], objective.simulate(split(start_values)[0])
        resampled = []
        for seed in range(1, resampled_seeds + 1):
            objective.reseed(settings.seed + 10_000 + seed)
            losses = [objective.frame_losses(one, offset, episode=index) for index, one in enumerate(runs)]
            resampled.append(float(torch.stack([loss.mean() for loss in losses]).mean()))
        objective.reseed(settings.seed)
    unit = scenario.length_unit_m
    summary = {
        "schema": _SCHEMA,
        "scenario": scenario.name,
        "episodes": episodes,
        "solver": SOLVER_NAMES[type(settings)],
        "loss": outcome.loss,
        "loss_start": outcome.loss_start,
        "loss_resampled": float(np.mean(resampled)),
        "loss_unit": "squared length unit, mean over simulated points",
        "rms_mm": 1e3 * unit * outcome.loss**0.5,
        "length_unit_m": unit,
        "iterations": outcome.iterations,
        "evaluations": outcome.evaluations,
        "seconds": outcome.seconds,
        "stop_reason": outcome.stop_reason,
        "parameters": parameters,
        "start": start_values,
        "best_start": outcome.best_start,
        "settings": {
            **{name: value for name, value in asdict(settings).items() if name != "init"},
            "points": objective.point_count,
            "frames": list(objective.frames),
        },
        "history": {
            "names": list(history.names),
            "loss": [[_finite(value) for value in row.tolist()] for row in history.losses],
            "values": [[[_finite(value) for value in start] for start in row.tolist()] for row in history.values],
            "gradient_norm": [[_finite(value) for value in row.norm(dim=-1).tolist()] for row in history.gradients],
        },
        "failures": list(outcome.failures),
        "versions": {"diffcloud": diffcloud.__version__, "torch": torch.__version__, "python": platform.python_version()},
    }
    return FitResult(
        summary=summary,
        positions=run.positions[0, ::frame_steps].cpu().numpy(),
        start_positions=start.positions[0, ::frame_steps].cpu().numpy(),
        faces=objective.system.mesh.faces,
        times=run.times[::frame_steps].cpu().numpy(),
        bodies=scenario.scene.bodies,
    )


def write_fit(folder: Path, name: str, result: FitResult) -> Path:
    """Write `<name>.npz` (trajectory) and `<name>.json` together; returns the latter."""
    path = Path(folder) / f"{name}.json"
    with together():
        write_npz(
            path.with_suffix(".npz"),
            nodes=result.positions,
            start_nodes=result.start_positions,
            faces=result.faces,
            times=result.times,
            obstacle_nodes=result.bodies.nodes,
            obstacle_faces=result.bodies.faces,
        )
        write_json(path, result.summary)
    return path


def read_fit(path: Path) -> dict[str, Any]:
    """The JSON summary of a fit.

    Raises:
        ConfigError: missing, damaged, not a fit, or one of another version.
    """
    summary = read_json(path, error=ConfigError)
    if not isinstance(summary, dict) or "parameters" not in summary or "loss" not in summary:
        raise ConfigError(f"{path} is not a fit written by `diffcloud fit`: it lacks `parameters` or `loss`.")
    if summary.get("schema") != _SCHEMA:
        raise ConfigError(
            f"{path} was written by another version (schema {summary.get('schema')}, read here: {_SCHEMA}); fit again."
        )
    return summary


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
