"""Newton's matrix ∂r/∂w: exact, or positive semidefinite near it (cautious), or something in between."""

from __future__ import annotations

import numpy as np

from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters, Timing
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.compiled.lu import General, factorised
from diffcloud.sim.compiled.sparse import Pattern, find_slot, widened
from diffcloud.sim.contact.places import Touching, corners
from diffcloud.sim.implicit.equation import arm_of, contact_force, spin_inputs
from diffcloud.sim.implicit.scene import Scene, Start
from diffcloud.sim.terms import kernels

_assemble, _jacobian, _spin_tangent = kernels.assemble, kernels.jacobian, kernels.spin_tangent
_assembled = (
    kernels.barrier_point_point_assemble,
    kernels.barrier_point_edge_assemble,
    kernels.barrier_point_face_assemble,
    kernels.barrier_edge_edge_assemble,
    kernels.barrier_plane_assemble,
)
_pp_assemble, _pe_assemble, _pf_assemble, _ee_assemble, _plane_assemble = _assembled
_pp_jacobian, _pe_jacobian = kernels.barrier_point_point_jacobian, kernels.barrier_point_edge_jacobian
_pf_jacobian, _ee_jacobian = kernels.barrier_point_face_jacobian, kernels.barrier_edge_edge_jacobian
_plane_jacobian = kernels.barrier_plane_jacobian


