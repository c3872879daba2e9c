"""Broad phase, distances, barrier and collision-free steps of smooth contact, against brute force and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from diffcloud.sim.contact.additive_ccd import pair_distance, safe_fraction
from diffcloud.sim.contact.barrier import Barrier
from diffcloud.sim.contact.distance import edge_edge_weights, point_face_weights

from diffcloud.mesh import SurfaceMesh, box_surface, grid_cloth, rectangle_surface, sphere_surface
from diffcloud.sim.build import build_system
from diffcloud.sim.contact.broad_phase import Boxes, _all_pairs, _grid_pairs
from diffcloud.sim.contact.surface import ContactSurface
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.rigid.rotation import from_roll_pitch_yaw, left_jacobian, roll_pitch_yaw, rotation
from diffcloud.sim.scenery import MovingObstacle
from diffcloud.sim.simulate import init, rollout
from diffcloud.sim.surrounding import ContactSettings, Surrounding

FABRIC = isotropic("test", density=0.2, stretching=50.0, shear=20.0, bending=1e-5)


def boxes(rng, count: int, large: int | None = None) -> Boxes:
    low = torch.as_tensor(rng.random((3, count, 3)))
    high = low + 0.05 * torch.as_tensor(rng.random((3, count, 3)))
    if large is not None:
        high[:, large] += 2.0
    return Boxes(low, high)


def test_the_grid_finds_what_comparing_all_finds(rng):
    first, second = boxes(rng, 300), boxes(rng, 400, large=5)
    every = torch.ones(300, 400, dtype=torch.bool)
    for found, expected in zip(_grid_pairs(first, second), _all_pairs(first, second, every), strict=True):
        torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("weights", [point_face_weights, edge_edge_weights])
def test_no_sampled_place_is_closer_than_the_closest(rng, weights):
    corners = torch.as_tensor(rng.normal(size=(400, 4, 3)))
    found = weights(corners)
    distance = (found[:, None] @ corners).squeeze(1).norm(dim=-1)
    torch.testing.assert_close(found.sum(1), torch.zeros(400, dtype=torch.float64), atol=1e-12, rtol=0)
    if weights is point_face_weights:
        share = torch.as_tensor(rng.dirichlet(np.ones(3), size=(4000)))
        sampled = torch.cat([torch.ones(4000, 1, dtype=torch.float64), -share], 1)
    else:
        s, t = torch.as_tensor(rng.random((2, 4000)))
        sampled = torch.stack([1 - s, s, t - 1, -t], 1)
    brute = (sampled @ corners).norm(dim=-1).amin(1)
    assert (brute >= distance - 1e-12).all()
    assert (brute - distance).median() < 0.05


def test_the_barrier_is_smooth_and_its_force_is_its_slope():
    barrier = Barrier(1e4, 3e-3, 1e-3)
    distance = torch.linspace(1e-4, 3.5e-3, 60, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(barrier.energy(distance).sum(), distance)
    torch.testing.assert_close(slope, -barrier.pressure(distance).detach(), atol=1e-12, rtol=1e-12)
    (curvature,) = torch.autograd.grad(barrier.pressure(distance).sum(), distance)
    torch.testing.assert_close(curvature, -barrier.stiffness(distance).detach(), atol=1e-8, rtol=1e-12)
    near = torch.tensor([3e-3 * (1 - 1e-6)], dtype=torch.float64)
    assert barrier.pressure(near) < 1e-6  # it vanishes with its slope at the thickness
    assert barrier.stiffness(near) < 1.0


def test_a_flat_surface_gives_one_contact_however_it_is_cut():
    """Also over its diagonals and inner corners: the forces on a small cloth sliding over a tessellated table agree."""
    cloth = grid_cloth(2, 2, 0.01, 0.01)
    faces = grid_cloth(5, 5, 0.4, 0.4)
    table = SurfaceMesh(np.array(faces.nodes), np.array(faces.faces))
    block = box_surface([-0.2, -0.2, -0.3], [0.2, 0.2, -0.2])  # something not flat, so that the table is not alone
    forces = []
    for shift in np.linspace(-0.06, 0.06, 25):
        moved = type(cloth)(
            np.add(cloth.nodes, (shift, 0.3 * shift, 1.5e-3)), cloth.verts, cloth.vert_node, cloth.face_verts
        )
        bumpy = SurfaceMesh(np.concatenate([table.nodes, block.nodes]), np.concatenate([table.faces, block.faces + 25]))
        system = build_system(
            moved,
            FABRIC,
            time_step=0.01,
            handles=Handles(()),
            integrator="implicit",
            surrounding=Surrounding(obstacles=(bumpy,), contact=ContactSettings(1e4, 3e-3, 3e-4)),
        )
        contact = system.implicit.contact
        points = torch.cat([init(system).positions, torch.as_tensor(system.implicit.scenery.fixed)[None]], 1)
        near = contact.near((points,), 0.01, None)
        zero = torch.zeros(1, dtype=torch.float64)
        measured = contact.measure(near, points)
        assert all(pairs.kind == "point_face" for pairs in measured.touching)  # flat edges are left out
        forces.append(contact.forces(measured, points, points, zero, zero, 0.01)[0, :4])
    forces = torch.stack(forces)
    torch.testing.assert_close(forces, forces[:1].expand_as(forces), rtol=1e-9, atol=1e-12)
    assert (forces[..., 2] > 0).all()


@pytest.mark.parametrize("kind", ["point_face", "edge_edge"])
def test_what_a_safe_fraction_allows_never_touches(rng, kind):
    start = torch.as_tensor(rng.normal(size=(500, 4, 3)))
    end = start + torch.as_tensor(2 * rng.normal(size=(500, 4, 3)))
    entry = torch.arange(500)
    fraction = safe_fraction(kind, entry, start, end, pair_distance(kind, start), torch.ones(500, dtype=torch.float64))
    assert ((fraction > 0) & (fraction <= 1)).all()
    first = pair_distance(kind, start)
    for part in np.linspace(0, 1, 101):
        place = start + part * fraction[:, None, None] * (end - start)
        assert (pair_distance(kind, place) >= 0.0999 * first).all()
    assert (fraction == 1).float().mean() > 0.2
    assert (fraction < 1).float().mean() > 0.05


def test_nothing_comes_closer_than_the_floor_but_may_leave():
    triangle = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    start = torch.tensor([[[0.2, 0.2, 1.5e-9], *triangle]] * 2, dtype=torch.float64)
    end = start.clone()
    end[:, 0, 2] = torch.tensor([-0.1, 0.1])
    distance, one = pair_distance("point_face", start), torch.ones(2, dtype=torch.float64)
    fraction = safe_fraction("point_face", torch.arange(2), start, end, distance, one, 1e-9)
    assert pair_distance("point_face", start + fraction[:, None, None] * (end - start)).min() >= 1e-9
    assert fraction[0] < 1e-8
    assert fraction[1] == 1.0


def test_obstacle_edges_that_are_flat_are_left_out():
    cube = box_surface([0, 0, 0], [1, 1, 1])
    surface = ContactSurface.build(grid_cloth(2, 2, 1, 1), [cube])
    assert len(surface.edges) == 5 + 12  # the cube's edges, not its diagonals
    assert len(surface.points) == 4 + 8


def test_a_cloth_stays_on_a_ball_in_steps_as_long_as_its_thickness_takes():
    flat = grid_cloth(6, 6, 0.2, 0.2)
    cloth = type(flat)(np.add(flat.nodes, (0, 0, 0.12)), flat.verts, flat.vert_node, flat.face_verts)
    system = build_system(
        cloth,
        FABRIC,
        time_step=0.02,
        handles=Handles(()),
        integrator="implicit",
        surrounding=Surrounding(obstacles=(sphere_surface([0.003, 0.002, 0.0], 0.1, 2),)),
    )
    run = rollout(system, 20)
    radius = (run.positions[0] - torch.tensor([0.003, 0.002, 0.0], dtype=torch.float64)).norm(dim=-1)
    assert float(radius.min()) > 0.097  # the faces of the icosphere lie a little inside


def test_a_moving_obstacle_pushes_the_cloth():
    flat = grid_cloth(4, 4, 0.1, 0.1)
    plate = box_surface([-0.1, -0.1, -0.03], [0.1, 0.1, -0.01])
    system = build_system(
        flat,
        FABRIC,
        time_step=0.02,
        handles=Handles((Handle(0),)),
        integrator="implicit",
        surrounding=Surrounding(
            gravity=(0, 0, 0),
            moving=(MovingObstacle(plate, Motion((Keyframe(0.0), Keyframe(0.4, (0.0, 0.0, 0.05))))),),
        ),
    )
    run = rollout(system, 20)
    assert float(run.positions[0, -1, :, 2].min()) > 0.04  # the plate's top is there


def test_rotations(rng):
    vector = torch.as_tensor(rng.normal(size=(5, 3)))
    turned = rotation(vector)
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3, dtype=torch.float64).expand(5, 3, 3))
    small = 1e-6 * torch.as_tensor(rng.normal(size=(5, 3)))
    expected = rotation((left_jacobian(vector) @ small[..., None]).squeeze(-1)) @ turned
    torch.testing.assert_close(rotation(vector + small), expected, atol=1e-11, rtol=0)
    angles = torch.as_tensor(rng.uniform(-1.2, 1.2, size=(5, 3)))
    torch.testing.assert_close(roll_pitch_yaw(from_roll_pitch_yaw(angles)), angles)
    assert torch.autograd.gradcheck(rotation, torch.zeros(1, 3, dtype=torch.float64, requires_grad=True))


def test_a_table_alone_needs_no_mesh():
    system = build_system(
        grid_cloth(3, 3, 0.1, 0.1),
        FABRIC,
        time_step=0.01,
        handles=Handles(()),
        integrator="implicit",
        surrounding=Surrounding(obstacles=(rectangle_surface((0, 0), (1, 1), -0.01),)),
    )
    assert system.implicit.contact.planes is not None
    assert float(rollout(system, 20).positions[0, -1, :, 2].min()) > -0.01
