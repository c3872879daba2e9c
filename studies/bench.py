"""Milliseconds per episode, over batch sizes and mesh sizes, and per comparison with a recording."""

from __future__ import annotations

import io
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.table import Table

from diffcloud.cli.options import JsonFlag, Threads
from diffcloud.clouds import SurfaceSampler
from diffcloud.console import finish, output, progress_bar, show
from diffcloud.io.clouds import write_ply
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.scene.scenarios import GridScenario, Scenario, built_in, grid_scenario, make_scenario
from diffcloud.sim.threads import thread_count, use_threads
from studies.timings import time_contact, time_episode, time_matching

_BATCHES = (1, 16, 64)
_SIDES = (16, 32, 64)
_CONTACT_SIDES = (10, 14, 20, 28, 40)
HEAD = ("scenario", "nodes", "steps", "batch", "forward ms", "forward + backward ms", "forward + 10 tangents ms")
MATCHING_HEAD = ("frames", "points of a frame, each way", "ms", "ms, given matches of a nearby pose")
_POINTS = (200, 3500)
"""Points per frame: in a fit of 25 frames, and in a fit of one."""
_TOWEL: dict[str, Any] = {
    "size_m": (0.40, 0.30), "nodes": (13, 10), "yaw_deg": 0.0, "center_m": (0.55, 0.0), "table_height_m": 0.02,
    "material": "jersey-knit", "steps_per_frame": 16, "grasped": ("right_top",),
    "path": [(0.0, 0.0, 0.0, 0.0), (2.5, -0.1, -0.1, 0.45)],
}  # fmt: skip
CONTACT_HEAD = ("nodes", "contacts", "free ms per step", "on a sphere ms per step", "µs per contact")


def bench(
    scene: Annotated[Path | None, typer.Option(help="Scene file of the published lift.")] = None,
    repeats: Annotated[int, typer.Option(min=1, max=1000, help="Runs of each; the fastest one counts.")] = 3,
    contact: Annotated[bool, typer.Option(help="What contacts cost instead: finer and finer cloths on a sphere.")] = False,
    fit: Annotated[
        bool, typer.Option("--fit", help="Instead, how long `diffcloud fit` takes for the tutorial's towel.")
    ] = False,
    threads: Threads = None,
    json: JsonFlag = False,
) -> None:
    """Time motions of the built-in scenarios, with --scene of the published lift too, and comparisons with a recording."""
    use_threads(threads)
    if contact:
        costs = contact_benchmarks(repeats=repeats)
        show(contact_table(costs), json)
        finish({"threads": thread_count(), "timings": costs}, json)
        return
    if fit:
        seconds = time_fit()
        if not json:
            output.print(f"fit, one lift of the towel, {thread_count()} threads: {seconds:.0f} s")
        finish({"threads": thread_count(), "fit_seconds": seconds}, json)
        return
    published = {} if scene is None else {"release_lift": scene}
    timings, matchings = run_benchmarks(published, repeats=repeats), matching_benchmarks(repeats=repeats)
    show(benchmark_table(timings), json)
    table = Table(*MATCHING_HEAD, title="Finding nearest points, both ways")
    for row in matching_rows(matchings):
        table.add_row(*row)
    show(table, json)
    finish({"threads": thread_count(), "timings": timings, "matchings": matchings}, json)


def run_benchmarks(published: Mapping[str, Path], *, repeats: int) -> list[dict[str, Any]]:
    """All timings in one run; machines are noisy, so compare within it.

    Args:
        published: scenario name -> its published scene file.
    """
    names = ("lift", "fold", "band_stretch", "vest_hang")
    jobs: list[tuple[str, Scenario, int]] = [("lift", choose_scenario("lift"), batch) for batch in _BATCHES]
    jobs += [(name, choose_scenario(name), 1) for name in names[1:]]
    for name in names:
        own = choose_scenario(name)
        jobs.append((f"{name}, arcsim", replace(own, scene=own.scene.stepped("arcsim")), 1))
    jobs += [("lift, arcsim, 25 steps", _short(built_in("lift")), batch) for batch in _BATCHES]
    for name, scene in published.items():
        scenario = choose_scenario(name, scene)
        jobs += [(name, scenario, batch) for batch in _BATCHES]
    for side in _SIDES:
        jobs.append((f"lift {side} x {side}, arcsim, 25 steps", _short(_finer(side)), 1))
    timings = []
    with progress_bar("bench", len(jobs)) as update:
        for index, (name, scenario, batch) in enumerate(jobs):
            update(index, f"{name}, batch {batch}")
            timings.append({"scenario": name, **asdict(time_episode(scenario, batch=batch, repeats=repeats))})
    return timings


