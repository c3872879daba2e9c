"""The loop over ARCSim's steps of an episode: one linear system per step, then contact."""

from __future__ import annotations

import numpy as np

from diffcloud.arcsim.contact.impact_zones import TOUCH, resolve
from diffcloud.arcsim.contact.nearest import nearest_pairs
from diffcloud.arcsim.contact.neighbours import no_neighbours
from diffcloud.arcsim.matrix import linear_system, pattern_with
from diffcloud.arcsim.record import Kept, nothing_kept, remember, with_impacts
from diffcloud.arcsim.scene import NOT_POSITIVE_DEFINITE, UNRESOLVED, Scene
from diffcloud.compiled import kernel
from diffcloud.sim.compiled.copying import copy_to
from diffcloud.sim.compiled.data import Floats, Ints, Motion, Parameters
from diffcloud.sim.compiled.sparse import cholesky, solve
from diffcloud.sim.contact.surface import boxed
from diffcloud.sim.held import Held, aim, first_anchors, holders, take_anchors
from diffcloud.sim.status import DONE, INTERRUPTED, NOT_FINITE

_LARGEST = 1e100
"""Coordinates larger than this count as non-finite, because their differences overflow [m]."""


@kernel
def simulate(
    scene: Scene,
    held: Held,
    parameters: Parameters,
    track: Floats,
    anchors: Floats,
    positions: Floats,
    velocities: Floats,
    keep: int,
    control: Ints,
) -> tuple[int, int, Kept]:
    """Simulate all steps of one cloth.

    Args:
        track: [S, G, 3] displacement of each gripper at the end of each step [m]. Any length if no handle follows a track.
        anchors: [H, 3] receives the anchors of the handles.
        positions, velocities: [S + 1, V, 3] the first row is the initial state; receive the others.
        keep: how many rows of factors may be stored for the derivatives; negative to store nothing.
        control: [2] the first number counts finished steps. If another thread sets the second one, the run stops.

    Returns:
        The status, the index of the step in which the run ended, and the record for the derivatives.
    """
    steps, nodes = len(positions) - 1, positions.shape[1]
    kept = nothing_kept(steps if keep >= 0 else 0, nodes)
    surface = boxed(scene.surface)
    near = no_neighbours(surface, max(scene.repulsion.thickness, TOUCH))
    copy_to(anchors, first_anchors(held, positions[0]))
    points, motion = with_obstacles(scene, positions[0]), still(scene, nodes)
    force, above = np.empty((len(points), 3)), np.empty((len(scene.plane_offsets), nodes), np.bool_)
    for step in range(steps):
        if control[1] != 0:
            return INTERRUPTED, step, kept
        take_anchors(held, track, step, positions[step], anchors)
        aim(held, track, step, anchors, parameters)
        begin_motion(scene, held, parameters, step, positions[step], velocities[step], motion)
        if scene.repels:
            corners, constants = nearest_pairs(surface, near, scene.repulsion, motion.positions)
        else:
            corners, constants = np.empty((0, 5), np.int64), np.empty((0, 4))
        pattern, moved = pattern_with(scene.pattern, corners)
        holder = holders(held, step, nodes)
        force[:] = 0.0
        matrix = linear_system(scene, parameters, motion, holder, corners, constants, pattern, moved, force)
        factor = np.empty((len(pattern.factor_rows), 9))
        if not cholesky(pattern, matrix, factor):
            return NOT_POSITIVE_DEFINITE, step, kept
        candidate = positions[step + 1]
        change = np.empty((nodes, 3))
        for i in range(nodes):
            for axis in range(3):
                force[i, axis] = 0.0 if holder[i] >= 0 else scene.time_step * force[i, axis]
        solve(pattern, factor, force, change)
        finite = True
        for i in range(nodes):
            for axis in range(3):
                v = motion.after[i, axis] + change[i, axis]  # already correct for prescribed nodes
                velocities[step + 1, i, axis] = v
                points[i, axis] = positions[step, i, axis] + scene.time_step * v
                finite = finite and abs(points[i, axis]) < _LARGEST
        if not finite:
            return NOT_FINITE, step, kept
        if keep >= 0:
            kept = remember(kept, step, velocities[step + 1], corners, constants, factor, keep)
        project(scene, points, above)
        if scene.collides:
            mobile = mobility(parameters, holder)
            resolved, impacts = resolve(surface, near, scene.projection, motion.positions, points, mobile, kept.impacts)
            if not resolved:  # the last impact is named in the error
                return UNRESOLVED, step, Kept(kept.solved, kept.begins, kept.corners, kept.constants, impacts, kept.factors)
            kept = with_impacts(kept, impacts, step, keep)
        for i in range(nodes):
            for axis in range(3):
                x = positions[step, i, axis] + scene.time_step * velocities[step + 1, i, axis]
                velocities[step + 1, i, axis] += (points[i, axis] - x) / scene.time_step
                candidate[i, axis] = points[i, axis]
        control[0] += 1
    return DONE, steps, kept


