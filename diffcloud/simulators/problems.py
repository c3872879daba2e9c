"""Two test problems with analytical solutions: stretching of a hanging strip, and bending of a cantilever."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from diffcloud.mesh.shapes import grid_cloth
from diffcloud.sim.motion import Motion
from diffcloud.simulators.problem import Problem, Sheet, Track


@dataclass(frozen=True)
class Known:
    """A test problem with its analytical solution."""

    problem: Problem
    measures: Callable[[Track], dict[str, float]]
    """Function that measures the compared quantities (name -> value) in a simulation result."""
    theory: dict[str, float]


_STRIP = Sheet(density=0.2, stretching=500.0, poisson=0.3, bending=1e-6, damping=0.0)
_LENGTH = 0.5
_ROWS, _ACROSS = 17, 4
_CLEAR = 12
"""Grid row above which the clamped upper end affects the strain."""
_ELONGATION = 0.00073575
"""Mean strain below this row: that of `_STRIP` under Earth's gravity, small enough for linear theory."""
_LITTLE = 0.01
"""Poisson's ratio below which the lateral contraction is not measured."""


def strip(sheet: Sheet = _STRIP) -> Known:
    """Hanging strip: longitudinal strain and lateral contraction of its lower three quarters.

    Args:
        sheet: material of the strip. Gravity is scaled such that linear theory is valid. Its damping is ignored.
    """
    sheet = replace(sheet, damping=0.0)
    flat = grid_cloth(_ROWS, _ACROSS, _LENGTH, 0.1)
    upright = np.column_stack([flat.nodes[:, 0], np.zeros(len(flat.nodes)), flat.nodes[:, 1]])
    held: dict[int, Motion | None] = dict.fromkeys(range((_ROWS - 1) * _ACROSS, _ROWS * _ACROSS))
    clear = _LENGTH * _CLEAR / (_ROWS - 1)
    gravity = _ELONGATION * 2 * sheet.stretching / (sheet.density * clear)
    passage = _LENGTH / math.sqrt(sheet.stretching / sheet.density)  # travel time of a wave along the strip
    problem = Problem(
        "strip",
        replace(flat, nodes=upright),
        sheet,
        50 * passage,
        held,
        gravity=gravity,
        settling=3 / passage,
        rate=0.2 / passage,
    )

    def measures(track: Track) -> dict[str, float]:
        start, end = (nodes.reshape(_ROWS, _ACROSS, 3)[: _CLEAR + 1] for nodes in (upright, track.nodes[-1]))
        along = [float(rows[-1, :, 2].mean() - rows[0, :, 2].mean()) for rows in (start, end)]
        across = [float((rows[:, -1, 0] - rows[:, 0, 0]).mean()) for rows in (start, end)]
        stretched = along[1] / along[0] - 1
        return {"elongation": stretched, "contraction across / elongation": (1 - across[1] / across[0]) / stretched}

    theory = {"elongation": _ELONGATION}
    if sheet.poisson > _LITTLE:
        theory["contraction across / elongation"] = sheet.poisson
    return Known(problem, measures, theory)


_BEAM = Sheet(density=0.2, stretching=200.0, poisson=0.0, bending=1e-4, damping=0.0)
_GAMMA = 5.0
_SLENDER = 2e4
"""E h L²/B of the strip, so large that it bends but hardly stretches."""


def cantilever(sheet: Sheet = _BEAM, cells: int = 24) -> Known:
    """Horizontal cantilever strip that bends far under its weight (heavy elastica): drop and reach of its free end.

    Args:
        sheet: material, which determines length and gravity. Its damping is ignored.
        cells: number of cells along the free length. The clamp ends in the middle of a further cell.
    """
    sheet = replace(sheet, damping=0.0)
    length = math.sqrt(_SLENDER * sheet.bending / sheet.stretching)
    side = length / (cells + 0.5)
    columns = cells + 2
    mesh = grid_cloth(3, columns, 2 * side, side * (columns - 1), through=1)
    gravity = _GAMMA * sheet.bending / (sheet.density * length**3)
    sway = length**2 * math.sqrt(sheet.density / sheet.bending)  # time scale of bending vibrations
    held: dict[int, Motion | None] = {row * columns + column: None for row in range(3) for column in (0, 1)}
    problem = Problem("cantilever", mesh, sheet, 3.4 * sway, held, gravity=gravity, settling=7 / sway, rate=9 / sway)
    root = float(mesh.nodes[1, 0]) - side / 2  # hinges of the second held row bend over half a cell on each side

    def measures(track: Track) -> dict[str, float]:
        tip = track.nodes[-1].reshape(3, columns, 3)[:, -1].mean(axis=0)
        return {"drop / length": -float(tip[2]) / length, "reach / length": (float(tip[0]) - root) / length}

    drop, reach = elastica(_GAMMA)
    return Known(problem, measures, {"drop / length": drop, "reach / length": reach})


def elastica(gamma: float) -> tuple[float, float]:
    """Return (drop, reach) of the free end of a heavy clamped strip, as fractions of its length.

    The slope φ below the horizontal obeys φ'' = -Γ (1 - s) cos φ with φ(0) = 0 and φ'(1) = 0. Here Γ = σ g L³/B, and s
    is the position along the strip.
    """
    from scipy.integrate import solve_bvp  # slow to import

    s = np.linspace(0, 1, 401)
    solved = solve_bvp(
        lambda s, y: np.stack([y[1], -gamma * (1 - s) * np.cos(y[0])]),
        lambda start, end: np.array([start[0], end[1]]),
        s,
        np.stack([s, 1 - s]),
        tol=1e-8,
    )
    slope = solved.sol(s)[0]
    return float(np.trapezoid(np.sin(slope), s)), float(np.trapezoid(np.cos(slope), s))
