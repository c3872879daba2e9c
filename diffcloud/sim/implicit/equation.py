"""The equation of one part of a step: where velocities take all points, the forces there, and the residual."""

from __future__ import annotations

import numpy as np

from diffcloud.sim.compiled.data import Floats, Motion, Parameters, Timing
from diffcloud.sim.compiled.kernel import kernel
from diffcloud.sim.contact.places import Touching
from diffcloud.sim.implicit.scene import BODY, Scene, Start
from diffcloud.sim.terms import kernels

_force, _spin = kernels.force, kernels.spin_value
_point_point, _point_edge = kernels.barrier_point_point_force, kernels.barrier_point_edge_force
_point_face, _edge_edge = kernels.barrier_point_face_force, kernels.barrier_edge_edge_force
_plane = kernels.barrier_plane_force


@kernel
def spin_inputs(scene: Scene, start: Start, b: int, turning: Floats, inputs: Floats, constants: Floats) -> None:
    """What `rigid.spin` wants of a body that ends with the angular velocity `turning` [3]."""
    constants[0] = start.time_step
    for k in range(9):
        inputs[k], constants[1 + k] = start.bodies[b, 3 + k], scene.rigid.gyration[b, k]
    for k in range(3):
        inputs[9 + k], inputs[12 + k] = start.bodies[b, 15 + k], turning[k]


@kernel
def place_points(
    scene: Scene, start: Start, velocity: Floats, scenery: Floats, points: Floats, turned: Floats
) -> None:
    """Points [N, 3] at the end of the step with velocities [D, 3] and obstacles at `scenery`; turned [B, 12] takes `spin`."""
    dt, nodes = start.time_step, len(start.positions)
    for i in range(nodes):
        for axis in range(3):
            points[i, axis] = start.positions[i, axis] + dt * velocity[i, axis]
    for o in range(len(scenery)):
        for axis in range(3):
            points[nodes + o, axis] = scenery[o, axis]
    inputs, constants = np.empty(15), np.empty(10)
    for b in range(len(start.bodies)):
        spin_inputs(scene, start, b, velocity[nodes + 2 * b + 1], inputs, constants)
        _spin(inputs, constants, turned[b])
    first = nodes + len(scenery)
    for p in range(len(scene.rigid.body)):
        b = scene.rigid.body[p]
        for axis in range(3):
            arm = 0.0
            for k in range(3):
                arm += turned[b, 3 * axis + k] * scene.rigid.points[p, k]
            points[first + p, axis] = start.bodies[b, axis] + dt * velocity[nodes + 2 * b, axis] + arm


@kernel
def body_points(scene: Scene, bodies: Floats, points: Floats, first: int) -> None:
    """The points of bodies in states [B, 18], into points [N, 3] from `first` on."""
    for p in range(len(scene.rigid.body)):
        body = bodies[scene.rigid.body[p]]
        for axis in range(3):
            points[first + p, axis] = body[axis]
            for k in range(3):
                points[first + p, axis] += body[3 + 3 * axis + k] * scene.rigid.points[p, k]


@kernel
def room_for_motion(scene: Scene) -> Motion:
    """Motion of all points; the velocities before and after a step are one array, that of its end."""
    count = scene.surface.point_count
    velocities = np.zeros((count, 3))
    return Motion(np.zeros((count, 3)), velocities, velocities, np.zeros((count, 3)))


@kernel
def set_motion(start: Start, parameters: Parameters, velocity: Floats, points: Floats, motion: Motion) -> None:
    """The motion as terms see it: velocities are those of the straight way through the step."""
    nodes = len(start.positions)
    for i in range(len(points)):
        for axis in range(3):
            motion.positions[i, axis] = points[i, axis]
            if i < nodes:
                motion.after[i, axis] = velocity[i, axis]
                motion.displacement[i, axis] = parameters.damping[0] * velocity[i, axis]
            else:
                motion.after[i, axis] = (points[i, axis] - start.points[i, axis]) / start.time_step


@kernel
def contact_force(touching: Touching, parameters: Parameters, motion: Motion, timing: Timing, force: Floats) -> None:
    """Add the contact forces to `force` [N, 3]."""
    _point_point(touching.point_point, parameters, motion, timing, force)
    _point_edge(touching.point_edge, parameters, motion, timing, force)
    _point_face(touching.point_face, parameters, motion, timing, force)
    _edge_edge(touching.edge_edge, parameters, motion, timing, force)
    _plane(touching.plane, parameters, motion, timing, force)


