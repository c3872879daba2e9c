"""Description and output of a finished fit, which is simulated once more for this."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from diffcloud.errors import ConfigError, DivergedError
from diffcloud.estimation.initial_state import described_initial_state, is_initial_state
from diffcloud.estimation.joint import AnyObjective, mean_loss
from diffcloud.estimation.likelihood import Estimate
from diffcloud.estimation.names import of_recording
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.pose import PoseSpace
from diffcloud.estimation.record import (
    LARGEST,
    EstimateRecord,
    FitRecord,
    FittedParameter,
    Followed,
    History,
    Measure,
    RecordingFit,
    WholeMaterial,
)
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.solvers import SOLVER_NAMES, FitOutcome, Settings
from diffcloud.io.arrays import read_npz
from diffcloud.io.files import together, write_json, write_npz
from diffcloud.io.timings import write_timings
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS, one_set
from diffcloud.sim.simulate import Rollout

_AT_BOUND = 0.01
"""A value counts as at its bound within this fraction of the range, logarithmic if no bound is zero."""
_FARTHEST = 1e6
"""Largest plausible coordinate or time in a motion file."""


@dataclass(frozen=True)
class FittedMotion:
    """Simulation with the fitted parameters and pose, in the scene's unit and the recording's frame."""

    nodes: NDArray[np.float64]
    """[T + 1, V, 3] cloth nodes at each frame, up to the end of the motion."""
    start_nodes: NDArray[np.float64]
    """[T + 1, V, 3] cloth nodes with the parameters of the first start, at their best pose."""
    faces: NDArray[np.int64]
    """[F, 3] faces of the cloth."""
    times: NDArray[np.float64]
    """[T + 1] times of the frames [s]."""
    bodies: SurfaceMesh
    """Fixed bodies other than tables."""
    held: NDArray[np.int64]
    """[K] grasped or fixed nodes."""
    held_times: NDArray[np.float64]
    """[S + 1] times of all steps [s]."""
    held_nodes: NDArray[np.float64]
    """[S + 1, K, 3] positions of these nodes at all steps."""


@dataclass(frozen=True)
class FitResult:
    """Record and motions of a fit, as `write_fit` stores them."""

    record: FitRecord
    """Content of the JSON file."""
    motions: list[FittedMotion]
    """Content of the NPZ file, one motion per recording."""
    pressed: bool = False
    """Whether Ctrl-C was pressed after the last step. The result is complete, but the caller may want to stop."""


def physical_values(scenario: Scenario, values: Mapping[str, float]) -> dict[str, FittedParameter]:
    """Return each parameter with value, unit and meaning.

    Args:
        values: parameter -> multiplier, or value for a parameter without a multiplier.
    """
    return {
        name: FittedParameter(
            value=value * (nominal := scenario.nominal(name)),
            unit=PARAMETERS[name].unit,
            meaning=PARAMETERS[name].meaning,
            nominal=nominal,
            multiplier=value,
        )
        for name, value in values.items()
    }


def whole_material(scenario: Scenario, values: Mapping[str, float]) -> WholeMaterial:
    """Return all material properties of a scenario with these parameter values; the others are nominal."""
    material = scenario.scene.material
    system, _ = scenario.scene.build()
    changed = scenario.properties(system, one_set(values))
    stretching = float((changed.stretching / system.properties.stretching).mean())  # without a pivot's faces
    bending = float(changed.bending.mean())
    area, weight = float(scenario.scene.mesh.face_area.sum()), float(changed.weight.sum())
    return WholeMaterial(
        density=weight / area,
        stretching=stretching * material.resting_stretching_stiffness,
        poisson=material.resting_poisson_ratio,
        shear=stretching * float(changed.shear) * material.resting_shear_stiffness,
        compression=float(changed.compression),
        bending=bending * material.resting_bending_stiffness,
        damping=float(changed.damping),
        friction=float(changed.friction),
        self_friction=float(changed.self_friction),
        air_density=float(changed.air_density),
        added_mass=max(float(changed.node_mass.sum()) - weight, 0.0) / area,
        linear_drag=float(changed.linear_drag),
    )


def describe_fit(
    objective: AnyObjective,
    space: FitSpace,
    settings: Settings,
    outcome: FitOutcome,
    *,
    episodes: Sequence[str],
    resampled_seeds: int = 4,
) -> FitResult:
    """Simulate the fitted parameters and build the record.

    Args:
        episodes: names of the recordings.
        resampled_seeds: number of point samples for `loss_resampled`.

    Raises:
        DivergedError: the motion diverges within the compared frames.
    """
    members, paper = objective.members, objective.paper
    first = members[0]
    values = {**outcome.values, **space.fixed}
    material = {name: value for name, value in values.items() if not is_initial_state(name)}
    start_values = outcome.start | dict(space.fixed)
    unit = first.scenario.length_unit_m
    with torch.no_grad():
        own = [(of_recording(values, index), of_recording(start_values, index)) for index in range(len(members))]
        both = (_as_far_as_both_go(member, *told) for member, told in zip(members, own, strict=True))
        runs, starts = zip(*both, strict=True)
        recordings = [
            describe_recording(member, run, name) for member, run, name in zip(members, runs, episodes, strict=True)
        ]
        for index, recording in enumerate(recordings):
            recording.nuisance |= described_initial_state(space.of_recording(index)[0], own[index][0], length_unit_m=unit)
        poses = [recorded_pose(recording, length_unit_m=unit)[1] for recording in recordings]
        motions = [
            _fitted_motion(member, run, start, pose)
            for member, run, start, pose in zip(members, runs, starts, poses, strict=True)
        ]
        resampled = []
        for seed in range(1, resampled_seeds + 1):
            objective.reseed(settings.seed + 10_000 + seed)
            losses = [
                member.frame_losses(run, pose=pose).mean() for member, run, pose in zip(members, runs, poses, strict=True)
            ]
            resampled.append(float(mean_loss(torch.stack(losses)[:, None], paper=paper)))
        objective.reseed(settings.seed)
    of_each = torch.tensor([[recording.loss] for recording in recordings], dtype=torch.float64)
    loss = float(mean_loss(of_each, paper=paper))  # computed separately, so it does not depend on a solver's batch
    record = FitRecord(
        scenario=first.scenario.name,
        episodes=recordings,
        nuisance=recordings[0].nuisance if len(recordings) == 1 else {},
        solver=SOLVER_NAMES[type(settings)],
        parameters=_parameters(first.scenario, space, material),
        material=whole_material(first.scenario, material),
        loss=loss,
        loss_start=outcome.loss_start,
        loss_resampled=float(np.mean(resampled)),
        rms_mm=_rms_mm(recordings, paper=paper),
        length_unit_m=unit,
        iterations=outcome.iterations,
        simulations=outcome.simulations,
        seconds=outcome.seconds,
        stop_reason=outcome.stop_reason,
        start=start_values,
        best_start=outcome.best_start,
        measure=Measure(
            paper=paper,
            nuisance=first.nuisance,
            frames=None if first.asked_frames is None else list(first.asked_frames),
            points=first.asked_points,
            seed=settings.seed,
        ),
        settings={name: value for name, value in asdict(settings).items() if name != "init"},
        history=_history(outcome),
        estimate=None if outcome.estimate is None else _estimate(outcome.estimate, members),
        failures=[*outcome.failures, *_cut_short(members, runs, episodes)],
    )
    return FitResult(record, motions)


def _rms_mm(recordings: Sequence[RecordingFit], *, paper: bool) -> float:
    """Average the RMS over all recordings in the same way as the losses."""
    if len(recordings) == 1:
        return recordings[0].rms_mm
    squares = torch.tensor([[recording.rms_mm**2] for recording in recordings], dtype=torch.float64)
    return float(mean_loss(squares, paper=paper)) ** 0.5


def describe_recording(objective: Objective, run: Rollout, name: str) -> RecordingFit:
    """Return the result for one recording."""
    unit, space, handles = objective.scenario.length_unit_m, objective.pose_space, objective.scenario.scene.handles
    motion = objective.match(run)
    losses, squares, ways = objective.losses(motion)[0], objective.squares(motion)[0], objective.way_squares(motion)
    cut = objective.cut
    to_mm = 1e3 * unit
    return RecordingFit(
        name=name,
        scenario=objective.scenario.name,
        loss=float(losses.mean()),
        rms_mm=to_mm * float(squares.mean()) ** 0.5,
        rms_to_recording_mm=to_mm * ways[0] ** 0.5,
        rms_to_cloth_mm=None if objective.paper else to_mm * ways[1] ** 0.5,
        grasp="" if handles.grasp is None else handles.grasp.described(len(set(handles.nodes))),
        frames=list(objective.frames),
        frame_rms_mm=(to_mm * squares.sqrt()).tolist(),
        counted=(motion.pairs[0].weights[0] > 0).double().mean(-1).tolist(),
        cut_m=None if cut is None else cut * unit,
        nuisance=space.described(motion.pose[0], length_unit_m=unit),
        centre=cast(tuple[float, float, float], tuple(space.centre.tolist())),
        clocks=dict(space.clocks),
    )


def recorded_pose(recording: RecordingFit, *, length_unit_m: float) -> tuple[PoseSpace, Tensor]:
    """Return the pose variables of a recorded fit and their values [1, d]."""
    priors = {name: entry.prior for name, entry in recording.nuisance.items() if entry.of == "pose"}
    centre = torch.tensor(recording.centre, dtype=torch.float64)
    space = PoseSpace.build(priors, centre, length_unit_m=length_unit_m, clocks=recording.clocks)
    return space, space.of(recording.nuisance, length_unit_m=length_unit_m)[None]


def write_fit(folder: Path, name: str, result: FitResult) -> Path:
    """Write `<name>.npz` and `<name>.json` together, and return the path of the latter. The arrays are nodes,
    start_nodes, faces, times, obstacle_nodes, obstacle_faces, held, held_times and held_nodes. A second recording has
    nodes_1 and so on."""
    path = Path(folder) / f"{name}.json"
    arrays: dict[str, Any] = {}
    for index, motion in enumerate(result.motions):
        told = {
            "nodes": motion.nodes,
            "start_nodes": motion.start_nodes,
            "faces": motion.faces,
            "times": motion.times,
            "obstacle_nodes": motion.bodies.nodes,
            "obstacle_faces": motion.bodies.faces,
            "held": motion.held,
            "held_times": motion.held_times,
            "held_nodes": motion.held_nodes,
        }
        arrays |= {_key(key, index): array for key, array in told.items()}
    with together():
        if result.record.seconds is not None:
            write_timings(path, result.record.seconds)
        write_npz(path.with_suffix(".npz"), **arrays)
        write_json(path, result.record.plain())
    return path


def read_motion(path: Path, index: int = 0) -> FittedMotion:
    """Read one motion from a fit's NPZ file.

    Args:
        index: index of the recording.

    Raises:
        ConfigError: the file is missing, damaged, or not a motion.
    """
    keys = (
        "nodes", "start_nodes", "faces", "times", "obstacle_nodes", "obstacle_faces", "held", "held_times", "held_nodes",
    )  # fmt: skip
    named = {key: _key(key, index) for key in keys}
    told = read_npz(path, kind="motion of a fit", error=ConfigError, names=named.values())
    found = {key: told[name] for key, name in named.items()}
    _check_motion(path, found)
    bodies = SurfaceMesh(found.pop("obstacle_nodes"), found.pop("obstacle_faces"))
    return FittedMotion(**found, bodies=bodies)


def _check_motion(path: Path, found: Mapping[str, NDArray[Any]]) -> None:
    """Check the arrays of a motion file.

    Raises:
        ConfigError: an array has a wrong shape, type or value.
    """
    frames, held, steps = (found[key].size for key in ("times", "held", "held_times"))
    cloth = found["nodes"].shape[1] if found["nodes"].ndim == 3 else 0
    bodies = len(np.atleast_1d(found["obstacle_nodes"]))
    shapes = {
        "nodes": (frames, cloth, 3), "start_nodes": (frames, cloth, 3), "faces": (-1, 3), "times": (frames,),
        "obstacle_nodes": (-1, 3), "obstacle_faces": (-1, 3), "held": (held,), "held_times": (steps,),
        "held_nodes": (steps, held, 3),
    }  # fmt: skip
    points = {"faces": cloth, "obstacle_faces": bodies, "held": cloth}  # among which these arrays choose
    least = {"faces": 1, "times": 2, "held_times": 2}
    for key, shape in shapes.items():
        array = found[key]
        right = array.ndim == len(shape) and all(want in (-1, got) for want, got in zip(shape, array.shape, strict=True))
        right = right and len(array) >= least.get(key, 0) and array.dtype.kind in ("iu" if key in points else "f")
        if right and key in points:
            right = bool(((array >= 0) & (array < points[key])).all())
        elif right:
            right = bool((np.abs(array) < _FARTHEST).all())  # no NaN either
        if right and key.endswith("times"):
            right = bool((np.diff(array) > 0).all())
        if not right:
            raise ConfigError(
                f"{path} is no motion of a fit: its {key} {list(array.shape)} {array.dtype} are not as `diffcloud fit` "
                "writes them; fit again."
            )
    if len(np.unique(found["held"])) < held:
        raise ConfigError(f"{path} is no motion of a fit: it holds a node twice; fit again.")


def _key(name: str, index: int) -> str:
    return name if index == 0 else f"{name}_{index}"


def _fitted_motion(objective: Objective, run: Rollout, start: Rollout, pose: Tensor) -> FittedMotion:
    scene = objective.scenario.scene
    held = np.unique(scene.handles.nodes).astype(np.int64)
    return FittedMotion(
        nodes=objective.posed_nodes(run, pose),
        start_nodes=objective.posed_nodes(start, objective.pose(start)),
        faces=objective.system.mesh.faces,
        times=run.times[:: scene.frame_steps].cpu().numpy(),
        bodies=SurfaceMesh(objective.posed_bodies(pose), scene.bodies.faces),
        held=held,
        held_times=run.times.cpu().numpy(),
        held_nodes=objective.posed_nodes(run, pose, steps=True)[:, held],
    )


def _as_far_as_both_go(
    objective: Objective, values: Mapping[str, float], start_values: Mapping[str, float]
) -> tuple[Rollout, Rollout]:
    """Return the rollouts with the fitted and the first values over the whole scenario. If one diverges, both end at
    the last frame before. If the first values diverge within the compared frames, the fitted ones replace them.

    Raises:
        DivergedError: the fitted values diverge within the compared frames.
    """
    run = _as_far_as_it_goes(objective, values, objective.scenario.steps)
    try:
        start = _as_far_as_it_goes(objective, start_values, len(run.times) - 1)
    except DivergedError:
        return run, run
    if len(start.times) < len(run.times):
        run = _as_far_as_it_goes(objective, values, len(start.times) - 1)
    return run, start


def _as_far_as_it_goes(objective: Objective, values: Mapping[str, float], steps: int) -> Rollout:
    """Return the longest rollout that does not diverge.

    Raises:
        DivergedError: the motion diverges within the compared frames.
    """
    each = objective.scenario.scene.frame_steps
    while True:
        try:
            return objective.simulate(one_set(values), steps=steps)
        except DivergedError as error:
            reached = max((error.step - 1) // each * each, objective.loss_steps)
            if reached >= steps:
                raise
            steps = reached


def _cut_short(members: Sequence[Objective], runs: Sequence[Rollout], episodes: Sequence[str]) -> list[str]:
    """Return messages about motions that end before the scenario does."""
    ends = [float(run.times[-1]) for run in runs]
    return [
        f"{name}: the motion is recorded up to {end:.2f} s; after the compared frames it diverges, with the fitted or the "
        "first values"
        for name, member, run, end in zip(episodes, members, runs, ends, strict=True)
        if len(run.times) <= member.scenario.steps
    ]


def _parameters(scenario: Scenario, space: FitSpace, values: Mapping[str, float]) -> dict[str, FittedParameter]:
    found = physical_values(scenario, values)
    for name in space.fixed:
        found[name].fixed = True
    for variable in (one for one in space.variables if one.name in values):
        entry, bounds = found[variable.name], (variable.low, variable.high)
        entry.bounds = (variable.low * entry.nominal, variable.high * entry.nominal)
        entry.prior, entry.centre = variable.prior, variable.centre * entry.nominal
        entry.role = variable.role
        low, high, here = (math.log(one) if variable.low > 0 else one for one in (*bounds, entry.multiplier))
        entry.at_bound = min(here - low, high - here) < _AT_BOUND * (high - low)
    return found


def _estimate(found: Estimate, members: Sequence[Objective]) -> EstimateRecord:
    asked = [index for index, one in enumerate(found.space.variables) if not one.nuisance]
    axis, names = Axis.of(found.space), [found.space.names[index] for index in asked]

    def told(place: Tensor) -> dict[str, float]:
        return dict(zip(names, axis.bounded(place[: len(found.space.names)])[asked].tolist(), strict=True))

    scenario = members[0].scenario
    grasp = None if found.grip is None else scenario.scene.handles.grasp
    return EstimateRecord(
        grip_m=None if grasp is None else grasp.size * scenario.length_unit_m,
        mean=told(found.mean),
        sources={name: part[asked][:, asked].tolist() for name, part in found.sources.items()},
        starts=[told(one.place) for one in found.answers],
        weights=found.weights.tolist(),
        recordings=[
            Followed(
                horizon_s=float(member.times.max()),
                departs=departs,
                chi_squares=chi_squares,
                finer_mm=[1e3 * apart for apart in apart_m],
            )
            for member, departs, chi_squares, apart_m in zip(
                members, found.departs, found.best.chi_squares, found.best.apart_m, strict=True
            )
        ],
    )


def _history(outcome: FitOutcome) -> History:
    history = outcome.history
    return History(
        names=list(history.names),
        loss=[_finite(row.tolist()) for row in history.losses],
        values=[[_finite(start) for start in row.tolist()] for row in history.values],
        gradient_norm=[_finite(row.norm(dim=-1).tolist()) for row in history.gradients],
    )


def _finite(row: list[float]) -> list[Any]:
    return [value if abs(value) <= LARGEST else None for value in row]
