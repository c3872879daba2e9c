"""Rigid bodies and contact against closed-form answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
import trimesh

from diffcloud.mesh.shapes import cylinder_surface, grid_cloth
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.rigid.body import RigidBody
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from tests.sim.twins.rigid import angular_momenta

FABRIC = isotropic("test-fabric", density=0.2, stretching=200.0, shear=40.0, bending=1e-5, source="test")
GROUND = SurfaceMesh(np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))


def box(size, centre=(0.0, 0.0, 0.0)) -> SurfaceMesh:
    solid = trimesh.creation.box(size)
    return SurfaceMesh(np.array(solid.vertices) + centre, np.array(solid.faces))


def bystander(height: float = 5.0) -> tuple[ClothMesh, Handles]:
    """A small cloth, held far away: a scene has one."""
    cloth = grid_cloth(2, 2, 0.1, 0.1)
    cloth = ClothMesh(np.add(cloth.nodes, (0, 0, height)), cloth.verts, cloth.vert_node, cloth.face_verts)
    return cloth, Handles(tuple(Handle(node) for node in range(4)), hard=True)


def system_of(
    bodies, *, gravity, friction=0.3, obstacles=(GROUND,), time_step=0.01, contact=None, cloth=None, handles=None
):
    if cloth is None:
        cloth, handles = bystander()
    return build_system(
        cloth,
        FABRIC,
        time_step=time_step,
        handles=handles,
        integrator="implicit",
        surrounding=Surrounding(
            gravity=gravity,
            air_density=0.0,
            friction=friction,
            contact=contact or ContactSettings(1e6, 1e-3, 1e-4, sticking_speed=1e-4),
            obstacles=obstacles,
            bodies=tuple(bodies),
        ),
    )


def test_block_on_an_incline_sticks_or_slides():
    # an incline of angle a is level ground with gravity turned by a
    friction, g = 0.4, 9.81
    for angle in (math.atan(friction) - 0.03, math.atan(friction) + 0.03, math.radians(35)):
        gravity = (g * math.sin(angle), 0.0, -g * math.cos(angle))
        block = RigidBody(box((0.2, 0.2, 0.05), (0, 0, 0.0259)), density=500.0)
        run = rollout(system_of([block], gravity=gravity, friction=friction), 80)
        velocity = run.bodies.velocity[0, :, 0, 0]
        expected = g * (math.sin(angle) - friction * math.cos(angle))
        if expected < 0:
            assert abs(float(velocity[-1])) < 1e-4  # the sticking speed
        else:
            assert float(velocity[-1] - velocity[30]) / (50 * 0.01) == pytest.approx(expected, rel=0.02)


def test_a_stack_of_two_boxes_rests():
    lower = RigidBody(box((0.2, 0.2, 0.1), (0, 0, 0.0509)), density=300.0)
    upper = RigidBody(box((0.1, 0.1, 0.1), (0.01, 0.02, 0.1519)), density=600.0)
    run = rollout(system_of([lower, upper], gravity=(0, 0, -9.81)), 150)
    assert float(run.bodies.velocity[0, -1].abs().max()) < 1e-5
    assert float(run.bodies.angular_velocity[0, -1].abs().max()) < 1e-4
    height = run.bodies.centre[0, -1, :, 2]
    assert 0.05 < float(height[0]) < 0.051
    assert 0.1 < float(height[1] - height[0]) < 0.101


def test_a_spinning_body_keeps_its_angular_momentum():
    body = RigidBody(box((0.1, 0.2, 0.4), (0, 0, 1.0)), velocity=(0.3, 0, 0), angular_velocity=(3.0, 0.2, 5.0))
    system = system_of([body], gravity=(0, 0, 0), obstacles=())
    run = rollout(system, 200)
    momentum = angular_momenta(system.bodies, run.bodies.orientation[0], run.bodies.angular_velocity[0])[:, 0]
    assert float((momentum - momentum[0]).abs().max() / momentum[0].norm()) < 1e-9
    assert float((run.bodies.orientation[0, -1, 0] @ run.bodies.orientation[0, -1, 0].T - torch.eye(3)).abs().max()) < 1e-10


def momenta(system, run, step):
    """Linear and angular momentum of cloth and bodies together."""
    mass = system.properties.node_mass[0, :, None]
    dt = system.time_step
    position = run.positions[0, step]
    velocity = (run.positions[0, step + 1] - position) / dt
    centre, moving = run.bodies.centre[0, step], run.bodies.velocity[0, step + 1]
    body_mass = system.properties.body_mass[0][:, None]
    linear = (mass * velocity).sum(0) + (body_mass * moving).sum(0)
    spin = angular_momenta(system.bodies, run.bodies.orientation[0, step + 1], run.bodies.angular_velocity[0, step + 1])
    angular = (
        torch.linalg.cross(position, mass * velocity).sum(0)
        + torch.linalg.cross(centre, body_mass * moving).sum(0)
        + spin.sum(0)
    )
    return linear, angular


@pytest.mark.slow
def test_colliding_bodies_and_cloth_conserve_momentum():
    """Linear to rounding, angular to first order in the time step (2.9e-4 at 5e-4 s, 1.2e-4 at 2.5e-4 s)."""
    flat = grid_cloth(5, 5, 0.3, 0.3)
    cloth = ClothMesh(np.add(flat.nodes, (0.0, 0.0, 0.004)), flat.verts, flat.vert_node, flat.face_verts)
    turned = trimesh.transformations.rotation_matrix(0.5, [1, 0.3, 0.2])[:3, :3]
    first = box((0.1, 0.1, 0.1))
    first = SurfaceMesh(np.add(first.nodes @ turned.T, (0.03, 0.02, -0.1)), first.faces)
    second = SurfaceMesh(np.add(box((0.08, 0.1, 0.12)).nodes, (0.05, 0.03, 0.1)), first.faces)
    bodies = [
        RigidBody(first, mass=0.05, velocity=(0, 0, 0.6)),
        RigidBody(second, mass=0.03, velocity=(0, 0, -0.7), angular_velocity=(1.0, 0, 0)),
    ]
    system = system_of(
        bodies,
        gravity=(0, 0, 0),
        obstacles=(),
        friction=0.0,  # friction acts across the gap, which gives a small couple,
        time_step=1e-4,
        contact=ContactSettings(1e5, 4e-3, 1e-4),
        cloth=cloth,
        handles=Handles(()),
    )
    run = rollout(system, 1500)
    before, after = momenta(system, run, 0), momenta(system, run, len(run.times) - 3)
    assert float((run.positions[0, -1] - run.positions[0, 0]).norm(dim=-1).max()) > 0.01  # it was hit
    scale = 0.05 * 0.6
    assert float((after[0] - before[0]).abs().max()) / scale < 1e-8
    assert float((after[1] - before[1]).abs().max()) / (scale * 0.1) < 1e-4


@pytest.mark.slow
def test_a_box_on_a_cloth_held_at_its_corners_comes_to_rest():
    """The handles carry the weight of both."""
    size = 5
    flat = grid_cloth(size, size, 0.2, 0.2)
    cloth = ClothMesh(np.add(flat.nodes, (0, 0, 0.3)), flat.verts, flat.vert_node, flat.face_verts)
    corners = (0, size - 1, size * (size - 1), size * size - 1)
    handles = Handles(tuple(Handle(node) for node in corners), hard=False)
    body = RigidBody(box((0.08, 0.08, 0.04), (0.0, 0.0, 0.325)), mass=0.05)
    system = system_of(
        [body],
        gravity=(0, 0, -9.81),
        obstacles=(),
        time_step=0.02,
        contact=ContactSettings(1e5, 3e-3, 3e-4),
        cloth=cloth,
        handles=handles,
    )
    run = rollout(system, 400)
    assert float(run.bodies.velocity[0, -1].abs().max()) < 1e-3
    start = torch.as_tensor(cloth.nodes)[list(corners)]
    pull = system.handles.stiffness * (start - run.positions[0, -1, list(corners)])
    weight = 9.81 * (0.05 + float(system.properties.node_mass.sum()))
    assert float(pull[:, 2].sum()) == pytest.approx(weight, rel=0.01)


@pytest.mark.slow
def test_a_band_around_a_pole_holds_as_the_capstan_says():
    """A light band over half a pole, pulled at one end: at the point of slipping T2 / T1 = exp(mu phi)."""
    friction, radius, width, columns = 0.3, 0.05, 0.01, 33
    arc, straight = math.pi * radius, 0.1
    flat = grid_cloth(2, columns, width, arc + 2 * straight)
    along = flat.nodes[:, 0] + (arc / 2 + straight)
    lift = radius + 0.0018
    angle = np.clip((along - straight) / radius, 0, math.pi)
    x = -lift * np.cos(angle)
    z = lift * np.sin(angle) - np.clip(straight - along, 0, None) - np.clip(along - straight - arc, 0, None)
    band = ClothMesh(np.stack([x, flat.nodes[:, 1], z], 1), flat.verts, flat.vert_node, flat.face_verts)
    fabric = isotropic("band", density=0.05, stretching=2000.0, shear=250.0, bending=1e-7, source="test")
    ends = [0, columns], [columns - 1, 2 * columns - 1]
    pole = cylinder_surface([0, -0.05, 0], [0, 0.05, 0], radius, 96)
    # pulled on one side, the band slips towards it: tension falls from that side to the other
    pulled = Motion((Keyframe(0.0), Keyframe(2.0, (0.0, 0.0, -0.06))))
    handles = Handles((*(Handle(n) for n in ends[0]), *(Handle(n, pulled) for n in ends[1])), stiffness=400.0)
    system = build_system(
        band,
        fabric,
        time_step=0.02,
        handles=handles,
        integrator="implicit",
        surrounding=Surrounding(
            gravity=(0, 0, 0),
            air_density=0.0,
            friction=friction,
            contact=ContactSettings(1e7, 2e-3, 2e-4, sticking_speed=1e-4),
            obstacles=(pole,),
            self_contact=False,
        ),
    )
    run = rollout(system, 100)
    target = torch.as_tensor(band.nodes)
    last = run.positions[0, -1]
    loose = 400.0 * (last[ends[0], 2] - target[ends[0], 2]).sum()
    taut = 400.0 * (last[ends[1], 2] - (target[ends[1], 2] - 0.06)).sum()
    assert float(taut / loose) == pytest.approx(math.exp(friction * math.pi), rel=0.05)
