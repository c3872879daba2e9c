"""Reverse-mode derivatives of an episode of implicit steps: one transposed solve for each part of a step."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Motion, Parameters, Timing
from diffcloud.sim.compiled.lu import solve_general
from diffcloud.sim.held import Held, aim, aim_reverse, first_anchors_reverse, holders, take_anchors_reverse
from diffcloud.sim.implicit.equation import arm_of, contact_force, spin_inputs
from diffcloud.sim.implicit.parts import Solved, solved_part
from diffcloud.sim.implicit.scene import BODY, Kept, Scene, Work, new_work
from diffcloud.sim.implicit.terms import kernels

_reverse, _spin_reverse = kernels.reverse, kernels.spin_reverse
_point_point, _point_edge = kernels.barrier_point_point_reverse, kernels.barrier_point_edge_reverse
_point_face, _edge_edge = kernels.barrier_point_face_reverse, kernels.barrier_edge_edge_reverse
_plane = kernels.barrier_plane_reverse


@kernel
def reverse(
    scene: Scene,
    held: Held,
    parameters: Parameters,
    track: Floats,
    obstacles: Floats,
    anchors: Floats,
    positions: Floats,
    velocities: Floats,
    bodies: Floats,
    kept: Kept,
    position_gradients: Floats,
    velocity_gradients: Floats,
    body_gradients: Floats,
    parameter_gradients: Parameters,
    track_gradients: Floats,
) -> None:
    """Propagate gradients backwards through an episode that `step.simulate` kept.

    Args:
        track, obstacles, anchors, positions, velocities, bodies: as passed to and filled by `simulate`.
        position_gradients, velocity_gradients, body_gradients: [S + 1, V, 3], [S + 1, V, 3], [S + 1, B, 18] gradients of a
            loss with respect to the state after each step. The first rows receive the gradients of the initial state.
        parameter_gradients: zeros; receives the sums over all steps.
        track_gradients: [S, G, 3] zeros; receives the gradients of the track.
    """
    steps, nodes, count = len(positions) - 1, positions.shape[1], bodies.shape[1]
    work, points = new_work(scene, parameters, nodes, count), scene.surface.point_count
    speeds = np.empty((points, 3))  # one array: the gradients of the velocities before and after a step
    slopes = Motion(np.empty((points, 3)), speeds, speeds, np.empty((points, 3)))
    anchor_gradients, target = np.zeros((len(held.node), 3)), np.empty((len(held.node), 3))
    x, v, own = np.empty((nodes, 3)), np.empty((nodes, 3)), np.empty((count, BODY))
    early_x, early_v = np.zeros((nodes, 3)), np.zeros((nodes, 3))  # gradients of a part's start, through the part after it
    for step in range(steps - 1, -1, -1):
        aim(held, track, step, anchors, parameters)
        holder = work.holder = holders(held, step, nodes)
        parameter_gradients.target[:] = 0.0
        for i in range(nodes):
            for axis in range(3):
                x[i, axis], v[i, axis] = position_gradients[step + 1, i, axis], velocity_gradients[step + 1, i, axis]
        for b in range(count):
            for k in range(BODY):
                own[b, k] = body_gradients[step + 1, b, k]
        for part in range(kept.begins[step + 1] - 1, kept.begins[step] - 1, -1):
            solved = solved_part(work, scene, obstacles, step, part, positions, velocities, bodies, kept)
            target[:] = 0.0
            _part(work, solved, slopes, x, v, own, parameter_gradients, target)
            keep, back = work.keep, work.back
            for i in range(nodes):
                for axis in range(3):
                    by_x, by_v = x[i, axis], v[i, axis]
                    x[i, axis], early_x[i, axis] = keep * by_x + early_x[i, axis], -back * by_x
                    v[i, axis], early_v[i, axis] = keep * by_v + early_v[i, axis], -back * by_v
            gone = solved.gone
            for i in range(nodes):
                h = holder[i]
                if h >= 0:
                    for axis in range(3):
                        parameter_gradients.target[h, axis] += gone * target[h, axis]
                        position_gradients[step, i, axis] += (1 - gone) * target[h, axis]
        for i in range(nodes):
            for axis in range(3):
                position_gradients[step, i, axis] += x[i, axis]
                velocity_gradients[step, i, axis] += v[i, axis]
        for b in range(count):
            for k in range(BODY):
                body_gradients[step, b, k] += own[b, k]
        aim_reverse(held, step, parameter_gradients.target, anchor_gradients, track_gradients)
        take_anchors_reverse(held, step, anchor_gradients, position_gradients[step], track_gradients)
    first_anchors_reverse(held, anchor_gradients, position_gradients[0])
    parameter_gradients.target[:] = 0.0
    parameter_gradients.hold[:] = 0.0


@kernel
def _part(
    work: Work,
    solved: Solved,
    slopes: Motion,
    x: Floats,
    v: Floats,
    own: Floats,
    gradients: Parameters,
    wanted: Floats,
) -> None:
    """Convert the gradients of a part's end to those of its start, in place.

    Args:
        x, v: [V, 3] gradients of positions and velocities.
        own: [B, 18] gradients of the bodies.
        wanted: [H, 3] receives the gradients of the targets.
    """
    time_step, parameters, holder, start_velocities = work.time_step, work.parameters, work.holder, work.start_velocities
    w = solved.velocity
    dt, nodes, count = time_step, len(x), len(own)
    right, y = np.zeros((len(w), 3)), np.zeros((len(w), 3))
    for i in range(nodes):
        if holder[i] < 0:
            for axis in range(3):
                right[i, axis] = v[i, axis] + dt * x[i, axis]
    inputs, constants = np.empty(15), np.empty(10)
    pull, pulled = np.zeros(12), np.empty(15)
    for b in range(count):
        row = nodes + 2 * b
        spin_inputs(work, b, w[row + 1], inputs, constants)
        for k in range(9):
            pull[k] = own[b, 3 + k]
        pulled[:] = 0.0
        _spin_reverse(inputs, constants, pull, pulled)
        for axis in range(3):
            right[row, axis] = own[b, 12 + axis] + dt * own[b, axis]
            right[row + 1, axis] = own[b, 15 + axis] + pulled[12 + axis]
    solve_general(solved.matrix, right, 1, y)
    for i in range(nodes):
        if holder[i] >= 0:
            y[i, 0] = y[i, 1] = y[i, 2] = 0.0
    _forces(work, solved, y, gradients, slopes)
    damping = parameters.damping[0]
    for i in range(nodes):
        h = holder[i]
        for axis in range(3):
            moved, bent = slopes.after[i, axis], slopes.displacement[i, axis]
            gradients.damping[0] += bent * w[i, axis]
            if h >= 0:  # a prescribed node ends at its target, and its velocity follows from it
                speed = v[i, axis] + moved + damping * bent
                wanted[h, axis] += x[i, axis] + slopes.positions[i, axis] + speed / dt
                x[i, axis] = -speed / dt
                v[i, axis] = 0.0
            else:
                gradients.node_mass[i] -= (w[i, axis] - start_velocities[i, axis]) * y[i, axis]
                x[i, axis] += slopes.positions[i, axis]
                v[i, axis] = parameters.node_mass[i] * y[i, axis]
    if count > 0:
        _bodies(work, solved, slopes, y, own, gradients)


@kernel
def _forces(work: Work, solved: Solved, y: Floats, gradients: Parameters, slopes: Motion) -> None:
    """Gradients of Δt y · f, for the forces f on cloth nodes and on bodies."""
    first_body_point, time_step, terms, parameters = work.first_body_point, work.time_step, work.terms, work.parameters
    motion, start_positions, rigid = work.motion, work.start_positions, work.rigid
    dt, nodes = time_step, len(start_positions)
    adjoint, ended = np.zeros((len(motion.positions), 3)), solved.turned
    for i in range(nodes):
        for axis in range(3):
            adjoint[i, axis] = dt * y[i, axis]
    first = first_body_point
    for p in range(len(rigid.body)):
        row = nodes + 2 * rigid.body[p]
        a0, a1, a2 = arm_of(rigid, ended, p)
        turn = y[row + 1]
        adjoint[first + p, 0] = dt * (y[row, 0] + turn[1] * a2 - turn[2] * a1)
        adjoint[first + p, 1] = dt * (y[row, 1] + turn[2] * a0 - turn[0] * a2)
        adjoint[first + p, 2] = dt * (y[row, 2] + turn[0] * a1 - turn[1] * a0)
    slopes.positions[:] = 0.0
    slopes.after[:] = 0.0  # the same array holds the gradients of the velocities before the step
    slopes.displacement[:] = 0.0
    timing, touching = Timing(dt, 0.0), solved.touching
    _reverse(terms, parameters, motion, timing, adjoint, gradients, slopes)
    _point_point(touching.point_point, parameters, motion, timing, adjoint, gradients, slopes)
    _point_edge(touching.point_edge, parameters, motion, timing, adjoint, gradients, slopes)
    _point_face(touching.point_face, parameters, motion, timing, adjoint, gradients, slopes)
    _edge_edge(touching.edge_edge, parameters, motion, timing, adjoint, gradients, slopes)
    _plane(touching.plane, parameters, motion, timing, adjoint, gradients, slopes)


@kernel
def _bodies(work: Work, solved: Solved, slopes: Motion, y: Floats, own: Floats, gradients: Parameters) -> None:
    """Contribution of the rigid bodies to `_part`."""
    time_step, first_body_point, start_positions, rigid = (
        work.time_step,
        work.first_body_point,
        work.start_positions,
        work.rigid,
    )
    motion, parameters, start_bodies, gravity = work.motion, work.parameters, work.start_bodies, work.gravity
    w, ended = solved.velocity, solved.turned
    dt, nodes, count = time_step, len(start_positions), len(own)
    force = np.zeros((len(motion.positions), 3))
    contact_force(work, solved.touching, force)
    turned, before, first = np.zeros((count, 12)), np.zeros((count, 9)), first_body_point
    for p in range(len(rigid.body)):
        b = rigid.body[p]
        turn, f = y[nodes + 2 * b + 1], force[first + p]
        lever = (f[1] * turn[2] - f[2] * turn[1], f[2] * turn[0] - f[0] * turn[2], f[0] * turn[1] - f[1] * turn[0])
        for axis in range(3):
            old = slopes.after[first + p, axis] / dt  # through the point's position at the start of the step
            new = slopes.positions[first + p, axis] + old
            own[b, axis] += new - old
            for k in range(3):
                turned[b, 3 * axis + k] += (new + dt * lever[axis]) * rigid.points[p, k]
                before[b, 3 * axis + k] -= old * rigid.points[p, k]
    inputs, constants, pulled = np.empty(15), np.empty(10), np.empty(15)
    for b in range(count):
        row, mass = nodes + 2 * b, parameters.body_mass[b]
        for k in range(9):
            turned[b, k] += own[b, 3 + k]
        for axis in range(3):
            change = w[row, axis] - start_bodies[b, 12 + axis] - dt * gravity[axis]
            gradients.body_mass[b] -= change * y[row, axis] + ended[b, 9 + axis] * y[row + 1, axis]
            turned[b, 9 + axis] = -mass * y[row + 1, axis]
        spin_inputs(work, b, w[row + 1], inputs, constants)
        pulled[:] = 0.0
        _spin_reverse(inputs, constants, turned[b], pulled)
        for k in range(9):
            own[b, 3 + k] = pulled[k] + before[b, k]
        for axis in range(3):
            own[b, 12 + axis] = mass * y[row, axis]
            own[b, 15 + axis] = pulled[9 + axis]
