"""Forward-mode derivatives of an episode of ARCSim's steps along K directions, with the factors of the steps."""

from __future__ import annotations

import numpy as np

from diffcloud.arcsim.adjoint import candidates, factor_of, restore, stop_at_planes
from diffcloud.arcsim.contact.impact_derivatives import resolve_tangent
from diffcloud.arcsim.matrix import repelling
from diffcloud.arcsim.record import Kept
from diffcloud.arcsim.scene import Scene
from diffcloud.arcsim.step import mobility, still
from diffcloud.arcsim.terms import kernels
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.data import Floats, Motion, Parameters, Timing
from diffcloud.sim.compiled.sparse import solve
from diffcloud.sim.held import Held, aim, aim_tangent, first_anchors, holders, take_anchors_tangent

_tangent = kernels.tangent
_point_face_tangent = kernels.proximity_point_face_tangent
_edge_edge_tangent = kernels.proximity_edge_edge_tangent


@kernel
def tangents(
    scene: Scene,
    held: Held,
    parameters: Parameters,
    rates: Parameters,
    track: Floats,
    track_rates: Floats,
    anchors: Floats,
    positions: Floats,
    velocities: Floats,
    kept: Kept,
    position_rates: Floats,
    velocity_rates: Floats,
) -> None:
    """Propagate K directional derivatives through an episode.

    Args:
        rates: derivatives of the parameters, with a leading axis K. `target` is overwritten.
        track_rates: [K, S, G, 3] derivatives of the track.
        anchors, positions, velocities: as `simulate` left them.
        position_rates, velocity_rates: [S + 1, K, V, 3] the first rows are those of the initial state; the others are
            filled.
    """
    dt = scene.time_step
    steps, nodes, directions = len(positions) - 1, positions.shape[1], position_rates.shape[1]
    motion = still(scene, nodes)
    points = len(motion.positions)
    anchor_rates = np.empty((directions, len(held.node), 3))
    for k in range(directions):
        anchor_rates[k] = first_anchors(held, position_rates[0, k])
    shape = (directions, points, 3)
    changes = Motion(np.zeros(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape))
    force, places = np.zeros(shape), np.zeros(shape)
    solution = np.empty((nodes, 3))
    for step in range(steps):
        take_anchors_tangent(held, track_rates, step, position_rates[step], anchor_rates)
        aim(held, track, step, anchors, parameters)
        aim_tangent(held, track_rates, step, anchor_rates, rates.target)
        holder = holders(held, step, nodes)
        restore(scene, parameters, positions[step], velocities[step], kept.solved[step], motion)
        x, v, after = position_rates[step], velocity_rates[step], velocity_rates[step + 1]
        reach = dt + parameters.damping[0]
        for k in range(directions):
            for i in range(nodes):
                for axis in range(3):
                    rate = v[k, i, axis]
                    if holder[i] >= 0:
                        rate = (rates.target[k, holder[i], axis] - x[k, i, axis]) / dt
                    after[k, i, axis] = changes.after[k, i, axis] = rate
                    changes.positions[k, i, axis], changes.before[k, i, axis] = x[k, i, axis], v[k, i, axis]
                    changes.displacement[k, i, axis] = reach * rate + rates.damping[k, 0] * motion.after[i, axis]
        corners = kept.corners[kept.begins[step, 0] : kept.begins[step + 1, 0]]
        constants = kept.constants[kept.begins[step, 0] : kept.begins[step + 1, 0]]
        pattern, factor = factor_of(scene, parameters, motion, holder, kept, step, corners, constants)
        force[:] = 0.0
        timing = Timing(dt, dt)
        _tangent(scene.terms, parameters, motion, timing, rates, changes, force)
        if len(corners) > 0:
            point_face, edge_edge = repelling(scene.repulsion.thickness, pattern, corners, constants)
            _point_face_tangent(point_face, parameters, motion, timing, rates, changes, force)
            _edge_edge_tangent(edge_edge, parameters, motion, timing, rates, changes, force)
        for k in range(directions):
            for i in range(nodes):
                for axis in range(3):
                    change = kept.solved[step, i, axis] - velocities[step, i, axis]
                    push = dt * force[k, i, axis] - rates.node_mass[k, i] * change
                    force[k, i, axis] = 0.0 if holder[i] >= 0 else push
            solve(pattern, factor, force[k], solution)
            for i in range(nodes):
                for axis in range(3):
                    after[k, i, axis] += solution[i, axis]
                    places[k, i, axis] = x[k, i, axis] + dt * after[k, i, axis]
        candidate, above = candidates(scene, motion)
        for k in range(directions):
            stop_at_planes(scene, above, places[k], 0)
        if scene.collides and kept.begins[step + 1, 2] > kept.begins[step, 2]:
            resolve_tangent(
                scene.projection,
                kept.impacts,
                kept.begins[step],
                kept.begins[step + 1],
                motion.positions,
                candidate,
                mobility(parameters, holder),
                changes.positions,
                rates.inverse_mass,
                places,
            )
        for k in range(directions):
            for i in range(nodes):
                for axis in range(3):
                    moved = x[k, i, axis] + dt * after[k, i, axis]
                    after[k, i, axis] += (places[k, i, axis] - moved) / dt
                    position_rates[step + 1, k, i, axis] = places[k, i, axis]
