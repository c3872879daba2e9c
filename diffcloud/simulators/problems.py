"""Two tests whose answers are known."""

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
    """A test with a known answer."""

    problem: Problem
    measures: Callable[[Track], dict[str, float]]
    """Name -> what a simulator makes of it."""
    theory: dict[str, float]


_STRIP = Sheet(density=0.2, stretching=500.0, poisson=0.3, bending=1e-6, damping=0.0)
_LENGTH = 0.5
_ROWS, _ACROSS = 17, 4
_CLEAR = 12
"""Row up to which the held upper end does not show."""
_ELONGATION = 0.00073575
"""Mean strain of the clear part: that of `_STRIP` on Earth, small enough for linear theory."""
_LITTLE = 0.01
"""Poisson's ratio below which the contraction is not looked at."""


def strip(sheet: Sheet = _STRIP) -> Known:
    """A strip hangs from its upper end: how its lower three quarters stretch, and how it contracts across them.

    Args:
        sheet: hangs under a gravity that stretches it by so little as theory allows; its damping is left out.
    """
    sheet = replace(sheet, damping=0.0)
    flat = grid_cloth(_ROWS, _ACROSS, _LENGTH, 0.1)
    upright = np.column_stack([flat.nodes[:, 0], np.zeros(len(flat.nodes)), flat.nodes[:, 1]])
    held: dict[int, Motion | None] = dict.fromkeys(range((_ROWS - 1) * _ACROSS, _ROWS * _ACROSS))
    clear = _LENGTH * _CLEAR / (_ROWS - 1)
    gravity = _ELONGATION * 2 * sheet.stretching / (sheet.density * clear)
    passage = _LENGTH / math.sqrt(sheet.stretching / sheet.density)  # of a wave along the strip
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
"""E h L²/B: so long a strip that it bends and does not stretch."""


def cantilever(sheet: Sheet = _BEAM, cells: int = 24) -> Known:
    """A strip clamped level at one end bends far under its weight, the heavy elastica: drop and reach of its free end.

    Args:
        sheet: whose stiffnesses decide how long the strip is, and how heavy; its damping is left out.
        cells: along the free length, and half a cell more, in whose middle the clamp ends.
    """
    sheet = replace(sheet, damping=0.0)
    length = math.sqrt(_SLENDER * sheet.bending / sheet.stretching)
    side = length / (cells + 0.5)
    columns = cells + 2
    mesh = grid_cloth(3, columns, 2 * side, side * (columns - 1), through=1)
    gravity = _GAMMA * sheet.bending / (sheet.density * length**3)
    sway = length**2 * math.sqrt(sheet.density / sheet.bending)  # by which bending vibrations are measured
    held: dict[int, Motion | None] = {row * columns + column: None for row in range(3) for column in (0, 1)}
    problem = Problem("cantilever", mesh, sheet, 3.4 * sway, held, gravity=gravity, settling=7 / sway, rate=9 / sway)
    root = float(mesh.nodes[1, 0]) - side / 2  # the second held row's hinges bend over half a cell to either side

    def measures(track: Track) -> dict[str, float]:
        tip = track.nodes[-1].reshape(3, columns, 3)[:, -1].mean(axis=0)
        return {"drop / length": -float(tip[2]) / length, "reach / length": (float(tip[0]) - root) / length}

    drop, reach = elastica(_GAMMA)
    return Known(problem, measures, {"drop / length": drop, "reach / length": reach})


def elastica(gamma: float) -> tuple[float, float]:
    """(drop, reach) of the free end of a heavy clamped strip, in parts of its length.

    The slope φ below the level obeys φ'' = -Γ (1 - s) cos φ, φ(0) = 0, φ'(1) = 0, with Γ = σ g L³/B and s along the strip.
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