@kernel
def with_obstacles(scene: Scene, cloth: Floats) -> Floats:
    """All points [N, 3]: cloth nodes [V, 3], then obstacles."""
    points = np.empty((len(cloth) + len(scene.obstacles), 3))
    copy_to(points[: len(cloth)], cloth)
    copy_to(points[len(cloth) :], scene.obstacles)
    return points


@kernel
def still(scene: Scene, nodes: int) -> Motion:
    """Allocate the motion of all points, with obstacles at rest."""
    count = nodes + len(scene.obstacles)
    motion = Motion(np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 3)))
    copy_to(motion.positions[nodes:], scene.obstacles)
    return motion


@kernel
def begin_motion(
    scene: Scene, held: Held, parameters: Parameters, step: int, positions: Floats, velocities: Floats, motion: Motion
) -> None:
    """Set the motion before a step's linear system: old velocities, except for nodes that handles prescribe."""
    dt = scene.time_step
    for i in range(len(positions)):
        for axis in range(3):
            motion.positions[i, axis] = positions[i, axis]
            motion.before[i, axis] = motion.after[i, axis] = velocities[i, axis]
    if held.hard:
        for h in range(len(held.node)):
            if held.strength[step, h] > 0:
                i = held.node[h]
                for axis in range(3):
                    motion.after[i, axis] = (parameters.target[h, axis] - positions[i, axis]) / dt
    displace(scene, parameters, len(positions), motion)


@kernel
def displace(scene: Scene, parameters: Parameters, nodes: int, motion: Motion) -> None:
    """Set the displacement d = (Δt + β) v of the linearised elastic forces F - H d."""
    reach = scene.time_step + parameters.damping[0]
    for i in range(nodes):
        for axis in range(3):
            motion.displacement[i, axis] = reach * motion.after[i, axis]


@kernel
def project(scene: Scene, points: Floats, above) -> None:  # type: ignore[no-untyped-def]
    """Move nodes behind a plane to the projection thickness above it. `above` [P, V] receives True for the other nodes."""
    for p in range(len(scene.plane_offsets)):
        normal = scene.plane_normals[p]
        for i in range(above.shape[1]):
            gap = normal[0] * points[i, 0] + normal[1] * points[i, 1] + normal[2] * points[i, 2] - scene.plane_offsets[p]
            above[p, i] = gap >= 0
            if gap < 0:
                for axis in range(3):
                    points[i, axis] += (scene.projection.thickness - gap) * normal[axis]


@kernel
def mobility(parameters: Parameters, holder: Ints) -> Floats:
    """Inverse masses [N] for the impacts; zero for prescribed nodes."""
    found = parameters.inverse_mass.copy()
    for i in range(len(holder)):
        if holder[i] >= 0:
            found[i] = 0.0
    return found
