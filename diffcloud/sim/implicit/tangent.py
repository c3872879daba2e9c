"""Forward-mode derivatives of an episode of implicit steps along several directions, with one factorisation per part of a
step."""

from __future__ import annotations

import numpy as np

from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters, Timing
from diffcloud.sim.compiled.lu import solve_general
from diffcloud.sim.held import Held, aim, aim_tangent, first_anchors, holders, take_anchors_tangent
from diffcloud.sim.implicit.equation import arm_of, contact_force, spin_inputs
from diffcloud.sim.implicit.parts import Solved, solved_part
from diffcloud.sim.implicit.scene import BODY, Kept, Scene, Work, new_work
from diffcloud.sim.implicit.terms import kernels

_tangent, _spin_tangent = kernels.tangent, kernels.spin_tangent
_point_point, _point_edge = kernels.barrier_point_point_tangent, kernels.barrier_point_edge_tangent
_point_face, _edge_edge = kernels.barrier_point_face_tangent, kernels.barrier_edge_edge_tangent
_plane = kernels.barrier_plane_tangent


@kernel
def tangents(
    scene: Scene,
    held: Held,
    parameters: Parameters,
    parameter_rates: Parameters,
    track: Floats,
    track_rates: Floats,
    obstacles: Floats,
    anchors: Floats,
    positions: Floats,
    velocities: Floats,
    bodies: Floats,
    kept: Kept,
    position_rates: Floats,
    velocity_rates: Floats,
    body_rates: Floats,
) -> None:
    """Propagate K directional derivatives through an episode that `step.simulate` kept.

    Args:
        parameter_rates: derivatives, each field with a leading axis K. `hold` must be zero. `target` is scratch space.
        track_rates: [K, S, G, 3] derivatives of the track.
        track, obstacles, anchors, positions, velocities, bodies: as passed to and filled by `simulate`.
        position_rates, velocity_rates, body_rates: [S + 1, K, V, 3], [S + 1, K, V, 3], [S + 1, K, B, 18] derivatives of the
            states. The first rows are those of the initial state; the others are filled.
    """
    steps, nodes, count, directions = len(positions) - 1, positions.shape[1], bodies.shape[1], position_rates.shape[1]
    work, points = new_work(scene, parameters, nodes, count), scene.surface.point_count
    rates = Motion(
        np.zeros((directions, points, 3)),
        np.zeros((directions, points, 3)),
        np.zeros((directions, points, 3)),
        np.zeros((directions, points, 3)),
    )
    anchor_rates, target = np.empty((directions, len(held.node), 3)), np.empty((directions, len(held.node), 3))
    for d in range(directions):
        copy_to(anchor_rates[d], first_anchors(held, position_rates[0, d]))
    early_x, early_v = np.zeros((directions, nodes, 3)), np.zeros((directions, nodes, 3))  # of the part before
    for step in range(steps):
        take_anchors_tangent(held, track_rates, step, position_rates[step], anchor_rates)
        aim(held, track, step, anchors, parameters)
        aim_tangent(held, track_rates, step, anchor_rates, parameter_rates.target)
        work.holder = holders(held, step, nodes)
        x, v, own = position_rates[step + 1], velocity_rates[step + 1], body_rates[step + 1]
        for d in range(directions):
            for i in range(nodes):
                for axis in range(3):
                    x[d, i, axis], v[d, i, axis] = position_rates[step, d, i, axis], velocity_rates[step, d, i, axis]
            for b in range(count):
                for k in range(BODY):
                    own[d, b, k] = body_rates[step, d, b, k]
        for part in range(kept.begins[step], kept.begins[step + 1]):
            solved = solved_part(work, scene, obstacles, step, part, positions, velocities, bodies, kept)
            _aimed(work.holder, solved.gone, position_rates[step], parameter_rates.target, target)
            keep, back = work.keep, work.back
            for d in range(directions):
                for i in range(nodes):
                    for axis in range(3):
                        old_x, old_v = x[d, i, axis], v[d, i, axis]
                        x[d, i, axis], early_x[d, i, axis] = keep * old_x - back * early_x[d, i, axis], old_x
                        v[d, i, axis], early_v[d, i, axis] = keep * old_v - back * early_v[d, i, axis], old_v
            _part(work, parameter_rates, solved, rates, target, x, v, own)


