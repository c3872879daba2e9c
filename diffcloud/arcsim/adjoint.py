"""Gradients of a loss through a rollout of ARCSim's steps, by the adjoint method from the last step to the first.

Let r(u, p) = 0 be a step's equation, A its matrix, and g the gradient of the loss with respect to u. The adjoint y solves
A y = g with the matrix factor of the step, which takes one solve. The gradient with respect to any input p of the equation
is -yᵀ ∂r/∂p.
"""

from __future__ import annotations

import numpy as np

from diffcloud.arcsim.contact.impact_derivatives import resolve_reverse
from diffcloud.arcsim.matrix import linear_system, pattern_with, repelling
from diffcloud.arcsim.record import Kept
from diffcloud.arcsim.scene import Scene
from diffcloud.arcsim.step import displace, mobility, project, still, with_obstacles
from diffcloud.arcsim.terms import kernels
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters, Timing
from diffcloud.sim.compiled.sparse import cholesky, solve
from diffcloud.sim.held import Held, aim, aim_reverse, first_anchors_reverse, holders, take_anchors_reverse

_reverse = kernels.reverse
_point_face_reverse = kernels.proximity_point_face_reverse
_edge_edge_reverse = kernels.proximity_edge_edge_reverse


@kernel
def reverse(
    scene: Scene,
    held: Held,
    parameters: Parameters,
    track: Floats,
    anchors: Floats,
    positions: Floats,
    velocities: Floats,
    kept: Kept,
    position_gradients: Floats,
    velocity_gradients: Floats,
    gradients: Parameters,
    track_gradients: Floats,
) -> None:
    """Propagate gradients backwards through an episode.

    Args:
        anchors, positions, velocities: as `simulate` left them.
        position_gradients, velocity_gradients: [S + 1, V, 3] of a loss with respect to positions and velocities. The first
            rows receive the gradients with respect to the initial state.
        gradients: zeros on entry; receives the sums over all steps.
        track_gradients: [S, G, 3] zeros on entry; receives the gradients with respect to the track.
    """
    dt = scene.time_step
    steps, nodes = len(positions) - 1, positions.shape[1]
    motion, slopes = still(scene, nodes), still(scene, nodes)
    points = len(motion.positions)
    anchor_gradient, start_gradient = np.zeros(anchors.shape), np.zeros((points, 3))
    places, adjoint = np.zeros((points, 3)), np.zeros((points, 3))
    right, mass_gradient = np.empty((nodes, 3)), np.zeros(points)
    for step in range(steps - 1, -1, -1):
        aim(held, track, step, anchors, parameters)
        holder = holders(held, step, nodes)
        restore(scene, parameters, positions[step], velocities[step], kept.solved[step], motion)
        x, v = position_gradients[step], velocity_gradients[step]
        after = velocity_gradients[step + 1]  # first of the velocities at the end, then of those before contact
        start_gradient[:] = 0.0
        for i in range(nodes):
            for axis in range(3):
                places[i, axis] = position_gradients[step + 1, i, axis] + after[i, axis] / dt
        candidate, above = candidates(scene, motion)
        if scene.collides and kept.begins[step + 1, 2] > kept.begins[step, 2]:
            mobile = mobility(parameters, holder)
            mass_gradient[:] = 0.0
            resolve_reverse(
                scene.projection,
                kept.impacts,
                kept.begins[step],
                kept.begins[step + 1],
                motion.positions,
                candidate,
                mobile,
                places,
                start_gradient,
                mass_gradient,
            )
            for i in range(nodes):
                if holder[i] < 0:
                    gradients.inverse_mass[i] += mass_gradient[i]
        stop_at_planes(scene, above, places, 1)
        for i in range(nodes):
            for axis in range(3):
                slope = places[i, axis] - after[i, axis] / dt
                x[i, axis] += slope + start_gradient[i, axis]
                after[i, axis] += dt * slope
        corners = kept.corners[kept.begins[step, 0] : kept.begins[step + 1, 0]]
        constants = kept.constants[kept.begins[step, 0] : kept.begins[step + 1, 0]]
        pattern, factor = factor_of(scene, parameters, motion, holder, kept, step, corners, constants)
        for i in range(nodes):
            for axis in range(3):
                right[i, axis] = 0.0 if holder[i] >= 0 else after[i, axis]
        solve(pattern, factor, right, adjoint)
        for i in range(nodes):
            for axis in range(3):
                change = kept.solved[step, i, axis] - velocities[step, i, axis]
                if holder[i] < 0:
                    gradients.node_mass[i] -= adjoint[i, axis] * change
                adjoint[i, axis] = 0.0 if holder[i] >= 0 else dt * adjoint[i, axis]
        clear(slopes)
        timing = Timing(dt, dt)
        gradients.target[:] = 0.0
        _reverse(scene.terms, parameters, motion, timing, adjoint, gradients, slopes)
        if len(corners) > 0:
            point_face, edge_edge = repelling(scene.repulsion.thickness, pattern, corners, constants)
            _point_face_reverse(point_face, parameters, motion, timing, adjoint, gradients, slopes)
            _edge_edge_reverse(edge_edge, parameters, motion, timing, adjoint, gradients, slopes)
        reach = dt + parameters.damping[0]
        for i in range(nodes):
            for axis in range(3):
                gradients.damping[0] += slopes.displacement[i, axis] * motion.after[i, axis]
                slope = after[i, axis] + slopes.after[i, axis] + reach * slopes.displacement[i, axis]
                x[i, axis] += slopes.positions[i, axis]
                v[i, axis] += slopes.before[i, axis]
                if holder[i] < 0:
                    v[i, axis] += slope
                else:  # the velocity of a prescribed node is (x* - x₀)/Δt
                    gradients.target[holder[i], axis] += slope / dt
                    x[i, axis] -= slope / dt
        aim_reverse(held, step, gradients.target, anchor_gradient, track_gradients)
        take_anchors_reverse(held, step, anchor_gradient, x, track_gradients)
    first_anchors_reverse(held, anchor_gradient, position_gradients[0])
    for i in range(nodes):
        gradients.node_mass[i] -= parameters.inverse_mass[i] ** 2 * gradients.inverse_mass[i]


