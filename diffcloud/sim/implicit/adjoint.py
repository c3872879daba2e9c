"""Derivatives of an episode of implicit steps in reverse: one transposed solve for each part of a step."""

from __future__ import annotations

import numpy as np

from diffcloud.sim.compiled.data import Floats, Motion, Parameters, Timing
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.compiled.lu import solve_general
from diffcloud.sim.contact.places import Touching
from diffcloud.sim.held import Held, aim, aim_reverse, holders, take_anchors_reverse
from diffcloud.sim.implicit.equation import arm_of, contact_force, room_for_motion, spin_inputs
from diffcloud.sim.implicit.parts import Solved, along, solved_part
from diffcloud.sim.implicit.scene import BODY, Kept, Scene
from diffcloud.sim.terms import kernels

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
    """Sweep gradients backwards through an episode that `step.simulate` kept.

    Args:
        track, obstacles, anchors, positions, velocities, bodies: as `simulate` took and left them.
        position_gradients, velocity_gradients, body_gradients: [S + 1, V, 3], [S + 1, V, 3], [S + 1, B, 18] of a loss by each
            step's outcome; the first rows take those by the start.
        parameter_gradients: zeros, takes the sums.
        track_gradients: [S, 3] zeros, takes those by the track.
    """
    steps, nodes, count = len(positions) - 1, positions.shape[1], bodies.shape[1]
    motion, slopes = room_for_motion(scene), room_for_motion(scene)
    anchor_gradients, target = np.zeros((len(held.node), 3)), np.empty((len(held.node), 3))
    x, v, own = np.empty((nodes, 3)), np.empty((nodes, 3)), np.empty((count, BODY))
    for step in range(steps - 1, -1, -1):
        aim(held, track, step, anchors, parameters)
        holder = holders(held, step, nodes)
        parameter_gradients.target[:] = 0.0
        for i in range(nodes):
            for axis in range(3):
                x[i, axis], v[i, axis] = position_gradients[step + 1, i, axis], velocity_gradients[step + 1, i, axis]
        for b in range(count):
            for k in range(BODY):
                own[b, k] = body_gradients[step + 1, b, k]
        for part in range(kept.begins[step + 1] - 1, kept.begins[step] - 1, -1):
            solved = solved_part(
                scene, parameters, obstacles, step, part, positions[step], velocities[step], bodies[step], holder, kept, motion
            )
            target[:] = 0.0
            _part(scene, parameters, solved, motion, slopes, x, v, own, parameter_gradients, target)
            gone = along(solved.end)
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
    for h in range(len(held.node)):
        for axis in range(3):
            position_gradients[0, held.node[h], axis] += anchor_gradients[h, axis]
    parameter_gradients.target[:] = 0.0
    parameter_gradients.hold[:] = 0.0


@kernel
def _part(
    scene: Scene,
    parameters: Parameters,
    solved: Solved,
    motion: Motion,
    slopes: Motion,
    x: Floats,
    v: Floats,
    own: Floats,
    gradients: Parameters,
    target: Floats,
) -> None:
    """Gradients by the end of a part (x, v [V, 3], own [B, 18]) become those by its start; target [H, 3] takes its own."""
    start, w = solved.start, solved.velocity
    dt, nodes, count = start.time_step, len(x), len(own)
    right, y = np.zeros((len(w), 3)), np.zeros((len(w), 3))
    for i in range(nodes):
        if start.holder[i] < 0:
            for axis in range(3):
                right[i, axis] = v[i, axis] + dt * x[i, axis]
    inputs, constants = np.empty(15), np.empty(10)
    pull, pulled = np.zeros(12), np.empty(15)
    for b in range(count):
        row = nodes + 2 * b
        spin_inputs(scene, start, b, w[row + 1], inputs, constants)
        for k in range(9):
            pull[k] = own[b, 3 + k]
        pulled[:] = 0.0
        _spin_reverse(inputs, constants, pull, pulled)
        for axis in range(3):
            right[row, axis] = own[b, 12 + axis] + dt * own[b, axis]
            right[row + 1, axis] = own[b, 15 + axis] + pulled[12 + axis]
    solve_general(solved.matrix, right, 1, y)
    for i in range(nodes):
        if start.holder[i] >= 0:
            y[i, 0] = y[i, 1] = y[i, 2] = 0.0
    _forces(scene, parameters, solved, motion, y, gradients, slopes)
    damping = parameters.damping[0]
    for i in range(nodes):
        h = start.holder[i]
        for axis in range(3):
            moved, bent = slopes.after[i, axis], slopes.displacement[i, axis]
            gradients.damping[0] += bent * w[i, axis]
            if h >= 0:  # its end is the target, and its velocity leads there
                speed = v[i, axis] + moved + damping * bent
                target[h, axis] += x[i, axis] + slopes.positions[i, axis] + speed / dt
                x[i, axis] = -speed / dt
                v[i, axis] = 0.0
            else:
                gradients.node_mass[i] -= (w[i, axis] - start.velocities[i, axis]) * y[i, axis]
                x[i, axis] += slopes.positions[i, axis]
                v[i, axis] = parameters.node_mass[i] * y[i, axis]
    if count > 0:
        _bodies(scene, parameters, solved, motion, slopes, y, own, gradients)


