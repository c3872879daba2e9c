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
from diffcloud.fit.parameters import FitSpace
from diffcloud.fit.pose import PoseSpace
from diffcloud.fit.solvers import SOLVER_NAMES, FitOutcome, Settings
from diffcloud.io.files import read_json, together, write_json, write_npz
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.simulate import Rollout

_SCHEMA = 3


@dataclass(frozen=True)
class FitResult:
    """What `write_fit` stores."""

    summary: dict[str, Any]
    """The JSON file."""
    positions: NDArray[np.float64]
    """[T + 1, V, 3] fitted nodes at each frame, in the scene's unit and the first recording's frame: its pose applied."""
    start_positions: NDArray[np.float64]
    """[T + 1, V, 3] nodes at the first start's parameters, at the pose found with these."""
    faces: NDArray[np.int64]
    """[F, 3]"""
    times: NDArray[np.float64]
    """[T + 1] [s]"""
    bodies: SurfaceMesh
    """Fixed bodies around the cloth, without tables, in the first recording's frame."""


def physical_values(scenario: Scenario, values: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Each parameter with what it means: multiplier, physical value and unit (SI if the scene is)."""
    described: dict[str, dict[str, Any]] = {}
    for name, value in values.items():
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

    def motions(values: Mapping[str, float], episodes: int) -> list[Rollout]:
        sets = {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}
        return [objective.simulate(sets, episode=index) for index in range(episodes)]

    history = outcome.history
    start_values = outcome.start | dict(space.fixed)
    unit = scenario.length_unit_m
    with torch.no_grad():
        runs = motions(all_values, objective.episode_count)
        (start,) = motions(start_values, 1)
        recordings = {
            name: describe_recording(objective, run, episode=index)
            for index, (name, run) in enumerate(zip(episodes, runs, strict=True))
        }
        poses = [recorded_pose(recording, length_unit_m=unit)[1] for recording in recordings.values()]
        shown, shown_start = objective.posed_nodes(runs[0], poses[0]), objective.posed_nodes(start, objective.pose(start))
        resampled = []
        for seed in range(1, resampled_seeds + 1):
            objective.reseed(settings.seed + 10_000 + seed)
            losses = [
                objective.frame_losses(one, pose=pose, episode=index)
                for index, (one, pose) in enumerate(zip(runs, poses, strict=True))
            ]
            resampled.append(float(torch.stack([loss.mean() for loss in losses]).mean()))
        objective.reseed(settings.seed)
    loss = float(np.mean([recording["loss"] for recording in recordings.values()]))  # by itself, not in a solver's batch
    summary = {
        "schema": _SCHEMA,
        "scenario": scenario.name,
        "episodes": episodes,
        "recordings": recordings,
        "solver": SOLVER_NAMES[type(settings)],
        "loss": loss,
        "loss_start": outcome.loss_start,
        "loss_resampled": float(np.mean(resampled)),
        "loss_unit": "squared length unit, mean over points",
        "rms_mm": 1e3 * unit * loss**0.5,
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
            "paper": objective.paper,
            "nuisance": objective.nuisance,
            "points": objective.point_count,
            "frames": None if objective.asked_frames is None else list(objective.asked_frames),
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
        positions=shown,
        start_positions=shown_start,
        faces=objective.system.mesh.faces,
        times=runs[0].times[:: scenario.scene.frame_steps].cpu().numpy(),
        bodies=SurfaceMesh(objective.posed_bodies(poses[0]), scenario.scene.bodies.faces),
    )


def describe_recording(objective: Objective, run: Rollout, *, episode: int = 0) -> dict[str, Any]:
    """One recording beside the motion fitted to it, as plain values, in SI but for `loss` and `centre`.

    Returns:
        loss [squared length unit]; rms_mm, and in the default measure rms_to_recording_mm and rms_to_cloth_mm: each
        direction by itself; frames: that were compared; frame_rms_mm: of each; counted: part of the simulated points that
        count, in each; cut_m: height below which nothing was recorded; nuisance: name -> value, prior, unit; centre: of
        the recording, about which the scene is turned.
    """
    unit, space = objective.scenario.length_unit_m, objective.pose_space(episode)
    motion = objective.match(run, episode=episode)
    losses, ways = objective.losses(motion, episode=episode)[0], objective.way_losses(motion, episode=episode)
    cut = objective.cut(episode)
    names = ("rms_to_recording_mm", "rms_to_cloth_mm")
    return {
        "loss": float(losses.mean()),
        "rms_mm": 1e3 * unit * float(losses.mean()) ** 0.5,
        **{name: 1e3 * unit * loss**0.5 for name, loss in zip(names, ways, strict=False)},
        "frames": list(objective.frames(episode)),
        "frame_rms_mm": (1e3 * unit * losses.sqrt()).tolist(),
        "counted": (motion.pairs[0].weights[0] > 0).double().mean(-1).tolist(),
        "cut_m": None if cut is None else cut * unit,
        "nuisance": space.described(motion.pose[0], length_unit_m=unit),
        "centre": space.centre.tolist(),
    }


def recorded_pose(recording: Mapping[str, Any], *, length_unit_m: float) -> tuple[PoseSpace, torch.Tensor]:
    """The pose that a fit found for a recording, and its values [1, d].

    Args:
        recording: as of `describe_recording`.
    """
    described = recording["nuisance"]
    priors = {name: float(entry["prior"]) for name, entry in described.items()}
    centre = torch.tensor(recording["centre"], dtype=torch.float64)
    space = PoseSpace.build(priors, centre, length_unit_m=length_unit_m)
    return space, space.of(described, length_unit_m=length_unit_m)[None]


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
