"""The linear system of a step: forces and matrix of all terms and of the repelling pairs."""

from __future__ import annotations

import numpy as np

from diffcloud.arcsim.scene import Scene
from diffcloud.arcsim.terms import kernels
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters, Timing
from diffcloud.sim.compiled.sparse import Pattern, add_assemble, find_slot, hold, widened

_assemble = kernels.assemble
_PointFace, _EdgeEdge = kernels.ProximityPointFace, kernels.ProximityEdgeEdge
_point_face_assemble, _edge_edge_assemble = (
    kernels.proximity_point_face_assemble,
    kernels.proximity_edge_edge_assemble,
)


@kernel
def repelling(reach: float, pattern: Pattern, corners: Ints, constants: Floats):  # type: ignore[no-untyped-def]
    """Convert repelling pairs [C, 5] and their constants [C, 4] to elements (point-face, edge-edge), with thickness `reach`
    [m]."""
    edges = 0
    for c in range(len(corners)):
        edges += corners[c, 0]
    faces = len(corners) - edges
    nodes, slots, numbers = (
        np.empty((len(corners), 4), np.int64),
        np.empty((len(corners), 10), np.int64),
        np.empty((4, len(corners))),
    )
    place = 0
    for kind in range(2):
        for c in range(len(corners)):
            if corners[c, 0] != kind:
                continue
            pair = 0
            for a in range(4):
                nodes[place, a] = corners[c, 1 + a]
                for b in range(a, 4):
                    slots[place, pair] = find_slot(pattern, corners[c, 1 + a], corners[c, 1 + b])
                    pair += 1
            for k in range(4):
                numbers[k, place] = constants[c, k]
            place += 1
    thickness = np.full(len(corners), reach)
    return (
        _PointFace(
            nodes[:faces],
            slots[:faces],
            numbers[0, :faces],
            numbers[1, :faces],
            numbers[2, :faces],
            numbers[3, :faces],
            thickness[:faces],
        ),
        _EdgeEdge(
            nodes[faces:],
            slots[faces:],
            numbers[0, faces:],
            numbers[1, faces:],
            numbers[2, faces:],
            numbers[3, faces:],
            thickness[faces:],
        ),
    )


@kernel
def pattern_with(base: Pattern, corners: Ints) -> tuple[Pattern, Ints]:
    """Extend the pattern by the couplings of pairs [C, 5]. Return it with the new positions of the base's blocks. The
    positions are empty if nothing changed."""
    nodes = len(base.place)
    first, second = np.empty(6 * len(corners), np.int64), np.empty(6 * len(corners), np.int64)
    count = 0
    for c in range(len(corners)):
        for a in range(1, 5):
            for b in range(a + 1, 5):
                i, j = corners[c, a], corners[c, b]
                if i < nodes and j < nodes and find_slot(base, i, j) == len(base.rows):
                    first[count], second[count] = i, j
                    count += 1
    if count == 0:
        return base, np.empty(0, np.int64)
    return widened(base, first[:count], second[:count], base.place)


@kernel
def linear_system(  # type: ignore[no-untyped-def]
    scene: Scene,
    parameters: Parameters,
    motion: Motion,
    holder: Ints,
    corners: Ints,
    constants: Floats,
    pattern: Pattern,
    moved: Ints,
    force: Floats,
):
    """Assemble the step matrix m + Δt (Δt + β) H + handles + contact [A + 1, 9]; `force` [N, 3] receives the forces."""
    dt = scene.time_step
    timing = Timing(dt, dt)
    matrix = np.zeros((len(scene.pattern.rows) + 1, 9))
    _assemble(scene.terms, parameters, motion, timing, dt * (dt + parameters.damping[0]), dt, force, matrix)
    if len(moved) > 0:
        wide = np.zeros((len(pattern.rows) + 1, 9))
        for p in range(len(moved)):
            wide[moved[p]] = matrix[p]
        matrix = wide
    if len(corners) > 0:
        point_face, edge_edge = repelling(scene.repulsion.thickness, pattern, corners, constants)
        blocks = np.empty((len(corners), 10, 9))
        faces = len(point_face.nodes)
        _point_face_assemble(point_face, parameters, motion, timing, 0.0, dt, force, blocks[:faces])
        _edge_edge_assemble(edge_edge, parameters, motion, timing, 0.0, dt, force, blocks[faces:])
        add_assemble(point_face.slots, blocks[:faces], matrix)
        add_assemble(edge_edge.slots, blocks[faces:], matrix)
    for i in range(len(pattern.place)):
        block = matrix[pattern.starts[pattern.place[i]]]
        for axis in range(3):
            block[4 * axis] += parameters.node_mass[i]
    hold(pattern, holder, parameters.node_mass, matrix)
    return matrix
