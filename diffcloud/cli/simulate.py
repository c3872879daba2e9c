"""`diffcloud simulate`: the motion of a scene or of a fit, and how much it shows of the parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from diffcloud.cli.options import SCENE_HELP, JsonFlag, Threads
from diffcloud.console import assignments, errors, finish, output, progress_bar, show, warn, with_suffix
from diffcloud.errors import ConfigError, DivergedError

if TYPE_CHECKING:
    from diffcloud.estimation.record import FitRecord, RecordingFit
    from diffcloud.io.episodes import Episode
    from diffcloud.scene.scenarios import Scenario

_GRID = 5
"""Places along each axis of the sensitivity's map."""


def simulate(
    source: Annotated[str, typer.Argument(help=f"Scene, or the JSON of a fit. A scene is {SCENE_HELP}")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="NPZ: nodes [T+1, V, 3], faces [F, 3], times [T+1]; of obstacles that stand obstacle_nodes [N, 3], "
            "obstacle_faces; of those that move moving_nodes [T+1, M, 3], moving_faces. With --format: a folder of meshes."
        ),
    ] = None,
    set_: Annotated[list[str] | None, typer.Option("--set", help="PARAMETER=VALUE, repeatable.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, max=100_000, help="Frames to simulate.")] = None,
    track: Annotated[Path | None, typer.Option(help="Episode whose gripper track moves the handles.")] = None,
    format_: Annotated[
        Literal["npz", "obj", "ply"],
        typer.Option("--format", help="obj, ply: one mesh a frame, 000.obj, ...; what moves beside is in 000_moving.obj."),
    ] = "npz",
    sensitivity: Annotated[
        bool,
        typer.Option(
            "--sensitivity",
            help="Instead: how far nodes move [mm] between neighbouring values of stretching and density at the loss frame "
            "or over the track.",
        ),
    ] = False,
    noise_mm: Annotated[float, typer.Option(help="Of --sensitivity: larger differences count as visible.")] = 4.0,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Simulate a motion, of a scene with its nominal material or of a fit, and write it."""
    from diffcloud.io.episodes import read_episode
    from diffcloud.jobs.scenarios import choose_scenario, fitted_scenario, scene_named
    from diffcloud.sim.threads import use_threads

    use_threads(threads)
    fitted = _fit(source)
    recorded = None if track is None else read_episode(track)
    if fitted is None:
        chosen = scene_named(source)
    else:
        place = None if track is None else fitted.known_place(track.stem)
        chosen = choose_scenario(fitted_scenario(Path(source), fitted.episodes[place or 0].scenario))
    if sensitivity:
        _show_sensitivity(chosen, recorded, noise_mm, json)
        return
    if out is None:
        raise ConfigError("A motion needs a place: give --out motion.npz, or --out FOLDER --format obj.")
    _write_motion(chosen, fitted, recorded, track, set_, frames, out, format_, json)


def _fit(source: str) -> FitRecord | None:
    """The fit that a file holds; None if it is no JSON, or that of a scene."""
    from diffcloud.estimation.record import is_fit, read_fit

    path = Path(source)
    return read_fit(path) if source.endswith(".json") and is_fit(path) else None


def _write_motion(
    chosen: Scenario,
    fitted: FitRecord | None,
    recorded: Episode | None,
    track_file: Path | None,
    set_: list[str] | None,
    frames: int | None,
    out: Path,
    format_: str,
    json: bool,
) -> None:
    import torch

    from diffcloud.estimation.inputs import Inputs
    from diffcloud.estimation.result import recorded_pose
    from diffcloud.estimation.targets import track_displacement
    from diffcloud.io.clouds import write_ply
    from diffcloud.io.files import claimed, together, write_npz
    from diffcloud.io.obj import write_cloth, write_surface
    from diffcloud.jobs.scenarios import limits
    from diffcloud.mesh.topology import SurfaceMesh
    from diffcloud.sim.moved import moved_surfaces
    from diffcloud.sim.properties import one_set

    values = {} if fitted is None else dict(fitted.values)
    values |= chosen.multipliers(assignments(set_, "--set"), "--set")
    chosen.check_parameters(values)
    frames = frames or chosen.frames
    steps = frames * chosen.scene.frame_steps
    system, _ = chosen.scene.build()
    recording = None if fitted is None else _recording(fitted.episodes, chosen.name, track_file)
    initial_state = {} if fitted is None else fitted.initial_state_in(recording)
    track, warnings = None, limits(chosen)
    if recorded is not None:
        if recorded.gripper is None:
            raise ConfigError(f"{track_file} has no gripper track; leave --track out to use the scene's own motion.")
        warnings += _not_simulated(recorded, steps * system.time_step, chosen.scene.frame_time)
        track = torch.as_tensor(track_displacement(recorded, system.handles.grippers, steps, system.time_step))[None]
    with progress_bar("simulating", steps) as update, torch.no_grad():
        try:
            given = Inputs.of(chosen, system, steps, one_set({**values, **initial_state}), track)
            run = given.rollout(progress=lambda done: update(done, ""))
        except DivergedError as error:
            shown = ", ".join(f"{name}={value:g}" for name, value in chosen.in_si(values).items()) or "the scene's material"
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
    if format_ == "npz":
        out = with_suffix(out, ".npz")
    elif out.is_file():
        raise ConfigError(f"--format {format_} writes a folder, and {out} is a file.")
    with claimed(out), together():
        if format_ == "npz":
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
        for index, frame in enumerate(nodes if format_ != "npz" else ()):
            beside = SurfaceMesh(moved[index], moved_faces)
            if format_ == "obj":
                write_cloth(out / f"{index:03d}.obj", system.mesh, frame)
            else:
                write_ply(out / f"{index:03d}.ply", frame, system.mesh.faces)
            if len(moved_faces) and format_ == "obj":
                write_surface(out / f"{index:03d}_moving.obj", beside)
            elif len(moved_faces):
                write_ply(out / f"{index:03d}_moving.ply", beside.nodes, beside.faces)
    errors.print(f"Wrote {len(nodes)} frames of {nodes.shape[1]} nodes to {out}.")
    finish(
        {
            "out": str(out),
            "frames": frames,
            "nodes": nodes.shape[1],
            "parameters": chosen.in_si(values),
            "length_unit_m": chosen.length_unit_m,
            "warnings": warnings,
        },
        json,
    )


def _show_sensitivity(chosen: Scenario, recorded: Episode | None, noise_mm: float, json: bool) -> None:
    from rich.table import Table
    from rich.text import Text

    from diffcloud.estimation.visibility import visibility_map
    from diffcloud.evaluation.summary import percent

    found = visibility_map(chosen, episode=recorded, size=_GRID, linear=False)
    for name, distances in (("stretching", found.along_stretching_mm), ("density", found.along_density_mm)):
        rows, columns = (found.grid[1:], found.grid) if name == "stretching" else (found.grid, found.grid[1:])
        rows, columns = rows * chosen.nominal("stretching"), columns * chosen.nominal("density")
        table = Table(f"step in {name}; stretching N/m \\ density kg/m²", *(f"{value:.3g}" for value in columns))
        for value, row in zip(rows, distances, strict=True):
            table.add_row(f"{value:.3g}", *(Text(f"{d:.1f}", "" if d > noise_mm else "dim") for d in row))
        show(table, json)
    fraction = found.visible_fraction(noise_mm)
    if not json:
        output.print(f"{percent(fraction)} of neighbouring pairs differ by more than {noise_mm} mm.")
    told: dict[str, Any] = {
        "visible_fraction": fraction,
        "stretching": (found.grid * chosen.nominal("stretching")).tolist(),
        "density": (found.grid * chosen.nominal("density")).tolist(),
        "along_stretching_mm": found.along_stretching_mm.tolist(),
        "along_density_mm": found.along_density_mm.tolist(),
    }
    finish(told, json)


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


def _recording(known: Sequence[RecordingFit], scenario: str, track: Path | None) -> RecordingFit | None:
    """The recording of a fit in whose frame the motion is written; None where the scene's own frame stays."""
    of_scenario = {one.name: one for one in known if one.scenario == scenario}
    if track is None and of_scenario:
        first = next(iter(of_scenario))
        if len(of_scenario) > 1:
            errors.print(f"The motion lies where {first} has it, the first of the fit's recordings.")
        return of_scenario[first]
    name = scenario if track is None else track.stem
    if name not in of_scenario:
        told = ", ".join(f"{one.scenario}/{one.name}" for one in known)
        errors.print(
            f"{name} is not among the fit's recordings ({told}): its pose is not known, and the motion stays in the frame "
            "of the scene."
        )
    return of_scenario.get(name)
