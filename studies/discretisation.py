"""`python -m studies discretisation`: how far the built-in scenarios are from finer steps and finer meshes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from diffcloud.cli.options import JsonFlag
from diffcloud.console import errors, finish, progress_bar, writes
from diffcloud.evaluation.markdown import markdown_table, result_page
from diffcloud.io.files import write_text
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.scene.description import Scene
from diffcloud.sim.surrounding import Order
from studies.convergence import FINER, NUDGE, PUSH, MeshRow, StepRow, mesh_study, step_study

NAMES = ("lift", "fold", "band_stretch", "vest_hang")
STEPPERS: tuple[tuple[str, Order], ...] = (("implicit", 2), ("implicit", 1), ("arcsim", 1))
_SIZES = (2, 4, 8, 16, 32)
_BAR_MM = 3.0


@writes(".md")
def discretisation(
    scenario: Annotated[
        list[str] | None, typer.Option(help="Built-in or YAML file; default: the four of the paper.")
    ] = None,
    cuts: Annotated[int, typer.Option(min=0, max=3, help="How often meshes are cut finer.")] = 2,
    out: Annotated[Path, typer.Option(help="Markdown page.")] = Path("docs/results/discretisation.md"),
    json: JsonFlag = False,
) -> None:
    """Errors of step size and mesh at the loss frame, for nine pairs of stretching and density; writes a Markdown page."""
    chosen = [choose_scenario(name) for name in scenario or NAMES]
    steps: list[StepRow] = []
    meshes: list[MeshRow] = []
    with progress_bar("discretisation", len(chosen) * (len(STEPPERS) + 1)) as update:
        for place, one in enumerate(chosen):
            for number, (integrator, order) in enumerate(STEPPERS):
                update(place * (len(STEPPERS) + 1) + number, f"{one.name}, {integrator}")
                sizes = sorted({*_SIZES, one.scene.frame_steps})
                steps += step_study(one, one.scene.stepped(integrator, order), sizes)
            update(place * (len(STEPPERS) + 1) + len(STEPPERS), f"{one.name}, meshes")
            meshes += mesh_study(one, cuts) if cuts else []
    own = {one.name: one.scene for one in chosen}
    write_text(out, _page(own, steps, meshes))
    errors.print(f"Wrote {out}.")
    largest = {row.scenario: float(1e3 * row.errors.max()) for row in steps if _is_default(own, row)}
    largest_mm = {name: value if np.isfinite(value) else None for name, value in largest.items()}
    finish({"out": str(out), "largest_mm": largest_mm}, json)


def _page(own: dict[str, Scene], steps: list[StepRow], meshes: list[MeshRow]) -> str:
    head = [
        "scenario",
        "step",
        "steps a frame",
        "median mm",
        "largest mm",
        f"largest mm after {NUDGE:.0e} m",
        f"after {1e3 * PUSH:g} mm",
        "ms a motion",
    ]
    rows = [
        [
            row.scenario,
            _stepper(row),
            f"{row.steps_per_frame}{' (default)' if _is_default(own, row) else ''}",
            *_millimetres(row.errors),
            _largest(row.nudged),
            _largest(row.pushed),
            f"{1e3 * row.seconds:.0f}",
        ]
        for row in steps
    ]
    defaults = [row for row, of in zip(rows, steps, strict=True) if _is_default(own, of)]
    mesh_rows = [[row.scenario, row.nodes, *_millimetres(row.errors), f"{1e3 * row.seconds:.0f}"] for row in meshes]
    return result_page(
        "How far are motions from those with finer steps and meshes?",
        f"At the default steps, the largest distance to {FINER} times the steps is "
        f"{', '.join(f'{row[4]} mm ({row[0]})' for row in defaults)}.",
        markdown_table(head, defaults),
        note="RMS node distances at the frame of the loss, over nine pairs of stretching and density: the middles of "
        "nine equal parts of their bounds, on the logarithmic scale. In two further runs, the initial positions of the "
        f"nodes are changed at random, by {NUDGE:.0e} m and by {1e3 * PUSH:g} mm. If the first change grows, the motion is "
        "chaotic. If the second grows, as in folds that may buckle to either side, no recording repeats. Milliseconds are "
        "processor time of one core up to that frame.",
        command="python -m studies discretisation",
        details={
            "All steps": [markdown_table(head, rows)],
            f"What {_BAR_MM:g} mm cost": [
                f"Milliseconds of the cheapest steps (per frame) with which all nine pairs are within {_BAR_MM:g} mm.",
                markdown_table(["scenario", *(_name(*stepper) for stepper in STEPPERS)], _cheapest(steps)),
            ],
            "Meshes": [
                "Distances at the default step from a mesh to one with halved edges, at the nodes of the scenario's own "
                "mesh. A finer mesh bends where a coarse one cannot. Fitted parameters absorb a part of this difference.",
                markdown_table(["scenario", "nodes", "median mm", "largest mm", "ms a motion"], mesh_rows),
            ],
        },
    )


def _cheapest(steps: list[StepRow]) -> list[list[str]]:
    """Of each scenario, what holding the bar costs with each stepper."""
    rows = []
    for name in dict.fromkeys(row.scenario for row in steps):
        cells = [name]
        for integrator, order in STEPPERS:
            holding = [
                row
                for row in steps
                if (row.scenario, row.integrator, row.order) == (name, integrator, order)
                and bool((1e3 * row.errors <= _BAR_MM).all())
            ]
            best = min(holding, key=lambda row: row.seconds, default=None)
            cells.append("none" if best is None else f"{1e3 * best.seconds:.0f} ({best.steps_per_frame})")
        rows.append(cells)
    return rows


def _is_default(own: dict[str, Scene], row: StepRow) -> bool:
    scene = own[row.scenario]
    order = scene.order if scene.integrator == "implicit" else 1
    return (row.integrator, row.order, row.steps_per_frame) == (scene.integrator, order, scene.frame_steps)


def _stepper(row: StepRow) -> str:
    return _name(row.integrator, row.order)


def _name(integrator: str, order: int) -> str:
    return "arcsim" if integrator == "arcsim" else f"implicit, {'BDF2' if order == 2 else 'backward Euler'}"


def _millimetres(errors: NDArray[np.float64]) -> tuple[str, str]:
    return f"{1e3 * float(np.nanmedian(errors)):.1f}", _largest(errors)


def _largest(errors: NDArray[np.float64]) -> str:
    lost = int(np.isnan(errors).sum())
    value = 1e3 * float(np.nanmax(errors)) if lost < len(errors) else float("nan")
    return (f"{value:.1f}" if value >= 0.05 else f"{value:.0e}") + (f", {lost} diverged" if lost else "")
