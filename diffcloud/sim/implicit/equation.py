"""The equation of one part of a step: positions of all points, forces, and the residual."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Timing
from diffcloud.sim.contact.places import Touching
from diffcloud.sim.implicit.scene import BODY, Rigid, Work
from diffcloud.sim.implicit.terms import kernels

_force, _spin = kernels.force, kernels.spin_value
_point_point, _point_edge = kernels.barrier_point_point_force, kernels.barrier_point_edge_force
_point_face, _edge_edge = kernels.barrier_point_face_force, kernels.barrier_edge_edge_force
_plane = kernels.barrier_plane_force


@kernel
def spin_inputs(work: Work, b: int, turning: Floats, inputs: Floats, constants: Floats) -> None:
    """Write the inputs and constants of `rigid.spin` for body b with the final angular velocity `turning` [3]."""
    time_step, start_bodies, rigid = work.time_step, work.start_bodies, work.rigid
    constants[0] = time_step
    for k in range(9):
        inputs[k], constants[1 + k] = start_bodies[b, 3 + k], rigid.gyration[b, k]
    for k in range(3):
        inputs[9 + k], inputs[12 + k] = start_bodies[b, 15 + k], turning[k]


@kernel
def place_points(work: Work, velocity: Floats, scenery: Floats, points: Floats, turned: Floats) -> None:
    """Compute the positions of all points [N, 3] at the end of the step.

    Args:
        velocity: [D, 3] unknowns.
        scenery: [O, 3] obstacle points [m].
        points: [N, 3] receives the positions [m].
        turned: [B, 12] receives the results of `spin`.
    """
    first_body_point, time_step, start_positions, start_bodies = (
        work.first_body_point,
        work.time_step,
        work.start_positions,
        work.start_bodies,
    )
    rigid = work.rigid
    dt, nodes = time_step, len(start_positions)
    for i in range(nodes):
        for axis in range(3):
            points[i, axis] = start_positions[i, axis] + dt * velocity[i, axis]
    for o in range(len(scenery)):
        for axis in range(3):
            points[nodes + o, axis] = scenery[o, axis]
    inputs, constants = np.empty(15), np.empty(10)
    for b in range(len(start_bodies)):
        spin_inputs(work, b, velocity[nodes + 2 * b + 1], inputs, constants)
        _spin(inputs, constants, turned[b])
    first = first_body_point
    for p in range(len(rigid.body)):
        b = rigid.body[p]
        for axis in range(3):
            arm = 0.0
            for k in range(3):
                arm += turned[b, 3 * axis + k] * rigid.points[p, k]
            points[first + p, axis] = start_bodies[b, axis] + dt * velocity[nodes + 2 * b, axis] + arm


@kernel
def body_points(rigid: Rigid, bodies: Floats, points: Floats, first: int) -> None:
    """Write the points of bodies in states [B, 18] into `points` [N, 3], starting at index `first`."""
    for p in range(len(rigid.body)):
        body = bodies[rigid.body[p]]
        for axis in range(3):
            points[first + p, axis] = body[axis]
            for k in range(3):
                points[first + p, axis] += body[3 + 3 * axis + k] * rigid.points[p, k]


@kernel
def set_motion(work: Work, velocity: Floats, points: Floats) -> None:
    """Set `work.motion`, from which terms compute forces. Points of obstacles and bodies move straight in a step."""
    start_positions, motion, parameters = work.start_positions, work.motion, work.parameters
    start_points = work.start_points
    nodes = len(start_positions)
    for i in range(len(points)):
        for axis in range(3):
            motion.positions[i, axis] = points[i, axis]
            if i < nodes:
                motion.after[i, axis] = velocity[i, axis]
                motion.displacement[i, axis] = parameters.damping[0] * velocity[i, axis]
            else:
                motion.after[i, axis] = (points[i, axis] - start_points[i, axis]) / work.length


@kernel
def contact_force(work: Work, touching: Touching, force: Floats) -> None:
    """Add the contact forces of the current motion to `force` [N, 3] [N]."""
    time_step, parameters, motion = work.time_step, work.parameters, work.motion
    timing = Timing(time_step, 0.0)
    _point_point(touching.point_point, parameters, motion, timing, force)
    _point_edge(touching.point_edge, parameters, motion, timing, force)
    _point_face(touching.point_face, parameters, motion, timing, force)
    _edge_edge(touching.edge_edge, parameters, motion, timing, force)
    _plane(touching.plane, parameters, motion, timing, force)


@kernel
def residual(
    work: Work,
    velocity: Floats,
    points: Floats,
    turned: Floats,
    touching: Touching,
    found: Floats,
) -> None:
    """Compute the residual r [D, 3] into `found` [N·s, rotations N·m·s], and set the motion."""
    first_body_point, time_step, terms, parameters = work.first_body_point, work.time_step, work.terms, work.parameters
    motion, start_positions, holder, start_bodies = work.motion, work.start_positions, work.holder, work.start_bodies
    rigid, start_velocities, gravity, target = work.rigid, work.start_velocities, work.gravity, work.target
    dt, nodes = time_step, len(start_positions)
    set_motion(work, velocity, points)
    timing, force = Timing(dt, 0.0), np.zeros((len(points), 3))
    _force(terms, parameters, motion, timing, force)
    contact_force(work, touching, force)
    for i in range(nodes):
        h = holder[i]
        for axis in range(3):
            if h >= 0:
                wanted = (target[h, axis] - start_positions[i, axis]) / dt
                found[i, axis] = parameters.node_mass[i] * (velocity[i, axis] - wanted)
            else:
                change = velocity[i, axis] - start_velocities[i, axis]
                found[i, axis] = parameters.node_mass[i] * change - dt * force[i, axis]
    for b in range(len(start_bodies)):
        mass, row = parameters.body_mass[b], nodes + 2 * b
        for axis in range(3):
            change = velocity[row, axis] - start_bodies[b, 12 + axis] - dt * gravity[axis]
            found[row, axis] = mass * change
            found[row + 1, axis] = mass * turned[b, 9 + axis]
    first = first_body_point
    for p in range(len(rigid.body)):
        b = rigid.body[p]
        row, push = nodes + 2 * b, force[first + p]
        a0, a1, a2 = arm_of(rigid, turned, p)
        for axis in range(3):
            found[row, axis] -= dt * push[axis]
        found[row + 1, 0] -= dt * (a1 * push[2] - a2 * push[1])
        found[row + 1, 1] -= dt * (a2 * push[0] - a0 * push[2])
        found[row + 1, 2] -= dt * (a0 * push[1] - a1 * push[0])


@kernel
def arm_of(rigid: Rigid, turned: Floats, p: int) -> tuple[float, float, float]:
    """Vector from the centre of mass to point p of a body, in the world frame [m]; `turned` [B, 9 or more] starts with the
    rotation matrix."""
    own, t = rigid.points[p], turned[rigid.body[p]]
    return (
        t[0] * own[0] + t[1] * own[1] + t[2] * own[2],
        t[3] * own[0] + t[4] * own[1] + t[5] * own[2],
        t[6] * own[0] + t[7] * own[1] + t[8] * own[2],
    )


@kernel
def first_velocities(work: Work) -> Floats:
    """Velocities [D, 3] at the start of the part. Prescribed nodes have those that lead to their targets."""
    start_positions, start_bodies, start_velocities = work.start_positions, work.start_bodies, work.start_velocities
    holder, target, dt = work.holder, work.target, work.time_step
    nodes, count = len(start_positions), len(start_bodies)
    found = np.empty((nodes + 2 * count, 3))
    for i in range(nodes):
        h = holder[i]
        for axis in range(3):
            found[i, axis] = start_velocities[i, axis]
            if h >= 0:
                found[i, axis] = (target[h, axis] - start_positions[i, axis]) / dt
    for b in range(count):
        for axis in range(3):
            found[nodes + 2 * b, axis] = start_bodies[b, 12 + axis]
            found[nodes + 2 * b + 1, axis] = start_bodies[b, 15 + axis]
    return found


@kernel
def resting_velocities(work: Work) -> Floats:
    """Velocities [D, 3] with which all points stay at their current positions."""
    start_points, start_positions, time_step = work.start_points, work.start_positions, work.time_step
    found = np.zeros((len(start_positions) + 2 * len(work.start_bodies), 3))
    for i in range(len(start_positions)):
        for axis in range(3):
            found[i, axis] = (start_points[i, axis] - start_positions[i, axis]) / time_step
    return found


@kernel
def finish(work: Work, velocity: Floats, turned: Floats, positions: Floats, velocities: Floats, bodies: Floats) -> None:
    """Write positions and velocities [V, 3] and bodies [B, 18] after the step. Prescribed nodes are at their targets."""
    time_step, start_positions, holder, start_bodies = work.time_step, work.start_positions, work.holder, work.start_bodies
    target = work.target
    dt, nodes = time_step, len(start_positions)
    for i in range(nodes):
        h = holder[i]
        for axis in range(3):
            v = velocity[i, axis]
            if h >= 0:
                v = (target[h, axis] - start_positions[i, axis]) / dt
            velocities[i, axis] = v
            positions[i, axis] = start_positions[i, axis] + dt * v
    new = np.empty(BODY)
    for b in range(len(start_bodies)):
        for axis in range(3):
            new[12 + axis], new[15 + axis] = velocity[nodes + 2 * b, axis], velocity[nodes + 2 * b + 1, axis]
            new[axis] = start_bodies[b, axis] + dt * new[12 + axis]
        for k in range(9):
            new[3 + k] = turned[b, k]
        for k in range(BODY):
            bodies[b, k] = new[k]