@kernel
def pattern_for(scene: Scene, pattern: Pattern, moved: Ints, listed: Ints) -> tuple[Pattern, Ints]:
    """A pattern that also couples what touches, and where the blocks of the scene's own lie in it.

    Args:
        pattern, moved: of the matrix before, which is kept where it does.
        listed: [E, 5] places that touch.
    """
    spare = len(pattern.rows)
    first, second = np.empty(64, np.int64), np.empty(64, np.int64)
    count = 0
    for e in range(len(listed)):
        for a in range(1, 1 + corners(listed, e)):
            for b in range(a + 1, 1 + corners(listed, e)):
                for k in range(4):
                    i, j = _freedom(scene, listed[e, a], k % 2), _freedom(scene, listed[e, b], k // 2)
                    if i < 0 or j < 0 or find_slot(pattern, i, j) != spare:
                        continue
                    if count == len(first):
                        more, others = np.empty(2 * count, np.int64), np.empty(2 * count, np.int64)
                        for k2 in range(count):
                            more[k2], others[k2] = first[k2], second[k2]
                        first, second = more, others
                    first[count], second[count] = i, j
                    count += 1
    if count == 0:
        return pattern, moved
    wide, places = widened(pattern, first[:count], second[:count])
    found = np.empty(len(moved), np.int64)
    for p in range(len(moved)):
        found[p] = places[moved[p]]
    return wide, found


@kernel
def _freedom(scene: Scene, point: int, turns: int) -> int:
    """The row of a point's motion: its own, or its body's centre or rotation; below zero: it has none."""
    nodes = scene.surface.cloth_points
    if point < nodes:
        return point if turns == 0 else -1
    p = point - nodes - scene.obstacle_points
    return nodes + 2 * scene.rigid.body[p] + turns if p >= 0 else -1


@kernel
def newton_matrix(
    scene: Scene,
    start: Start,
    parameters: Parameters,
    motion: Motion,
    velocity: Floats,
    turned: Floats,
    listed: Ints,
    touching: Touching,
    caution: float,
    pattern: Pattern,
    moved: Ints,
) -> General:
    """The factorised matrix at a motion (`equation.set_motion`); caution in [0, 1] is the part of the cautious one."""
    dt, own = start.time_step, len(scene.pattern.rows)
    reach = dt * (dt + parameters.damping[0])
    lower, upper = np.zeros((own + 1, 9)), np.zeros((own + 1, 9))
    if caution < 1:
        timing = Timing(dt, 0.0)
        _jacobian(scene.terms, parameters, motion, timing, dt * parameters.damping[0], dt, lower, upper)
    if caution > 0:
        safe, unused = np.zeros((own + 1, 9)), np.zeros((len(motion.positions), 3))
        _assemble(scene.terms, parameters, motion, Timing(dt, dt), reach, dt, unused, safe)
        for p in range(own):
            for k in range(9):
                lower[p, k] += caution * (safe[p, k] - lower[p, k])
                upper[p, k] += caution * (safe[p, k] - upper[p, k])
    if len(pattern.rows) > own:
        below, above = np.zeros((len(pattern.rows) + 1, 9)), np.zeros((len(pattern.rows) + 1, 9))
        for p in range(own):
            for k in range(9):
                below[moved[p], k], above[moved[p], k] = lower[p, k], upper[p, k]
        lower, upper = below, above
    nodes = len(start.positions)
    for i in range(nodes):
        block = lower[pattern.starts[pattern.place[i]]]
        for axis in range(3):
            block[4 * axis] += parameters.node_mass[i]
    swing = np.zeros((len(scene.rigid.body), 9))
    if len(start.bodies) > 0:
        _add_inertia(scene, start, parameters, velocity, swing, pattern, lower)
    if len(listed) > 0:
        _add_contact(scene, parameters, motion, dt, turned, touching, caution, swing, pattern, lower, upper)
    _let_go(start, parameters, pattern, lower, upper)
    return factorised(pattern, lower, upper)


@kernel
def _let_go(start: Start, parameters: Parameters, of: Pattern, lower: Floats, upper: Floats) -> None:
    """The row of a prescribed node says only what its own change is."""
    prescribed = np.zeros(len(of.place), np.int64)
    some = False
    for i in range(len(start.holder)):
        if start.holder[i] >= 0:
            prescribed[of.place[i]], some = 1, True
    if not some:
        return
    for j in range(len(of.place)):
        for p in range(of.starts[j], of.starts[j + 1]):
            if prescribed[of.rows[p]] > 0:
                lower[p] = 0.0
            if prescribed[j] > 0:
                upper[p] = 0.0
    for i in range(len(start.holder)):
        if start.holder[i] >= 0:
            block = lower[of.starts[of.place[i]]]
            block[0] = block[4] = block[8] = parameters.node_mass[i]


@kernel
def _add_inertia(
    scene: Scene, start: Start, parameters: Parameters, velocity: Floats, swing: Floats, of: Pattern, lower: Floats
) -> None:
    """Mass and turning inertia of bodies; swing [P, 9] takes d point / d angular velocity over Δt."""
    nodes = len(start.positions)
    inputs, constants = np.empty(15), np.empty(10)
    rates, found = np.zeros((3, 15)), np.empty((3, 12))
    for axis in range(3):
        rates[axis, 12 + axis] = 1.0
    for b in range(len(start.bodies)):
        spin_inputs(scene, start, b, velocity[nodes + 2 * b + 1], inputs, constants)
        _spin_tangent(inputs, constants, rates, found)
        mass = parameters.body_mass[b]
        linear = lower[of.starts[of.place[nodes + 2 * b]]]
        turning = lower[of.starts[of.place[nodes + 2 * b + 1]]]
        for row in range(3):
            linear[4 * row] += mass
            for column in range(3):
                turning[3 * row + column] += mass * found[column, 9 + row]
        for p in range(len(swing)):
            if scene.rigid.body[p] != b:
                continue
            for row in range(3):
                for column in range(3):
                    part = 0.0
                    for k in range(3):
                        part += found[column, 3 * row + k] * scene.rigid.points[p, k]
                    swing[p, 3 * row + column] = part / start.time_step


@kernel
def _add_contact(
    scene: Scene,
    parameters: Parameters,
    motion: Motion,
    dt: float,
    turned: Floats,
    touching: Touching,
    caution: float,
    swing: Floats,
    pattern: Pattern,
    lower: Floats,
    upper: Floats,
) -> None:
    """Blocks of all places that touch, and how the moments of their forces change as arms turn."""
    for kind in range(5):
        nodes = _nodes_of(touching, kind)
        count, width = len(nodes), nodes.shape[1]
        if count == 0:
            continue
        exact = np.zeros((count, width * width, 9))
        if caution < 1:
            _exact(touching, kind, parameters, motion, Timing(dt, 0.0), dt, exact)
        if caution > 0:
            safe = np.zeros((count, width * (width + 1) // 2, 9))
            _safe(touching, kind, parameters, motion, Timing(dt, 0.0), dt, safe)
            _blend(safe, caution, width, exact)
        _couple(scene, turned, swing, pattern, nodes, exact, lower, upper)
    if len(scene.rigid.body) == 0 or not caution < 1:
        return
    force = np.zeros((len(motion.positions), 3))
    contact_force(touching, parameters, motion, Timing(dt, 0.0), force)
    first = scene.surface.cloth_points + scene.obstacle_points
    for p in range(len(swing)):  # -Δt d arm × f = Δt f × d arm
        row = scene.surface.cloth_points + 2 * scene.rigid.body[p] + 1
        block, f = lower[pattern.starts[pattern.place[row]]], force[first + p]
        _add_cross(f[0], f[1], f[2], swing[p], dt * dt, block)


@kernel
def _add_cross(x: float, y: float, z: float, right: Floats, factor: float, block: Floats) -> None:
    """block += factor [x, y, z]× right."""
    for c in range(3):
        block[c] += factor * (y * right[6 + c] - z * right[3 + c])
        block[3 + c] += factor * (z * right[c] - x * right[6 + c])
        block[6 + c] += factor * (x * right[3 + c] - y * right[c])


@kernel
def _nodes_of(touching: Touching, kind: int) -> Ints:
    if kind == 0:
        return touching.point_point.nodes
    if kind == 1:
        return touching.point_edge.nodes
    if kind == 2:
        return touching.point_face.nodes
    if kind == 3:
        return touching.edge_edge.nodes
    return touching.plane.nodes


@kernel
def _exact(  # type: ignore[no-untyped-def]
    touching: Touching, kind: int, parameters: Parameters, motion: Motion, timing: Timing, dt: float, blocks: Floats
):
    """Blocks [E, n², 9] of -Δt d force / d velocity."""
    if kind == 0:
        _pp_jacobian(touching.point_point, parameters, motion, timing, 0.0, dt, blocks)
    elif kind == 1:
        _pe_jacobian(touching.point_edge, parameters, motion, timing, 0.0, dt, blocks)
    elif kind == 2:
        _pf_jacobian(touching.point_face, parameters, motion, timing, 0.0, dt, blocks)
    elif kind == 3:
        _ee_jacobian(touching.edge_edge, parameters, motion, timing, 0.0, dt, blocks)
    else:
        _plane_jacobian(touching.plane, parameters, motion, timing, 0.0, dt, blocks)


@kernel
def _safe(  # type: ignore[no-untyped-def]
    touching: Touching, kind: int, parameters: Parameters, motion: Motion, timing: Timing, dt: float, blocks: Floats
):
    """The cautious blocks [E, pairs, 9]."""
    unused = np.zeros((len(motion.positions), 3))
    if kind == 0:
        _pp_assemble(touching.point_point, parameters, motion, timing, 0.0, dt, unused, blocks)
    elif kind == 1:
        _pe_assemble(touching.point_edge, parameters, motion, timing, 0.0, dt, unused, blocks)
    elif kind == 2:
        _pf_assemble(touching.point_face, parameters, motion, timing, 0.0, dt, unused, blocks)
    elif kind == 3:
        _ee_assemble(touching.edge_edge, parameters, motion, timing, 0.0, dt, unused, blocks)
    else:
        _plane_assemble(touching.plane, parameters, motion, timing, 0.0, dt, unused, blocks)


@kernel
def _blend(safe: Floats, caution: float, width: int, blocks: Floats) -> None:
    """blocks += caution (safe - blocks); those below the diagonal are the transposed of those above."""
    for e in range(len(blocks)):
        pair = 0
        for a in range(width):
            for b in range(a, width):
                one, block, mirrored = safe[e, pair], blocks[e, a * width + b], blocks[e, b * width + a]
                pair += 1
                for r in range(3):
                    for c in range(3):
                        block[3 * r + c] += caution * (one[3 * r + c] - block[3 * r + c])
                        if b > a:
                            mirrored[3 * c + r] += caution * (one[3 * r + c] - mirrored[3 * c + r])


@kernel
def _couple(
    scene: Scene, turned: Floats, swing: Floats, pattern: Pattern, nodes: Ints, blocks: Floats, lower: Floats, upper: Floats
) -> None:
    """Add blocks [E, n², 9] between points to those between rows of the matrix: of nodes, or of bodies' centres and rotations."""
    width, first = nodes.shape[1], scene.surface.cloth_points + scene.obstacle_points
    right, both = np.empty(9), np.empty(9)
    for e in range(len(nodes)):
        for a in range(width):
            for b in range(width):
                block = blocks[e, a * width + b]
                for k in range(4):
                    row, column = _freedom(scene, nodes[e, a], k // 2), _freedom(scene, nodes[e, b], k % 2)
                    if row < 0 or column < 0:
                        continue
                    part = block
                    if k % 2 > 0:
                        own = swing[nodes[e, b] - first]
                        for r in range(3):
                            for c in range(3):
                                right[3 * r + c] = (
                                    block[3 * r] * own[c] + block[3 * r + 1] * own[3 + c] + block[3 * r + 2] * own[6 + c]
                                )
                        part = right
                    if k // 2 > 0:
                        x, y, z = arm_of(scene, turned, nodes[e, a] - first)
                        both[:] = 0.0
                        _add_cross(x, y, z, part, 1.0, both)
                        part = both
                    _add_at(pattern, row, column, part, lower, upper)


@kernel
def _add_at(of: Pattern, row: int, column: int, block: Floats, lower: Floats, upper: Floats) -> None:
    """Add the block (row, column)."""
    slot = find_slot(of, row, column)
    if slot >= 0:
        for k in range(9):
            lower[slot, k] += block[k]
    else:
        for r in range(3):
            for c in range(3):
                upper[~slot, 3 * c + r] += block[3 * r + c]