def time_fit() -> float:
    """Seconds from clouds to the report of `diffcloud fit`: one lift of the towel of docs/own-clouds.md, of half the
    nominal stiffness and one and a half times its mass, with 2 mm of noise."""
    from diffcloud.jobs.synthesize import simulated_frames  # not above: only this needs them

    towel = built_in("lift").model_copy(update=_TOWEL)
    scenario = make_scenario(towel)
    system, (nodes,), _ = simulated_frames(scenario, {"stretching": np.array([0.5]), "density": np.array([1.5])})
    generator = torch.Generator().manual_seed(0)
    sampler = SurfaceSampler.build(torch.as_tensor(system.mesh.faces), 2500, generator=generator)
    clouds = sampler.sample(torch.from_numpy(nodes)).numpy()
    noise = 0.002 * np.random.default_rng(0).standard_normal(clouds.shape)
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder) / "towel"
        recording.mkdir()
        for index, cloud in enumerate(clouds + noise):
            write_ply(recording / f"{index:03d}.ply", cloud)
        track = np.column_stack([np.arange(len(nodes)) / towel.rate_hz, nodes[:, scenario.grasped[0]]])
        np.savetxt(recording / "gripper.csv", track, delimiter=",", header="t_s,x,y,z", comments="")
        begin = time.perf_counter()
        command = [sys.executable, "-m", "diffcloud", "fit", str(recording), "--out", str(Path(folder) / "found")]
        known = ["--size", "0.40x0.30", "--density", "0.24", "--threads", str(thread_count())]
        subprocess.run([*command, *known], check=True, capture_output=True)
        return time.perf_counter() - begin


def matching_benchmarks(*, repeats: int) -> list[dict[str, Any]]:
    """What it costs to compare a motion with a recording, in one run."""
    return [asdict(time_matching(choose_scenario("lift"), points, repeats=repeats)) for points in _POINTS]


def matching_rows(timings: list[dict[str, Any]]) -> list[list[str]]:
    """The cells under `MATCHING_HEAD`, one row a timing."""
    return [
        [str(entry["frames"]), str(entry["points"]), *(f"{1e3 * entry[key]:.1f}" for key in ("first", "again"))]
        for entry in timings
    ]


def contact_benchmarks(*, repeats: int) -> list[dict[str, Any]]:
    """What one contact costs, over mesh sizes, in one run."""
    timings = []
    with progress_bar("bench", len(_CONTACT_SIDES)) as update:
        for index, side in enumerate(_CONTACT_SIDES):
            update(index, f"{side} x {side}")
            timing = time_contact(side, repeats=repeats)
            timings.append({**asdict(timing), "per_contact": timing.per_contact})
    return timings


def contact_table(timings: list[dict[str, Any]]) -> Table:
    table = Table(*CONTACT_HEAD)
    for row in contact_rows(timings):
        table.add_row(*row)
    return table


def contact_rows(timings: list[dict[str, Any]]) -> list[list[str]]:
    """The cells under `CONTACT_HEAD`, one row a timing."""
    return [
        [
            str(entry["nodes"]),
            f"{entry['contacts']:.0f}",
            *(f"{1e3 * entry[key] / entry['steps']:.1f}" for key in ("free", "touching")),
            f"{1e6 * entry['per_contact']:.0f}",
        ]
        for entry in timings
    ]


def contact_figure(timings: list[dict[str, Any]]) -> bytes:
    """PNG: what contacts add to a step over how many there are, beside a line of constant cost."""
    from matplotlib.figure import Figure  # takes half a second to import

    contacts = [entry["contacts"] for entry in timings]
    added = [1e3 * (entry["touching"] - entry["free"]) / entry["steps"] for entry in timings]
    canvas = Figure(figsize=(5.5, 3.6), layout="constrained")
    axes = canvas.subplots()
    axes.plot(
        [0, max(contacts)], [0, sum(added) / sum(contacts) * max(contacts)], color="0.7", label="constant cost a contact"
    )
    axes.plot(contacts, added, "o", color="tab:blue")
    for x, y, entry in zip(contacts, added, timings, strict=True):
        axes.annotate(f"{entry['nodes']} nodes", (x, y), textcoords="offset points", xytext=(-6, 6), ha="right", fontsize=8)
    axes.set_xlabel("contacts, mean over the steps")
    axes.set_ylabel("added to a step, with gradient [ms]")
    axes.legend(frameon=False, loc="lower right")
    png = io.BytesIO()
    canvas.savefig(png, format="png", dpi=130, metadata={"Software": None})
    return png.getvalue()


def benchmark_table(timings: list[dict[str, Any]]) -> Table:
    table = Table(*HEAD)
    for row in benchmark_rows(timings):
        table.add_row(*row)
    return table


def benchmark_rows(timings: list[dict[str, Any]]) -> list[list[str]]:
    """The cells under `HEAD`, one row a timing."""
    return [
        [
            entry["scenario"],
            *(str(entry[key]) for key in ("nodes", "steps", "batch")),
            *(f"{1e3 * entry[key] / entry['batch']:.1f}" for key in ("forward", "forward_backward", "forward_tangents")),
        ]
        for entry in timings
    ]


def _finer(side: int) -> GridScenario:
    return built_in("lift").model_copy(update={"nodes": (side, side)})


def _short(options: GridScenario) -> Scenario:
    """25 steps, as many as the published episodes have, and of their kind."""
    update = {"steps_per_frame": 1, "rate_hz": 25.0, "frames": 25, "integrator": "arcsim"}
    scenario = grid_scenario(options.model_copy(update=update))
    return replace(scenario, loss_frames=(-1,))