@kernel
def residual(
    scene: Scene,
    start: Start,
    parameters: Parameters,
    velocity: Floats,
    points: Floats,
    turned: Floats,
    touching: Touching,
    motion: Motion,
    found: Floats,
) -> None:
    """r [D, 3] [N·s, and N·m·s for rotations]; `motion` takes the motion."""
    dt, nodes = start.time_step, len(start.positions)
    set_motion(start, parameters, velocity, points, motion)
    timing, force = Timing(dt, 0.0), np.zeros((len(points), 3))
    _force(scene.terms, parameters, motion, timing, force)
    contact_force(touching, parameters, motion, timing, force)
    for i in range(nodes):
        h = start.holder[i]
        for axis in range(3):
            if h >= 0:
                wanted = (start.target[h, axis] - start.positions[i, axis]) / dt
                found[i, axis] = parameters.node_mass[i] * (velocity[i, axis] - wanted)
            else:
                change = velocity[i, axis] - start.velocities[i, axis]
                found[i, axis] = parameters.node_mass[i] * change - dt * force[i, axis]
    for b in range(len(start.bodies)):
        mass, row = parameters.body_mass[b], nodes + 2 * b
        for axis in range(3):
            change = velocity[row, axis] - start.bodies[b, 12 + axis] - dt * scene.gravity[axis]
            found[row, axis] = mass * change
            found[row + 1, axis] = mass * turned[b, 9 + axis]
    first = nodes + len(start.scenery)
    for p in range(len(scene.rigid.body)):
        b = scene.rigid.body[p]
        row, push = nodes + 2 * b, force[first + p]
        a0, a1, a2 = arm_of(scene, turned, p)
        for axis in range(3):
            found[row, axis] -= dt * push[axis]
        found[row + 1, 0] -= dt * (a1 * push[2] - a2 * push[1])
        found[row + 1, 1] -= dt * (a2 * push[0] - a0 * push[2])
        found[row + 1, 2] -= dt * (a0 * push[1] - a1 * push[0])


@kernel
def arm_of(scene: Scene, turned: Floats, p: int) -> tuple[float, float, float]:
    """From the centre of mass to a body's point, in the world's axes [m]; turned [B, 9 or more] starts with orientations."""
    own, t = scene.rigid.points[p], turned[scene.rigid.body[p]]
    return (
        t[0] * own[0] + t[1] * own[1] + t[2] * own[2],
        t[3] * own[0] + t[4] * own[1] + t[5] * own[2],
        t[6] * own[0] + t[7] * own[1] + t[8] * own[2],
    )


@kernel
def start_velocities(start: Start) -> Floats:
    """[D, 3]: of the cloth, then of each body and its rotation."""
    nodes, count = len(start.positions), len(start.bodies)
    found = np.empty((nodes + 2 * count, 3))
    for i in range(nodes):
        for axis in range(3):
            found[i, axis] = start.velocities[i, axis]
    for b in range(count):
        for axis in range(3):
            found[nodes + 2 * b, axis] = start.bodies[b, 12 + axis]
            found[nodes + 2 * b + 1, axis] = start.bodies[b, 15 + axis]
    return found


@kernel
def finish(start: Start, velocity: Floats, turned: Floats, positions: Floats, velocities: Floats, bodies: Floats) -> None:
    """Positions and velocities [V, 3] and bodies [B, 18] after the step; prescribed nodes are where they are wanted."""
    dt, nodes = start.time_step, len(start.positions)
    for i in range(nodes):
        h = start.holder[i]
        for axis in range(3):
            v = velocity[i, axis]
            if h >= 0:
                v = (start.target[h, axis] - start.positions[i, axis]) / dt
            velocities[i, axis] = v
            positions[i, axis] = start.positions[i, axis] + dt * v
    new = np.empty(BODY)
    for b in range(len(start.bodies)):
        for axis in range(3):
            new[12 + axis], new[15 + axis] = velocity[nodes + 2 * b, axis], velocity[nodes + 2 * b + 1, axis]
            new[axis] = start.bodies[b, axis] + dt * new[12 + axis]
        for k in range(9):
            new[3 + k] = turned[b, k]
        for k in range(BODY):
            bodies[b, k] = new[k]