@kernel
def _aimed(holder: Ints, gone: float, first: Floats, wanted: Floats, target: Floats) -> None:
    """Derivatives of the targets of prescribed nodes at the end of a part, from those of the step's start and of its
    targets."""
    for i in range(len(holder)):
        h = holder[i]
        if h >= 0:
            for d in range(len(target)):
                for axis in range(3):
                    target[d, h, axis] = first[d, i, axis] + gone * (wanted[d, h, axis] - first[d, i, axis])


@kernel
def _part(
    work: Work,
    parameter_rates: Parameters,
    solved: Solved,
    rates: Motion,
    wanted: Floats,
    x: Floats,
    v: Floats,
    own: Floats,
) -> None:
    """Convert the derivatives of a part's start (x, v [K, V, 3], own [K, B, 18]) to those of its end, in place."""
    time_step, holder, motion, parameters = work.time_step, work.holder, work.motion, work.parameters
    start_velocities = work.start_velocities
    w = solved.velocity
    dt, nodes, count, directions = time_step, x.shape[1], own.shape[1], len(x)
    speeds = np.zeros((directions, nodes, 3))  # of prescribed nodes
    for d in range(directions):
        for i in range(nodes):
            h = holder[i]
            for axis in range(3):
                if h >= 0:
                    speeds[d, i, axis] = (wanted[d, h, axis] - x[d, i, axis]) / dt
                speed = speeds[d, i, axis]
                rates.positions[d, i, axis] = x[d, i, axis] + dt * speed
                rates.before[d, i, axis] = rates.after[d, i, axis] = speed
                rates.displacement[d, i, axis] = parameter_rates.damping[d, 0] * w[i, axis] + parameters.damping[0] * speed
    turned = np.zeros((count, directions, 12))
    turns = np.zeros((directions, 15))
    for b in range(count):
        _turned(work, solved, b, own, turns, turned[b])
    _body_points(work, own, turned, rates)
    change = np.zeros((directions, len(motion.positions), 3))
    _forces(work, solved, parameter_rates, rates, change)
    right, found = np.zeros((len(w), 3)), np.empty((len(w), 3))
    force = np.zeros((len(motion.positions), 3))
    if count > 0:
        contact_force(work, solved.touching, force)
    for d in range(directions):
        for i in range(nodes):
            for axis in range(3):
                right[i, axis] = 0.0
                if holder[i] < 0:
                    right[i, axis] = dt * change[d, i, axis] + parameters.node_mass[i] * v[d, i, axis]
                    right[i, axis] -= parameter_rates.node_mass[d, i] * (w[i, axis] - start_velocities[i, axis])
        if count > 0:
            _body_rows(work, parameter_rates, solved, d, own, turned, force, change, right)
        solve_general(solved.matrix, right, 0, found)
        for i in range(nodes):
            for axis in range(3):
                v[d, i, axis] = speeds[d, i, axis] if holder[i] >= 0 else found[i, axis]
                x[d, i, axis] += dt * v[d, i, axis]
        for b in range(count):
            for axis in range(3):
                turns[d, 12 + axis] = found[nodes + 2 * b + 1, axis]
                own[d, b, 12 + axis] = found[nodes + 2 * b, axis]
                own[d, b, axis] += dt * found[nodes + 2 * b, axis]
            _finish(work, solved, b, d, own, turns, turned[b])


@kernel
def _turned(work: Work, solved: Solved, b: int, own: Floats, turns: Floats, found: Floats) -> None:
    """Derivatives [K, 12] of a body's `spin`, with its new angular velocity held constant."""
    start_positions = work.start_positions
    inputs, constants = np.empty(15), np.empty(10)
    spin_inputs(work, b, solved.velocity[len(start_positions) + 2 * b + 1], inputs, constants)
    for d in range(len(own)):
        for k in range(9):
            turns[d, k] = own[d, b, 3 + k]
        for k in range(3):
            turns[d, 9 + k], turns[d, 12 + k] = own[d, b, 15 + k], 0.0
    _spin_tangent(inputs, constants, turns, found)


