"""`diffcloud rollout`: simulate a scenario, a scene, or a fit, and export the motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer

from diffcloud.cli.console import JsonFlag, assignments, errors, finish, progress_bar, warn, writes
from diffcloud.cli.scenario_options import ScenarioName, SceneFile, choose_scenario, fitted_scenario, limits
from diffcloud.errors import ConfigError, DivergedError
from diffcloud.estimation.inputs import Inputs
from diffcloud.estimation.record import RecordingFit, read_fit
from diffcloud.estimation.result import recorded_pose
from diffcloud.estimation.targets import track_displacement
from diffcloud.io.clouds import write_ply
from diffcloud.io.episodes import Episode, read_episode
from diffcloud.io.files import together, write_npz
from diffcloud.io.obj import write_cloth, write_surface
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.sim.moved import moved_surfaces
from diffcloud.sim.properties import check_values, one_set


@writes(".npz")
def rollout(
    out: Annotated[
        Path,
        typer.Option(
            help="NPZ: nodes [T+1, V, 3], faces [F, 3], times [T+1]; of obstacles that stand obstacle_nodes [N, 3], "
            "obstacle_faces; of those that move moving_nodes [T+1, M, 3], moving_faces."
        ),
    ],
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="PARAMETER=VALUE, repeatable.")] = None,
    fit: Annotated[Path | None, typer.Option(help="JSON of a fit: its parameters, in the frame of its recording.")] = None,
    episode: Annotated[Path | None, typer.Option(help="Episode whose gripper track moves the handles.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, max=100_000, help="Frames to simulate.")] = None,
    obj: Annotated[
        Path | None, typer.Option(help="Folder for one OBJ a frame, 000.obj, ...; what moves beside is in 000_moving.obj.")
    ] = None,
    ply: Annotated[Path | None, typer.Option(help="Folder for the same as PLY meshes.")] = None,
    json: JsonFlag = False,
) -> None:
    """Simulate and export a motion."""
    fitted = None if fit is None else read_fit(fit)
    if fit is not None and fitted is not None and scenario is None and scene is None:
        place = None if episode is None else fitted.known_place(episode.stem)
        scenario = fitted_scenario(fit, fitted.episodes[place or 0].scenario)
    chosen = choose_scenario(scenario, scene)
    values: dict[str, float] = {}
    if fitted is not None:
        values |= fitted.values
    values |= assignments(set_, "--set")
    check_values(values, "--set")
    chosen.check_parameters(values)
    frames = frames or chosen.frames
    steps = frames * chosen.scene.frame_steps
    system, _ = chosen.scene.build()
    recording = None if fitted is None else _recording(fitted.episodes, chosen.name, episode)
    laid = {} if fitted is None else fitted.laid_in(recording)
    track, warnings = None, limits(chosen)
    if episode is not None:
        recorded = read_episode(episode)
        if recorded.gripper is None:
            raise ConfigError(f"{episode} has no gripper track; leave --episode out to use the scene's own motion.")
        warnings += _not_simulated(recorded, steps * system.time_step, chosen.scene.frame_time)
        track = torch.as_tensor(track_displacement(recorded, system.handles.grippers, steps, system.time_step))[None]
    with progress_bar("simulating", steps) as update, torch.no_grad():
        try:
            given = Inputs.of(chosen, system, steps, one_set({**values, **laid}), track)
            run = given.rollout(progress=lambda done: update(done, ""))
        except DivergedError as error:
            shown = ", ".join(f"{name}={value:g}" for name, value in values.items()) or "the basis material"
            raise DivergedError(error.step, error.entries, error.reason, shown) from error
    per_frame = slice(None, None, chosen.scene.frame_steps)
    nodes, times = run.positions[0, per_frame].numpy(), run.times[per_frame].numpy()
    moved, moved_faces = moved_surfaces(system, run)
    moved = moved[0, per_frame]
    bodies = chosen.scene.bodies
    if recording is not None:
        space, pose = recorded_pose(recording, length_unit_m=chosen.length_unit_m)
        nodes = space.moved_motion(run.at, run.times[per_frame], pose).numpy()
        moved = space.moved(torch.as_tensor(moved)[None], pose)[0].numpy()
        bodies = SurfaceMesh(space.moved(torch.as_tensor(bodies.nodes)[None], pose)[0].numpy(), bodies.faces)
    with together():
        for index, frame in enumerate(nodes):
            if obj is not None:
                write_cloth(obj / f"{index:03d}.obj", system.mesh, frame)
            if ply is not None:
                write_ply(ply / f"{index:03d}.ply", frame, system.mesh.faces)
            if obj is not None and len(moved_faces):
                write_surface(obj / f"{index:03d}_moving.obj", SurfaceMesh(moved[index], moved_faces))
            if ply is not None and len(moved_faces):
                write_ply(ply / f"{index:03d}_moving.ply", moved[index], moved_faces)
        write_npz(
            out,
            nodes=nodes,
            faces=system.mesh.faces,
            times=times,
            obstacle_nodes=bodies.nodes,
            obstacle_faces=bodies.faces,
            moving_nodes=moved,
            moving_faces=moved_faces,
        )
    errors.print(f"Wrote {len(nodes)} frames of {nodes.shape[1]} nodes to {out}.")
    finish(
        {
            "out": str(out),
            "frames": frames,
            "nodes": nodes.shape[1],
            "parameters": values,
            "length_unit_m": chosen.length_unit_m,
            "warnings": warnings,
        },
        json,
    )


def _not_simulated(recorded: Episode, end_s: float, frame_s: float) -> list[str]:
    """Warn of what a recording shows after the end of the simulation."""
    within = int((recorded.times <= end_s + 0.5 * frame_s).sum())
    if within == recorded.frame_count:
        return []
    message = (
        f"{within} of the recording's {recorded.frame_count} frames lie within the {end_s:.3g} s that are simulated; "
        f"--frames {math.ceil(recorded.times[-1] / frame_s - 1e-6)} covers all."
    )
    warn(message)
    return [message]


def _recording(known: Sequence[RecordingFit], scenario: str, episode: Path | None) -> RecordingFit | None:
    """The recording of a fit in whose frame the motion is written; None where the scene's own frame stays."""
    of_scenario = {one.name: one for one in known if one.scenario == scenario}
    if episode is None and of_scenario:
        first = next(iter(of_scenario))
        if len(of_scenario) > 1:
            errors.print(f"The motion lies where {first} has it, the first of the fit's recordings.")
        return of_scenario[first]
    name = scenario if episode is None else episode.stem
    if name not in of_scenario:
        told = ", ".join(f"{one.scenario}/{one.name}" for one in known)
        errors.print(
            f"{name} is not among the fit's recordings ({told}): its pose is not known, and the motion stays in the frame "
            "of the scene."
        )
    return of_scenario.get(name)
