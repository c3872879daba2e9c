"""Distances, barrier, places and collision-free steps of smooth contact, against plain twins and closed forms."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.mesh import SurfaceMesh, box_surface, grid_cloth, rectangle_surface, sphere_surface
from diffcloud.sim import rollout
from diffcloud.sim.build import build_system
from diffcloud.sim.compiled.data import Motion as Moving
from diffcloud.sim.compiled.data import Parameters, Timing
from diffcloud.sim.contact.additive_ccd import safe_fraction
from diffcloud.sim.contact.distance import closest
from diffcloud.sim.contact.surface import contact_surface
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.implicit.terms import kernels
from diffcloud.sim.materials import isotropic
from diffcloud.sim.motion import Keyframe, Motion
from diffcloud.sim.scenery import MovingObstacle
from diffcloud.sim.simulate import init
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from diffcloud.sim.system import System
from tests.sim.twins import barrier
from tests.sim.twins.rigid import angular_momentum, rotation

FABRIC = isotropic("test", density=0.2, stretching=50.0, shear=10.0, bending=1e-5)
GRAVITY = (0.0, 0.0, -9.81)
SCALE, THICKNESS, STICKING = 1e4, 3e-3, 1e-3
WEIGHTS = {0: barrier.point_face_weights, 1: barrier.edge_edge_weights}


def distance_of(kind: int, corners: np.ndarray) -> float:
    return closest(kind, corners, np.empty(6))


@pytest.mark.parametrize("kind", [0, 1])
def test_no_sampled_place_is_closer_than_the_closest(rng, kind):
    if kind == 0:
        share = rng.dirichlet(np.ones(3), size=4000)
        sampled = np.concatenate([np.ones((4000, 1)), -share], 1)
    else:
        s, t = rng.random((2, 4000))
        sampled = np.stack([1 - s, s, t - 1, -t], 1)
    left = []
    for corners in rng.normal(size=(400, 4, 3)):
        found = np.empty(6)
        distance = closest(kind, corners, found)
        assert found[:4].sum() == pytest.approx(0, abs=1e-12)
        np.testing.assert_allclose(found[:4], WEIGHTS[kind](torch.as_tensor(corners)).numpy(), atol=1e-9)
        brute = np.linalg.norm(sampled @ corners, axis=-1).min()
        assert brute >= distance - 1e-12
        left.append(brute - distance)
    assert np.median(left) < 0.05


def plane_force(distance: float, velocity: np.ndarray, friction: float) -> np.ndarray:
    """[3] on a point over the plane z >= 0, of unit area."""
    one, nothing = np.ones(1), np.zeros((1, 3))
    term = kernels.BarrierPlane(
        np.zeros((1, 1), np.int64),
        np.zeros((1, 1), np.int64),
        one,
        np.array([[0.0, 0.0, 1.0]]),
        np.zeros(1),
        np.array([[SCALE, THICKNESS, STICKING]]),
    )
    fields = dict.fromkeys(Parameters._fields, one) | {"friction": np.array([friction]), "target": nothing}
    motion = Moving(np.array([[0.0, 0.0, distance]]), velocity[None], velocity[None], nothing)
    force = np.zeros((1, 3))
    kernels.barrier_plane_force(term, Parameters(**fields), motion, Timing(0.01, 0.0), force)
    return force[0]


def test_the_barrier_is_smooth_and_its_force_is_its_slope():
    still = np.zeros(3)
    for distance in np.linspace(1e-4, 3.5e-3, 60):
        d = torch.tensor(distance, dtype=torch.float64, requires_grad=True)
        (slope,) = torch.autograd.grad(barrier.energy(d, SCALE, THICKNESS), d)
        assert plane_force(distance, still, 0.5).tolist() == pytest.approx([0, 0, -float(slope)], rel=1e-10, abs=1e-10)
    near = THICKNESS * (1 - 1e-6)
    assert plane_force(near, still, 0.5)[2] < 1e-6  # it vanishes with its slope at the thickness
    assert (plane_force(near, still, 0.5)[2] - plane_force(THICKNESS, still, 0.5)[2]) / (near - THICKNESS) < 1.0


def test_friction_is_coulombs_beyond_the_sticking_speed_and_smooth_below():
    normal = plane_force(1e-3, np.zeros(3), 0.5)[2]
    quick = plane_force(1e-3, np.array([0.3, -0.4, 0.1]), 0.5)
    assert quick.tolist() == pytest.approx([-0.5 * normal * 0.6, 0.5 * normal * 0.8, normal])
    half = plane_force(1e-3, np.array([0.5 * STICKING, 0.0, 0.0]), 0.5)
    assert half[0] == pytest.approx(-0.5 * normal * 0.75)


def contact_forces(system: System, friction: float = 0.0, velocities: torch.Tensor | None = None) -> np.ndarray:
    """[V, 3] on the cloth where it stands: from the change of momentum in a step so short that nothing moves."""
    zero = torch.zeros_like
    given = system.properties
    properties = replace(
        given,
        stretching=1e-12 * given.stretching,
        bending=1e-12 * given.bending,
        damping=zero(given.damping),
        air_density=zero(given.air_density),
        air_drag=zero(given.air_drag),
        friction=friction + zero(given.friction),
        self_friction=friction + zero(given.self_friction),
    )
    run = rollout(system, 1, properties=properties, state=init(system, velocities=velocities))
    change = run.velocities[0, 1] - run.velocities[0, 0]
    weight = torch.tensor(GRAVITY, dtype=torch.float64)
    return (given.node_mass[0, :, None] * (change / system.time_step - weight)).numpy()


def short_system(mesh, obstacles=(), **contact) -> System:
    return build_system(
        mesh,
        FABRIC,
        time_step=1e-9,
        handles=Handles(()),
        integrator="implicit",
        surrounding=Surrounding(
            gravity=GRAVITY, obstacles=obstacles, contact=ContactSettings(SCALE, THICKNESS, 3e-4, **contact)
        ),
    )


def test_a_flat_surface_gives_one_contact_however_it_is_cut():
    """Also over its diagonals and inner corners: the forces on a small cloth sliding over a tessellated table agree."""
    cloth = grid_cloth(2, 2, 0.01, 0.01)
    faces = grid_cloth(5, 5, 0.4, 0.4)
    block = box_surface([-0.2, -0.2, -0.3], [0.2, 0.2, -0.2])  # something not flat, so that the table is not alone
    bumpy = SurfaceMesh(
        np.concatenate([np.array(faces.nodes), block.nodes]), np.concatenate([np.array(faces.faces), block.faces + 25])
    )
    forces = []
    for shift in np.linspace(-0.06, 0.06, 25):
        moved = type(cloth)(
            np.add(cloth.nodes, (shift, 0.3 * shift, 1.5e-3)), cloth.verts, cloth.vert_node, cloth.face_verts
        )
        forces.append(contact_forces(short_system(moved, (bumpy,))))
    np.testing.assert_allclose(forces, np.broadcast_to(forces[0], np.shape(forces)), rtol=1e-6, atol=1e-9)
    assert (np.array(forces)[..., 2] > 0).all()


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_forces_are_the_sum_over_all_pairs_and_their_places(friction, rng):
    """A crumpled patch close over another one: faces, inner edges and corners, crossing edges."""
    flat = grid_cloth(3, 3, 0.02, 0.02)
    lower, upper = np.array(flat.nodes), np.add(flat.nodes, (0.003, 0.002, 0.0016))
    nodes = np.concatenate([lower, upper]) + 3e-4 * rng.normal(size=(18, 3))
    cloth = type(flat)(
        nodes,
        np.concatenate([flat.verts, flat.verts]),
        np.concatenate([flat.vert_node, flat.vert_node + 9]),
        np.concatenate([flat.face_verts, flat.face_verts + len(flat.verts)]),
    )
    velocities = 3e-3 * rng.normal(size=(18, 3))
    surface = contact_surface(cloth, ())
    law = torch.tensor([SCALE, THICKNESS, STICKING], dtype=torch.float64)
    mu = torch.tensor(friction, dtype=torch.float64)
    x, v = torch.as_tensor(nodes), torch.as_tensor(velocities)
    expected = torch.zeros(18, 3, dtype=torch.float64)
    for point, face in itertools.product(range(18), range(len(surface.faces))):
        corners = [point, *surface.faces[face].tolist()]
        if point not in corners[1:]:
            area = min(surface.point_area[point], surface.typical_face_area[0])
            shares = torch.as_tensor(surface.edge_share[face]), torch.as_tensor(surface.corner_share[face])
            expected[corners] += barrier.point_face_force(x[corners], v[corners], area, *shares, law, mu)
    for first, second in itertools.combinations(range(len(surface.edges)), 2):
        corners = [*surface.edges[first].tolist(), *surface.edges[second].tolist()]
        if len(set(corners)) == 4:
            area = min(surface.edge_area[first], surface.edge_area[second])
            expected[corners] += barrier.edge_edge_force(x[corners], v[corners], area, law, mu)
    found = contact_forces(short_system(cloth), friction, velocities=v[None])
    assert float(expected.abs().max()) > 1e-5
    np.testing.assert_allclose(found, expected.numpy(), rtol=0, atol=1e-5 * float(expected.abs().max()))


@pytest.mark.parametrize("kind", [0, 1])
def test_what_a_safe_fraction_allows_never_touches(rng, kind):
    whole = 0
    for start in rng.normal(size=(500, 4, 3)):
        end = start + 2 * rng.normal(size=(4, 3))
        first = distance_of(kind, start)
        fraction = safe_fraction(np.array([[kind, 0, 1, 2, 3]]), np.array([first]), start, end, 1.0, 0.0)
        assert 0 < fraction <= 1
        for part in np.linspace(0, 1, 101):
            assert distance_of(kind, start + part * fraction * (end - start)) >= 0.0999 * first
        whole += fraction == 1
    assert 0.2 < whole / 500 < 0.95


def test_nothing_comes_closer_than_the_floor_but_may_leave():
    start = np.array([[0.2, 0.2, 1.5e-9], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    for height, least, most in ((-0.1, 0.0, 1e-8), (0.1, 1.0, 1.0)):
        end = start.copy()
        end[0, 2] = height
        fraction = safe_fraction(np.array([[0, 0, 1, 2, 3]]), np.array([distance_of(0, start)]), start, end, 1.0, 1e-9)
        assert distance_of(0, start + fraction * (end - start)) >= 1e-9
        assert least <= fraction <= most


def test_obstacle_edges_that_are_flat_are_left_out():
    cube = box_surface([0, 0, 0], [1, 1, 1])
    surface = contact_surface(grid_cloth(2, 2, 1, 1), [cube])
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


def test_a_body_turns_by_the_exponential_map_and_gains_what_its_momentum_does(rng):
    """`spin`: R₁ = exp(Δt ω₁) R₀ and ΔL per mass, with its derivatives in both modes."""
    inputs, constants = rng.normal(size=15), np.concatenate([[0.03], rng.normal(size=9)])
    constants[1:] = (constants[1:].reshape(3, 3) @ constants[1:].reshape(3, 3).T).ravel()
    inputs[:9] = rotation(torch.as_tensor(rng.normal(size=3))).numpy().ravel()

    def twin(given: torch.Tensor) -> torch.Tensor:
        before, old, new = given[:9].view(3, 3), given[9:12], given[12:]
        after, gyration = rotation(constants[0] * new) @ before, torch.as_tensor(constants[1:]).view(3, 3)
        gained = angular_momentum(gyration, after, new) - angular_momentum(gyration, before, old)
        return torch.cat([after.flatten(), gained])

    for turning in (inputs[12:], np.zeros(3), 1e-9 * inputs[12:]):
        at = np.concatenate([inputs[:12], turning])
        outputs, rates, along = np.zeros(12), rng.normal(size=(2, 15)), np.zeros((2, 12))
        kernels.spin_value(at, constants, outputs)
        np.testing.assert_allclose(outputs, twin(torch.as_tensor(at)).numpy(), atol=1e-13)
        jacobian = torch.autograd.functional.jacobian(twin, torch.as_tensor(at)).numpy()
        kernels.spin_tangent(at, constants, rates, along)
        np.testing.assert_allclose(along, rates @ jacobian.T, atol=1e-10)
        adjoint, gradients = rng.normal(size=12), np.zeros(15)
        kernels.spin_reverse(at, constants, adjoint, gradients)
        np.testing.assert_allclose(gradients, adjoint @ jacobian, atol=1e-10)


def test_a_table_alone_needs_no_mesh():
    system = build_system(
        grid_cloth(3, 3, 0.1, 0.1),
        FABRIC,
        time_step=0.01,
        handles=Handles(()),
        integrator="implicit",
        surrounding=Surrounding(obstacles=(rectangle_surface((0, 0), (1, 1), -0.01),)),
    )
    assert not len(system.scene.surface.owner[9:])
    assert float(rollout(system, 20).positions[0, -1, :, 2].min()) > -0.01
