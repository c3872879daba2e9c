"""Motions of an isotropic towel that several simulators can run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from diffcloud.mesh.shapes import grid_cloth
from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.simulators.problem import Problem, Sheet

TOWEL = Sheet(density=0.16, stretching=60.0, poisson=0.3, bending=3e-6, damping=0.005)
"""As light and as soft as the preset `jersey-knit`, but isotropic."""
_TABLE, _GAP = 0.02, 0.002
_SIZE = (0.40, 0.30)
_CELLS = (8, 6)


def lift(*, refinement: int = 1) -> Problem:
    """A towel is lifted off a table by a corner, and swings when it hangs: the tutorial's motion.

    Args:
        refinement: parts into which each cell of the mesh is divided along both sides.
    """
    mesh = _towel(_TABLE + _GAP, refinement)
    path = _path((0.0, 0.0, 0.0, 0.0), (2.5, -0.1, -0.1, 0.45))
    return Problem("lift", mesh, TOWEL, 2.5, {len(mesh.nodes) - 1: path}, table=_TABLE)


def fold() -> Problem:
    """The towel is folded over its diagonal on the table; the corner opposite to the moved one is held."""
    mesh = _towel(_TABLE + _GAP)
    path = _path((0.0, 0.0, 0.0, 0.0), (1.25, 0.16, 0.12, 0.20), (2.5, 0.32, 0.24, 0.03))
    return Problem("fold", mesh, TOWEL, 2.5, {0: path, len(mesh.nodes) - 1: None}, table=_TABLE, self_contact=True)


def swing() -> Problem:
    """The towel is let go level, held by the two corners of a short side, and swings without a table."""
    mesh = _towel(0.0)
    return Problem("swing", mesh, TOWEL, 1.5, {0: None, _CELLS[1] * (_CELLS[0] + 1): None})


def _towel(height: float, refinement: int = 1) -> ClothMesh:
    columns, rows = (refinement * cells + 1 for cells in _CELLS)
    flat = grid_cloth(rows, columns, _SIZE[1], _SIZE[0])
    return replace(flat, nodes=flat.nodes + np.array([0.0, 0.0, height]))


def _path(*keys: tuple[float, float, float, float]) -> Motion:
    return Motion(tuple(Keyframe(time, (x, y, z)) for time, x, y, z in keys))