@kernel
def restore(
    scene: Scene, parameters: Parameters, positions: Floats, velocities: Floats, solved: Floats, motion: Motion
) -> None:
    """Set `motion` to its state at a step's solution."""
    nodes = len(positions)
    copy_to(motion.positions[:nodes], positions)
    copy_to(motion.before[:nodes], velocities)
    copy_to(motion.after[:nodes], solved)
    displace(scene, parameters, nodes, motion)


@kernel
def candidates(scene: Scene, motion: Motion):  # type: ignore[no-untyped-def]
    """Return all points [N, 3] before the impacts of a step, and for each plane [P, V] whether it left a node in place."""
    nodes = len(scene.pattern.place)
    cloth = np.empty((nodes, 3))
    for i in range(nodes):
        for axis in range(3):
            cloth[i, axis] = motion.positions[i, axis] + scene.time_step * motion.after[i, axis]
    points = with_obstacles(scene, cloth)
    above = np.ones((len(scene.plane_offsets), nodes), np.bool_)
    project(scene, points, above)
    return points, above


@kernel
def stop_at_planes(scene: Scene, above, places: Floats, backwards: int) -> None:  # type: ignore[no-untyped-def]
    """Project vectors of nodes onto the planes that stop them: remove the component along each plane's normal. Each
    projection is its own transpose. The transpose of their product is the product in reverse order (`backwards`)."""
    count = len(above)
    for q in range(count):
        p = count - 1 - q if backwards > 0 else q
        normal = scene.plane_normals[p]
        for i in range(above.shape[1]):
            if not above[p, i]:
                along = normal[0] * places[i, 0] + normal[1] * places[i, 1] + normal[2] * places[i, 2]
                for axis in range(3):
                    places[i, axis] -= along * normal[axis]


@kernel
def factor_of(  # type: ignore[no-untyped-def]
    scene: Scene,
    parameters: Parameters,
    motion: Motion,
    holder: Ints,
    kept: Kept,
    step: int,
    corners: Ints,
    constants: Floats,
):
    """Return the pattern and the factor of a step's matrix. If the factor was not stored, it is computed again."""
    pattern, moved = pattern_with(scene.pattern, corners)
    begin, end = kept.begins[step, 4], kept.begins[step + 1, 4]
    if end > begin:
        return pattern, kept.factors[begin:end]
    force = np.zeros((len(motion.positions), 3))
    matrix = linear_system(scene, parameters, motion, holder, corners, constants, pattern, moved, force)
    factor = np.empty((len(pattern.factor_rows), 9))
    cholesky(pattern, matrix, factor)
    return pattern, factor


@kernel
def clear(motion: Motion) -> None:
    motion.positions[:] = 0.0
    motion.before[:] = 0.0
    motion.after[:] = 0.0
    motion.displacement[:] = 0.0