@kernel
def _forces(
    scene: Scene, parameters: Parameters, solved: Solved, motion: Motion, y: Floats, gradients: Parameters, slopes: Motion
) -> None:
    """Gradients of Δt y · f, of forces on cloth nodes and on bodies."""
    start = solved.start
    dt, nodes = start.time_step, len(start.positions)
    adjoint = np.zeros((len(motion.positions), 3))
    for i in range(nodes):
        for axis in range(3):
            adjoint[i, axis] = dt * y[i, axis]
    first = nodes + scene.obstacle_points
    for p in range(len(scene.rigid.body)):
        row = nodes + 2 * scene.rigid.body[p]
        a0, a1, a2 = arm_of(scene, solved.turned, p)
        turn = y[row + 1]
        adjoint[first + p, 0] = dt * (y[row, 0] + turn[1] * a2 - turn[2] * a1)
        adjoint[first + p, 1] = dt * (y[row, 1] + turn[2] * a0 - turn[0] * a2)
        adjoint[first + p, 2] = dt * (y[row, 2] + turn[0] * a1 - turn[1] * a0)
    slopes.positions[:] = 0.0
    slopes.after[:] = 0.0  # those by the velocities before the step are the same array
    slopes.displacement[:] = 0.0
    timing = Timing(dt, 0.0)
    _reverse(scene.terms, parameters, motion, timing, adjoint, gradients, slopes)
    _contacts(solved.touching, parameters, motion, timing, adjoint, gradients, slopes)


@kernel
def _contacts(  # type: ignore[no-untyped-def]
    touching: Touching, parameters: Parameters, motion: Motion, timing: Timing, adjoint: Floats, gradients: Parameters, slopes
):
    _point_point(touching.point_point, parameters, motion, timing, adjoint, gradients, slopes)
    _point_edge(touching.point_edge, parameters, motion, timing, adjoint, gradients, slopes)
    _point_face(touching.point_face, parameters, motion, timing, adjoint, gradients, slopes)
    _edge_edge(touching.edge_edge, parameters, motion, timing, adjoint, gradients, slopes)
    _plane(touching.plane, parameters, motion, timing, adjoint, gradients, slopes)


@kernel
def _bodies(
    scene: Scene,
    parameters: Parameters,
    solved: Solved,
    motion: Motion,
    slopes: Motion,
    y: Floats,
    own: Floats,
    gradients: Parameters,
) -> None:
    """The rigid bodies' part of `_part`."""
    start, w = solved.start, solved.velocity
    dt, nodes, count = start.time_step, len(start.positions), len(own)
    force = np.zeros((len(motion.positions), 3))
    contact_force(solved.touching, parameters, motion, Timing(dt, 0.0), force)
    turned, before, first = np.zeros((count, 12)), np.zeros((count, 9)), nodes + scene.obstacle_points
    for p in range(len(scene.rigid.body)):
        b = scene.rigid.body[p]
        turn, f = y[nodes + 2 * b + 1], force[first + p]
        lever = (f[1] * turn[2] - f[2] * turn[1], f[2] * turn[0] - f[0] * turn[2], f[0] * turn[1] - f[1] * turn[0])
        for axis in range(3):
            old = slopes.after[first + p, axis] / dt  # of the way from where the point was
            new = slopes.positions[first + p, axis] + old
            own[b, axis] += new - old
            for k in range(3):
                turned[b, 3 * axis + k] += (new + dt * lever[axis]) * scene.rigid.points[p, k]
                before[b, 3 * axis + k] -= old * scene.rigid.points[p, k]
    inputs, constants, pulled = np.empty(15), np.empty(10), np.empty(15)
    for b in range(count):
        row, mass = nodes + 2 * b, parameters.body_mass[b]
        for k in range(9):
            turned[b, k] += own[b, 3 + k]
        for axis in range(3):
            change = w[row, axis] - start.bodies[b, 12 + axis] - dt * scene.gravity[axis]
            gradients.body_mass[b] -= change * y[row, axis] + solved.turned[b, 9 + axis] * y[row + 1, axis]
            turned[b, 9 + axis] = -mass * y[row + 1, axis]
        spin_inputs(scene, start, b, w[row + 1], inputs, constants)
        pulled[:] = 0.0
        _spin_reverse(inputs, constants, turned[b], pulled)
        for k in range(9):
            own[b, 3 + k] = pulled[k] + before[b, k]
        for axis in range(3):
            own[b, 12 + axis] = mass * y[row, axis]
            own[b, 15 + axis] = pulled[9 + axis]