@kernel
def _finish(work: Work, solved: Solved, b: int, d: int, own: Floats, turns: Floats, found: Floats) -> None:
    """Update the derivatives of a body's orientation and angular velocity. turns[d, 12:] has that of the new angular
    velocity."""
    start_positions = work.start_positions
    inputs, constants = np.empty(15), np.empty(10)
    spin_inputs(work, b, solved.velocity[len(start_positions) + 2 * b + 1], inputs, constants)
    for k in range(9):
        turns[d, k] = own[d, b, 3 + k]
    for k in range(3):
        turns[d, 9 + k] = own[d, b, 15 + k]
    _spin_tangent(inputs, constants, turns[d : d + 1], found[d : d + 1])
    for k in range(9):
        own[d, b, 3 + k] = found[d, k]
    for k in range(3):
        own[d, b, 15 + k] = turns[d, 12 + k]


@kernel
def _body_points(work: Work, own: Floats, turned: Floats, rates: Motion) -> None:
    """Derivatives of the bodies' points, and of their straight motion through the step."""
    time_step, first_body_point, rigid = work.time_step, work.first_body_point, work.rigid
    dt, first = time_step, first_body_point
    for p in range(len(rigid.body)):
        b = rigid.body[p]
        for d in range(len(own)):
            for axis in range(3):
                new = old = 0.0
                for k in range(3):
                    new += turned[b, d, 3 * axis + k] * rigid.points[p, k]
                    old += own[d, b, 3 + 3 * axis + k] * rigid.points[p, k]
                rates.positions[d, first + p, axis] = own[d, b, axis] + new
                rates.before[d, first + p, axis] = rates.after[d, first + p, axis] = (new - old) / dt


@kernel
def _body_rows(
    work: Work,
    parameter_rates: Parameters,
    solved: Solved,
    d: int,
    own: Floats,
    turned: Floats,
    force: Floats,
    change: Floats,
    right: Floats,
) -> None:
    """Rows of the bodies in the right-hand side -dr along direction d."""
    time_step, first_body_point, start_positions, rigid = (
        work.time_step,
        work.first_body_point,
        work.start_positions,
        work.rigid,
    )
    parameters, start_bodies, gravity = work.parameters, work.start_bodies, work.gravity
    w, ended, nodes, dt, first = solved.velocity, solved.turned, len(start_positions), time_step, first_body_point
    for b in range(own.shape[1]):
        row, mass, rate = nodes + 2 * b, parameters.body_mass[b], parameter_rates.body_mass[d, b]
        for axis in range(3):
            gone = w[row, axis] - start_bodies[b, 12 + axis] - dt * gravity[axis]
            right[row, axis] = mass * own[d, b, 12 + axis] - rate * gone
            right[row + 1, axis] = -rate * ended[b, 9 + axis] - mass * turned[b, d, 9 + axis]
    along = turned[:, d].copy()
    for p in range(len(rigid.body)):
        b = rigid.body[p]
        row = nodes + 2 * b
        arm, push, pushed = arm_of(rigid, ended, p), force[first + p], change[d, first + p]
        lever = arm_of(rigid, along, p)
        for axis in range(3):
            j, k = (axis + 1) % 3, (axis + 2) % 3
            right[row, axis] += dt * pushed[axis]
            right[row + 1, axis] += dt * (arm[j] * pushed[k] - arm[k] * pushed[j] + lever[j] * push[k] - lever[k] * push[j])


@kernel
def _forces(work: Work, solved: Solved, parameter_rates: Parameters, rates: Motion, change: Floats) -> None:
    """Derivatives [K, N, 3] of all forces."""
    terms, parameters, motion, time_step = work.terms, work.parameters, work.motion, work.time_step
    timing, touching = Timing(time_step, 0.0), solved.touching
    _tangent(terms, parameters, motion, timing, parameter_rates, rates, change)
    _point_point(touching.point_point, parameters, motion, timing, parameter_rates, rates, change)
    _point_edge(touching.point_edge, parameters, motion, timing, parameter_rates, rates, change)
    _point_face(touching.point_face, parameters, motion, timing, parameter_rates, rates, change)
    _edge_edge(touching.edge_edge, parameters, motion, timing, parameter_rates, rates, change)
    _plane(touching.plane, parameters, motion, timing, parameter_rates, rates, change)
