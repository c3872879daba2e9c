"""Newton's matrix ∂r/∂w: the exact one, a positive semidefinite approximation ("cautious"), or a blend of both."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Ints, Parameters, Timing
from diffcloud.sim.compiled.lu import General, factorised
from diffcloud.sim.compiled.sparse import find_slot, reordered, widened
from diffcloud.sim.contact.places import Touching, corners
from diffcloud.sim.contact.resistance import resistance
from diffcloud.sim.implicit.equation import arm_of, contact_force, spin_inputs
from diffcloud.sim.implicit.scene import Work
from diffcloud.sim.implicit.terms import kernels

_assemble, _jacobian, _spin_tangent = kernels.assemble, kernels.jacobian, kernels.spin_tangent
_pp_jacobian, _pe_jacobian = kernels.barrier_point_point_jacobian, kernels.barrier_point_edge_jacobian
_pf_jacobian, _ee_jacobian = kernels.barrier_point_face_jacobian, kernels.barrier_edge_edge_jacobian
_plane_jacobian = kernels.barrier_plane_jacobian
_FILL = 1.15
"""Reorder the matrix once its factor has grown by this ratio since the last ordering. An ordering costs less than a
factorisation."""


@kernel
def widen(work: Work, listed: Ints) -> None:
    """Extend the sparsity pattern by the couplings of the contacts `listed` [E, 5]. Existing entries stay."""
    wide, moved, freedom = work.wide, work.moved, work.freedom
    spare = len(wide.rows)
    first, second = np.empty(64, np.int64), np.empty(64, np.int64)
    count = 0
    for e in range(len(listed)):
        for a in range(1, 1 + corners(listed, e)):
            for b in range(a + 1, 1 + corners(listed, e)):
                for k in range(4):
                    i, j = freedom[listed[e, a], k % 2], freedom[listed[e, b], k // 2]
                    if i < 0 or j < 0 or find_slot(wide, i, j) != spare:
                        continue
                    if count == len(first):
                        more, others = np.empty(2 * count, np.int64), np.empty(2 * count, np.int64)
                        for k2 in range(count):
                            more[k2], others[k2] = first[k2], second[k2]
                        first, second = more, others
                    first[count], second[count] = i, j
                    count += 1
    if count == 0:
        return
    first, second = first[:count], second[:count]
    found, places = widened(wide, first, second, work.order)
    if len(found.factor_rows) > _FILL * work.fill:
        work.order = reordered(found)
        found, places = widened(wide, first, second, work.order)
        work.fill = len(found.factor_rows)
    together = np.empty(len(moved), np.int64)
    for p in range(len(moved)):
        together[p] = places[moved[p]] if moved[p] >= 0 else ~places[~moved[p]]
    work.wide, work.moved = found, together


@kernel
def newton_matrix(
    work: Work, velocity: Floats, turned: Floats, listed: Ints, numbers: Floats, touching: Touching, caution: float
) -> General:
    """Assemble and factorise Newton's matrix at the current motion. `caution` in [0, 1] is the weight of the positive
    semidefinite approximation; 0 gives the exact matrix."""
    widen(work, listed)
    time_step, start_positions, wide, terms = work.time_step, work.start_positions, work.wide, work.terms
    parameters, motion, start_bodies, pattern = work.parameters, work.motion, work.start_bodies, work.pattern
    rigid, moved = work.rigid, work.moved
    dt, own = time_step, len(pattern.rows)
    reach = dt * (dt + parameters.damping[0])
    lower, upper = np.zeros((own + 1, 9)), np.zeros((own + 1, 9))
    if caution < 1:
        timing = Timing(dt, 0.0)
        _jacobian(terms, parameters, motion, timing, dt * parameters.damping[0], dt, lower, upper)
    if caution > 0:
        safe, unused = np.zeros((own + 1, 9)), np.zeros((len(motion.positions), 3))
        _assemble(terms, _cautious(parameters), motion, Timing(dt, dt), reach, dt, unused, safe)
        for p in range(own):
            for k in range(9):
                lower[p, k] += caution * (safe[p, k] - lower[p, k])
                upper[p, k] += caution * (safe[p, k] - upper[p, k])
    if len(wide.rows) > own:
        below, above = np.zeros((len(wide.rows) + 1, 9)), np.zeros((len(wide.rows) + 1, 9))
        for p in range(own):
            for r in range(3):
                for c in range(3):
                    if moved[p] >= 0:
                        below[moved[p], 3 * r + c], above[moved[p], 3 * r + c] = lower[p, 3 * r + c], upper[p, 3 * r + c]
                    else:  # lower and upper half swap, and the upper one is stored transposed
                        below[~moved[p], 3 * r + c], above[~moved[p], 3 * r + c] = upper[p, 3 * c + r], lower[p, 3 * c + r]
        lower, upper = below, above
    nodes = len(start_positions)
    for i in range(nodes):
        block = lower[wide.starts[wide.place[i]]]
        for axis in range(3):
            block[4 * axis] += parameters.node_mass[i]
    swing = np.zeros((len(rigid.body), 9))
    if len(start_bodies) > 0:
        _add_inertia(work, velocity, swing, lower)
    if len(listed) > 0:
        _add_contact(work, turned, listed, numbers, touching, caution, swing, lower, upper)
    _let_go(work, lower, upper)
    return factorised(wide, lower, upper)


@kernel
def _cautious(p: Parameters) -> Parameters:
    """Parameters of the cautious matrix: elastic forces and contact only. Slack cloth has full stiffness, because a step
    can make it taut."""
    none, whole = np.zeros(1), np.ones(1)
    return Parameters(
        node_mass=p.node_mass,
        weight=p.weight,
        inverse_mass=p.inverse_mass,
        stretching=p.stretching,
        shear=p.shear,
        compression=whole,
        bending=p.bending,
        damping=p.damping,
        air_density=none,
        air_drag=none,
        linear_drag=none,
        friction=p.friction,
        self_friction=p.self_friction,
        body_mass=p.body_mass,
        hold=p.hold,
        target=p.target,
    )


@kernel
def _let_go(work: Work, lower: Floats, upper: Floats) -> None:
    """Reduce the rows of prescribed nodes to their own diagonal block."""
    holder, wide, parameters = work.holder, work.wide, work.parameters
    prescribed = np.zeros(len(wide.place), np.int64)
    some = False
    for i in range(len(holder)):
        if holder[i] >= 0:
            prescribed[wide.place[i]], some = 1, True
    if not some:
        return
    for j in range(len(wide.place)):
        for p in range(wide.starts[j], wide.starts[j + 1]):
            if prescribed[wide.rows[p]] > 0:
                lower[p] = 0.0
            if prescribed[j] > 0:
                upper[p] = 0.0
    for i in range(len(holder)):
        if holder[i] >= 0:
            block = lower[wide.starts[wide.place[i]]]
            block[0] = block[4] = block[8] = parameters.node_mass[i]


@kernel
def _add_inertia(work: Work, velocity: Floats, swing: Floats, lower: Floats) -> None:
    """Add mass and rotational inertia of bodies. `swing` [P, 9] receives d point / d angular velocity over Δt."""
    start_positions, start_bodies, parameters, wide = work.start_positions, work.start_bodies, work.parameters, work.wide
    rigid, time_step = work.rigid, work.time_step
    nodes = len(start_positions)
    inputs, constants = np.empty(15), np.empty(10)
    rates, found = np.zeros((3, 15)), np.empty((3, 12))
    for axis in range(3):
        rates[axis, 12 + axis] = 1.0
    for b in range(len(start_bodies)):
        spin_inputs(work, b, velocity[nodes + 2 * b + 1], inputs, constants)
        _spin_tangent(inputs, constants, rates, found)
        mass = parameters.body_mass[b]
        linear = lower[wide.starts[wide.place[nodes + 2 * b]]]
        turning = lower[wide.starts[wide.place[nodes + 2 * b + 1]]]
        for row in range(3):
            linear[4 * row] += mass
            for column in range(3):
                turning[3 * row + column] += mass * found[column, 9 + row]
        for p in range(len(swing)):
            if rigid.body[p] != b:
                continue
            for row in range(3):
                for column in range(3):
                    part = 0.0
                    for k in range(3):
                        part += found[column, 3 * row + k] * rigid.points[p, k]
                    swing[p, 3 * row + column] = part / time_step


@kernel
def _add_contact(
    work: Work,
    turned: Floats,
    listed: Ints,
    numbers: Floats,
    touching: Touching,
    caution: float,
    swing: Floats,
    lower: Floats,
    upper: Floats,
) -> None:
    """Add the blocks of all contacts, and the change of their moments as lever arms rotate."""
    if caution > 0:
        _add_resistance(work, turned, listed, numbers, caution, swing, lower, upper)
    if not caution < 1:
        return
    for kind in range(5):
        nodes = _nodes_of(touching, kind)
        if len(nodes) > 0:
            blocks = np.zeros((len(nodes), nodes.shape[1] * nodes.shape[1], 9))
            _exact(work, touching, kind, blocks)
            for e in range(len(nodes)):
                _couple(work, turned, swing, nodes, e, 0, nodes.shape[1], blocks[e], 1 - caution, lower, upper)
    rigid = work.rigid
    if len(rigid.body) == 0:
        return
    wide, freedom, first, dt = work.wide, work.freedom, work.first_body_point, work.time_step
    force, part = np.zeros((len(freedom), 3)), np.empty(9)
    contact_force(work, touching, force)
    for p in range(len(swing)):  # -Δt d arm × f = Δt f × d arm
        for k in range(9):
            part[k] = swing[p, k]
        _turn_rows(force[first + p, 0], force[first + p, 1], force[first + p, 2], part)
        diagonal = wide.starts[wide.place[freedom[first + p, 1]]]
        for k in range(9):
            lower[diagonal, k] += (1 - caution) * dt * dt * part[k]


@kernel
def _add_resistance(
    work: Work, turned: Floats, listed: Ints, numbers: Floats, caution: float, swing: Floats, lower: Floats, upper: Floats
) -> None:
    """Add the positive semidefinite blocks of the contacts."""
    parameters, motion, planes, law, dt = work.parameters, work.motion, work.planes, work.law, work.time_step
    friction = (parameters.friction[0], parameters.self_friction[0])
    x, weights, local, blocks = np.empty((4, 3)), np.empty(6), np.empty(18), np.empty((16, 9))
    for e in range(len(listed)):
        if resistance(planes, law, friction, motion.positions, motion.after, listed, numbers, e, x, weights, local):
            width = corners(listed, e)
            for a in range(width):
                for b in range(width):
                    factor = weights[a] * weights[b]
                    for k in range(9):
                        blocks[a * width + b, k] = factor * (dt * dt * local[k] + dt * local[9 + k])
            _couple(work, turned, swing, listed, e, 1, width, blocks, caution, lower, upper)


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
def _exact(work: Work, touching: Touching, kind: int, blocks: Floats) -> None:
    """Write -Δt d force / d velocity of the contacts of one kind to `blocks` [E, n², 9]."""
    time_step, parameters, motion = work.time_step, work.parameters, work.motion
    dt, timing = time_step, Timing(time_step, 0.0)
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
def _couple(
    work: Work,
    turned: Floats,
    swing: Floats,
    points: Ints,
    e: int,
    begin: int,
    width: int,
    blocks: Floats,
    factor: float,
    lower: Floats,
    upper: Floats,
) -> None:
    """Add a contact's blocks to the matrix: rows of nodes, or of bodies' centres and rotations.

    Args:
        points: [E, ...] contacts; those of contact e start at column `begin`.
        blocks: [width², 9] blocks between pairs of points.
        factor: of the blocks.
    """
    freedom, wide, rigid, first = work.freedom, work.wide, work.rigid, work.first_body_point
    part = np.empty(9)
    for a in range(width):
        i = points[e, begin + a]
        for b in range(width):
            j = points[e, begin + b]
            for k in range(4):
                row, column = freedom[i, k // 2], freedom[j, k % 2]
                if row < 0 or column < 0:
                    continue
                for k9 in range(9):
                    part[k9] = blocks[a * width + b, k9]
                if k % 2 > 0:
                    _turn_columns(swing, j - first, part)
                if k // 2 > 0:
                    x, y, z = arm_of(rigid, turned, i - first)
                    _turn_rows(x, y, z, part)
                slot = find_slot(wide, row, column)
                if slot >= 0:
                    for k9 in range(9):
                        lower[slot, k9] += factor * part[k9]
                else:
                    for r in range(3):
                        for c in range(3):
                            upper[~slot, 3 * c + r] += factor * part[3 * r + c]


@kernel
def _turn_columns(swing: Floats, p: int, block: Floats) -> None:
    """In-place product block = block · swing[p]."""
    for r in range(0, 9, 3):
        x, y, z = block[r], block[r + 1], block[r + 2]
        for c in range(3):
            block[r + c] = x * swing[p, c] + y * swing[p, 3 + c] + z * swing[p, 6 + c]


@kernel
def _turn_rows(x: float, y: float, z: float, block: Floats) -> None:
    """In-place product of the cross-product matrix of (x, y, z) and a block."""
    for c in range(3):
        a, b, d = block[c], block[3 + c], block[6 + c]
        block[c], block[3 + c], block[6 + c] = y * d - z * b, z * a - x * d, x * b - y * a
