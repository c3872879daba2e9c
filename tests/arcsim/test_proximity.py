"""Repulsion and friction of mesh pairs against a slow twin, conservation laws, and the step matrix."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.arcsim.contact.nearest import Repulsion, held_slots, pairs_at
from diffcloud.arcsim.matrix import linear_system, pattern_with
from diffcloud.arcsim.terms import kernels
from diffcloud.mesh import ClothMesh, SurfaceMesh, grid_cloth
from diffcloud.mesh.topology import directed_edges
from diffcloud.sim.compiled.data import Motion, Parameters, Timing
from diffcloud.sim.contact.surface import Surface, contact_surface
from diffcloud.sim.surrounding import ReferenceContact
from tests.arcsim.twins import proximity as twin
from tests.arcsim.twins.meeting import meeting
from tests.sim.contact.scenes import box, crumpled, over_box, together

THICKNESS = 0.02
STIFFNESS = 1e5
DT = 0.02
MU_OBSTACLE, MU_CLOTH = 0.3, 0.6
KINDS = pytest.mark.parametrize("kind", [0, 1], ids=["point-face", "edge-edge"])
STATES = ("sliding", "sticking", "at rest", "beyond", "obstacle", "all fixed", "sliver", "twice", "no friction")


def repulsion(surface: Surface, points: np.ndarray, smallest: float = 0.0, count_once: bool = False) -> Repulsion:
    """Settings for points where obstacles are as they stay."""
    free = Repulsion(STIFFNESS, THICKNESS, smallest, count_once, np.zeros(0))
    return free._replace(held=held_slots(surface, free, points))


def parameters(inverse_mass: np.ndarray) -> Parameters:
    """Everything that pairs do not ask for is nothing."""
    nothing = dict.fromkeys(Parameters._fields, np.zeros(1)) | {"target": np.zeros((1, 3))}
    friction = {"friction": np.array([MU_OBSTACLE]), "self_friction": np.array([MU_CLOTH])}
    return Parameters(**(nothing | {"inverse_mass": inverse_mass} | friction))


def kernel(kind: int, way: str):
    return getattr(kernels, f"proximity_{('point_face', 'edge_edge')[kind]}_{way}")


def elements(kind: int, corners: np.ndarray, constants: np.ndarray, thickness: float = THICKNESS):
    """The pairs of one kind as `pairs_at` gives them."""
    own = corners[:, 0] == kind
    numbers = np.ascontiguousarray(constants[own].T)
    nodes, slots = np.ascontiguousarray(corners[own, 1:]), np.zeros((own.sum(), 10), np.int64)
    return (kernels.ProximityPointFace, kernels.ProximityEdgeEdge)[kind](
        nodes, slots, *numbers, np.full(own.sum(), thickness)
    )


def forces_of(corners: np.ndarray, constants: np.ndarray, motion: Motion, inverse_mass: np.ndarray) -> np.ndarray:
    """[N, 3] of all pairs together."""
    found = np.zeros_like(motion.positions)
    for kind in (0, 1):
        own = elements(kind, corners, constants)
        kernel(kind, "force")(own, parameters(inverse_mass), motion, Timing(DT, DT), found)
    return found


def moving(positions: np.ndarray, before: np.ndarray, after: np.ndarray) -> Motion:
    return Motion(positions, before, after, np.zeros_like(positions))


# --- one pair --------------------------------------------------------------------------------------------------------


def pairs(kind: int, state: str, rng: np.random.Generator, count: int = 20) -> Iterator[twin.Pair]:
    """Random pairs within the thickness."""
    for _ in range(count):
        x = 0.1 * rng.normal(size=(4, 3))
        if state == "sliver":  # two sides that are nearly parallel
            a, b = (x[1] - x[0], (2, 3)) if kind else (x[2] - x[1], (1, 3))
            x[b[1]] = x[b[0]] + 0.7 * a + 1e-3 * (x[b[1]] - x[b[0]])
        weights, normal = meeting(kind, x)
        sign = rng.choice([-1.0, 1.0])
        height = THICKNESS * (rng.uniform(1.01, 2.0) if state == "beyond" else rng.uniform(0.02, 0.98))
        first = slice(0, 2 if kind else 1)
        x[first] += (sign * height - normal @ (weights @ x)) * normal
        inverse_mass = 1 / rng.uniform(0.01, 0.02, size=4)
        if state == "obstacle":
            inverse_mass[(1, 2)[kind] :] = 0.0
        if state == "all fixed":
            inverse_mass[:] = 0.0
        before = {"sticking": 1e-5, "at rest": 0.0}.get(state, 1.0) * rng.normal(size=(4, 3))
        after = (state != "at rest") * rng.normal(size=(4, 3))
        friction = 0.0 if state == "no friction" else MU_OBSTACLE if state == "obstacle" else MU_CLOTH
        yield twin.Pair(
            kind,
            *(torch.as_tensor(value, dtype=torch.float64) for value in (x, before, after, inverse_mass, friction)),
            sign=sign,
            count=2.0 if state == "twice" else 1.0,
            stiffness=STIFFNESS * rng.uniform(1e-4, 1e-3),
            thickness=THICKNESS,
            time_step=DT,
        )


def given(pair: twin.Pair, state: str):
    """The same pair for kernels: (element, parameters, motion, timing)."""
    corners, with_obstacle = np.array([[pair.kind, 0, 1, 2, 3]]), float(state == "obstacle")
    constants = np.array([[pair.sign, pair.count, pair.stiffness, with_obstacle]])
    motion = moving(pair.positions.numpy(), pair.before.numpy(), pair.after.numpy())
    known = parameters(pair.inverse_mass.numpy())
    if state == "no friction":
        known = known._replace(self_friction=np.zeros(1))
    return elements(pair.kind, corners, constants, pair.thickness), known, motion, Timing(DT, DT)


def close(found: np.ndarray, expected: torch.Tensor, tolerance: float, at_least: float = 0.0) -> None:
    """To a tolerance relative to the largest entry, or to the size of terms that cancel."""
    scale = max(float(expected.abs().max()), at_least)
    np.testing.assert_allclose(found, expected.numpy(), rtol=tolerance, atol=tolerance * scale)


@KINDS
@pytest.mark.parametrize("state", STATES)
def test_force_and_step_matrix_of_a_pair(kind, state, rng):
    tolerance = 1e-9 if state == "sliver" else 1e-12  # the twin's linear systems are badly conditioned there
    for pair in pairs(kind, state, rng):
        element, known, motion, timing = given(pair, state)
        force, assembled, blocks = np.zeros((4, 3)), np.zeros((4, 3)), np.empty((1, 10, 9))
        kernel(kind, "force")(element, known, motion, timing, force)
        kernel(kind, "assemble")(element, known, motion, timing, 0.0, DT, assembled, blocks)
        close(force, pair.forces(), tolerance)
        np.testing.assert_array_equal(assembled, force)
        close(blocks.reshape(10, 3, 3), pair.step_matrix()[np.triu_indices(4)], tolerance)
        assert (np.abs(force).max() > 0) == (state != "beyond")


@KINDS
@pytest.mark.parametrize("state", STATES)
def test_derivatives_of_a_pair(kind, state, rng):
    """By everything that the force reads, in both modes, against automatic derivatives of the twin."""
    tolerance = 1e-6 if state == "sliver" else 1e-9
    friction = "friction" if state == "obstacle" else "self_friction"
    for pair in pairs(kind, state, rng, count=8):
        element, known, motion, timing = given(pair, state)
        names = ("positions", "before", "after", "inverse_mass", "friction")

        def forces(*values: torch.Tensor, pair: twin.Pair = pair, names=names) -> torch.Tensor:
            return replace(pair, **dict(zip(names, values, strict=True))).forces()

        inputs = tuple(getattr(pair, name) for name in names)
        jacobian = torch.autograd.functional.jacobian(forces, inputs)
        adjoint, rates = rng.normal(size=(4, 3)), [rng.normal(size=(2, *value.shape)) for value in inputs]

        slopes = Motion(*(np.zeros((4, 3)) for _ in range(4)))
        gradients = Parameters(*(np.zeros_like(value) for value in known))
        kernel(kind, "reverse")(element, known, motion, timing, adjoint, gradients, slopes)
        found = (slopes.positions, slopes.before, slopes.after, gradients.inverse_mass, getattr(gradients, friction)[0])
        size = float(forces(*inputs).abs().max())  # where a pair sticks its coefficient does not matter
        for name, value, part in zip(names, found, jacobian, strict=True):
            expected = torch.tensordot(torch.as_tensor(adjoint), part, 2)
            close(value, expected, tolerance, size if name == "friction" else 0.0)
        assert not slopes.displacement.any()

        changes = Motion(*rates[:3], np.zeros((2, 4, 3)))
        moves = Parameters(*(np.zeros((2, *value.shape)) for value in known))
        moves = moves._replace(inverse_mass=rates[3], **{friction: rates[4][:, None]})
        change = np.zeros((2, 4, 3))
        kernel(kind, "tangent")(element, known, motion, timing, moves, changes, change)
        expected = sum(
            torch.tensordot(part, torch.as_tensor(rate), [list(range(2, part.dim())), list(range(1, rate.ndim))])
            for part, rate in zip(jacobian, rates, strict=True)
        )
        close(change, expected.movedim(-1, 0), tolerance)


@KINDS
def test_repulsion_is_the_gradient_of_its_energy(kind, rng):
    """With frozen normals and weights: force = -dE/dx and matrix = Δt² d²E/dx², E = K c³/(6 τ)."""
    for pair in pairs(kind, "no friction", rng):
        weights, normal = (torch.as_tensor(part) for part in meeting(kind, pair.positions.numpy()))

        def energy(x: torch.Tensor, pair: twin.Pair = pair, weights=weights, normal=normal) -> torch.Tensor:
            violation = (THICKNESS - pair.sign * normal @ (weights @ x)).clamp(min=0)
            return pair.stiffness * violation**3 / (6 * THICKNESS)

        element, known, motion, timing = given(replace(pair, after=0 * pair.after), "no friction")
        force, blocks = np.zeros((4, 3)), np.empty((1, 10, 9))
        kernel(kind, "assemble")(element, known, motion, timing, 0.0, DT, force, blocks)
        close(force, -torch.autograd.functional.jacobian(energy, pair.positions), 1e-11)
        hessian = torch.autograd.functional.hessian(energy, pair.positions).permute(0, 2, 1, 3)
        close(blocks.reshape(10, 3, 3), DT**2 * hessian[np.triu_indices(4)], 1e-11)


@KINDS
@pytest.mark.parametrize("state", ["sliding", "sticking", "obstacle"])
def test_friction_is_coulombs_and_never_reverses(kind, state, rng):
    """At most μ times the normal force, and at most what stops the sliding within the step; one of both exactly."""
    limited = 0
    for pair in pairs(kind, state, rng):
        pair = replace(pair, after=pair.before)
        element, known, motion, timing = given(pair, state)
        with_friction, without = np.zeros((4, 3)), np.zeros((4, 3))
        kernel(kind, "force")(element, known, motion, timing, with_friction)
        frictionless = known._replace(friction=np.zeros(1), self_friction=np.zeros(1))
        kernel(kind, "force")(element, frictionless, motion, timing, without)
        weights, normal = meeting(kind, pair.positions.numpy())
        height = pair.sign * normal @ (weights @ pair.positions.numpy())
        normal_force = pair.stiffness * (THICKNESS - height) ** 2 / (2 * THICKNESS)
        velocity = weights @ pair.before.numpy()
        sliding = velocity - (normal @ velocity) * normal
        friction = (with_friction - without)[0] / weights[0]
        assert friction @ sliding < 0
        np.testing.assert_allclose(np.cross(friction, sliding), 0.0, atol=1e-9 * np.abs(friction).max())
        share = np.linalg.norm(friction) / ((MU_OBSTACLE if state == "obstacle" else MU_CLOTH) * normal_force)
        mobility = (weights**2 * pair.inverse_mass.numpy()).sum()
        stopped = np.linalg.norm(friction) * DT * mobility / np.linalg.norm(sliding)
        assert max(share, stopped) <= 1 + 1e-9
        assert max(share, stopped) == pytest.approx(1.0, abs=1e-6)  # but for a tiny speed that keeps it finite
        limited += share > stopped
    assert limited == 0 if state == "sticking" else limited > 10


def test_a_pair_at_the_thickness_exactly_has_no_force():
    """In numbers without rounding; neither has it a derivative."""
    x = np.array([[0.25, 0.25, 0.125], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    corners, constants = np.array([[0, 0, 1, 2, 3]]), np.array([[1.0, 1.0, 100.0, 0.0]])
    element, known = elements(0, corners, constants, 0.125), parameters(np.ones(4))
    motion, timing = moving(x, np.ones((4, 3)), np.ones((4, 3))), Timing(DT, DT)
    force, blocks, slopes = np.zeros((4, 3)), np.empty((1, 10, 9)), Motion(*(np.zeros((4, 3)) for _ in range(4)))
    kernel(0, "assemble")(element, known, motion, timing, 0.0, DT, force, blocks)
    gradients = Parameters(*(np.zeros_like(value) for value in known))
    kernel(0, "reverse")(element, known, motion, timing, np.ones((4, 3)), gradients, slopes)
    assert not force.any()
    assert not blocks.any()
    assert np.isfinite(slopes.positions).all()
    assert not slopes.after.any()


# --- which pairs -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("smallest", [1e-6, 1e-4])
def test_pairs_and_counts_are_those_of_the_slow_twin(rng, smallest):
    doubled = edges = mixed = 0
    for _ in range(12):
        surface, points = crumpled(rng)
        settings = repulsion(surface, points, smallest)
        corners, constants = pairs_at(surface, settings, points)
        expected = twin.nearest_pairs(surface, points, THICKNESS, smallest)
        told = {tuple(pair): numbers for pair, numbers in zip(corners.tolist(), constants, strict=True)}
        assert len(told) == len(corners), "each pair once"
        assert told.keys() == expected.keys()
        for pair, (sign, count, stiffness, with_obstacle) in told.items():
            slots, height = expected[pair]
            assert (sign, count) == (np.sign(height), slots)
            assert with_obstacle == (max(pair[1:]) >= surface.cloth_points)
            assert stiffness == pytest.approx(STIFFNESS * smaller_area(surface, *pair), rel=1e-14)
        once, numbers = pairs_at(surface, settings._replace(count_once=True), points)
        np.testing.assert_array_equal(once, corners)
        assert (numbers[:, 1] == 1).all()
        doubled += (constants[:, 1] == 2).sum()
        edges += corners[:, 0].sum()
        mixed += constants[:, 3].sum()
        total = len(corners)
    assert doubled > 10
    assert edges > 5
    assert mixed > 0
    assert constants[:, 3].sum() < total


def smaller_area(surface: Surface, kind: int, *points: int) -> float:
    if kind:
        first, second = ((surface.edges == ends).all(axis=1).argmax() for ends in (points[:2], points[2:]))
        return min(surface.edge_area[first], surface.edge_area[second])
    point = (surface.points == points[0]).argmax()
    return min(surface.point_area[point], surface.face_area[(surface.faces == points[1:]).all(axis=1).argmax()])


def test_of_equally_near_pairs_the_first_has_the_slot():
    """Layers of a lattice in numbers without rounding, where every distance occurs many times."""
    mesh = grid_cloth(3, 3, 0.5, 0.5)
    shift = np.array([0.0625, 0.03125, 0.015625])
    whole = together(*(replace(mesh, nodes=mesh.nodes + layer * shift) for layer in range(3)))
    surface = contact_surface(whole, [])
    corners, constants = pairs_at(surface, repulsion(surface, whole.nodes), whole.nodes)
    expected = twin.nearest_pairs(surface, whole.nodes, THICKNESS)
    assert len(expected) > 20
    found = zip(corners.tolist(), constants, strict=True)
    assert {tuple(pair): (count, sign) for pair, (sign, count, *_) in found} == {
        pair: (count, np.sign(height)) for pair, (count, height) in expected.items()
    }


def test_obstacles_hold_slots_against_the_cloth():
    """A node of one box near a face of another keeps a cloth node that is farther away out of the face's slot."""
    cloth = grid_cloth(2, 2, 0.05, 0.05)
    floor = SurfaceMesh(np.array([[-1, -1, -0.015], [1, -1, -0.015], [0, 2, -0.015]]), np.array([[0, 1, 2]]))
    counts = []
    for bottom in (-0.005, 0.5):
        obstacles = [box((0.3, 0.3, bottom), (0.32, 0.32, 1.0)), floor]
        surface = contact_surface(cloth, obstacles, all_edges=True)
        points = np.concatenate([cloth.nodes, *(mesh.nodes for mesh in obstacles)])
        points[0, 2] -= 0.001
        _, constants = pairs_at(surface, repulsion(surface, points), points)
        counts.append(sorted(constants[:, 1].tolist()))
    assert counts == [[1, 1, 1, 1], [1, 1, 1, 2]]


def test_parallel_edges_do_not_repel():
    """Edges at an angle below a millionth have a common normal that means nothing, and derivatives without bound."""
    below = np.array([[-0.1, 0, 0], [0.1, 0, 0], [0, 0, -0.1]])  # two triangles that stand on each other's edges
    flat = np.array([[0.0, 0], [0.2, 0], [0.1, 0.1], [1.0, 0], [1.2, 0], [1.1, 0.1]])
    for turn, repels in ((0.0, False), (1e-9, False), (1e-3, True)):
        above = np.array([[-0.1, -0.1 * turn, 0.01], [0.1, 0.1 * turn, 0.01], [0, 0, 0.11]])
        points = np.concatenate([below, above])
        surface = contact_surface(ClothMesh(points, flat, np.arange(6), np.array([[0, 1, 2], [3, 4, 5]])), [])
        corners, _ = pairs_at(surface, repulsion(surface, points), points)
        assert ([1, 0, 1, 3, 4] in corners.tolist()) == repels


def test_nothing_near_is_none():
    surface, points = crumpled(np.random.default_rng(0))
    settings = repulsion(surface, points)
    points[:25, 2] = 1.0 + 0.1 * np.arange(25)
    corners, constants = pairs_at(surface, settings._replace(thickness=1e-6), points)
    assert corners.shape == (0, 5)
    assert constants.shape == (0, 4)


def test_directed_edges_of_an_obstacle():
    edges, sides = directed_edges(box((0, 0, 0), (1, 1, 1)).faces)
    assert len(edges) == 18
    assert (sides >= 0).all()


# --- all pairs of a scene --------------------------------------------------------------------------------------------


def test_cloth_on_cloth_conserves_momentum(rng):
    """Self-contact alone: forces sum to zero, and repulsion has no moment."""
    surface, points = crumpled(rng)
    corners, constants = pairs_at(surface, repulsion(surface, points), points)
    own = constants[:, 3] == 0
    corners, constants = corners[own], constants[own]
    inverse_mass = np.concatenate([1 / rng.uniform(0.01, 0.02, 25), np.zeros(len(points) - 25)])
    velocities = rng.normal(size=points.shape)
    rest = moving(points, velocities, np.zeros_like(points))
    repelled = forces_of(corners, constants, rest, inverse_mass)
    # what the velocity at the end adds: less repulsion, and friction
    slowed = forces_of(corners, constants, rest._replace(after=velocities), inverse_mass) - repelled
    assert np.abs(repelled).max() > 1e-3
    assert np.abs(slowed).max() > 1e-3
    for force in (repelled, slowed):
        assert np.abs(force.sum(axis=0)).max() < 1e-12 * np.abs(force).sum()
    assert np.abs(np.cross(points, repelled).sum(axis=0)).max() < 1e-12 * np.abs(repelled).sum()


def dense(pattern, matrix: np.ndarray) -> np.ndarray:
    """[V, V, 3, 3] of the half that is stored, nodes in their own order."""
    count = len(pattern.place)
    found = np.zeros((count, count, 3, 3))
    for column in range(count):
        for p in range(pattern.starts[column], pattern.starts[column + 1]):
            block = matrix[p].reshape(3, 3)
            found[column, pattern.rows[p]] = block.T
            found[pattern.rows[p], column] = block
    return found[np.ix_(pattern.place, pattern.place)]


def test_pairs_add_the_twins_to_the_step_matrix(rng):
    """Also where they join nodes that share no element, and on nodes of obstacles, which have no row."""
    system, _ = over_box(ReferenceContact.as_published()).scene.build()
    scene, nodes = system.scene, len(system.mesh.nodes)
    points = np.concatenate([system.mesh.nodes, scene.obstacles])
    points[:nodes] += rng.normal(size=(nodes, 3)) * [0.03, 0.03, 0.01]
    velocities = np.concatenate([rng.normal(size=(nodes, 3)), np.zeros_like(scene.obstacles)])
    mass = rng.uniform(0.001, 0.002, nodes)
    known = parameters(np.concatenate([1 / mass, np.zeros(len(scene.obstacles))]))
    faces, hinges, handles = len(system.mesh.faces), len(system.mesh.hinges.length), len(system.handles.nodes)
    known = known._replace(node_mass=mass, weight=mass, stretching=np.ones(faces), bending=np.ones(hinges))
    known = known._replace(hold=np.zeros(handles), target=np.zeros((handles, 3)))
    motion, holder = moving(points, velocities, velocities.copy()), np.full(nodes, -1)
    surface, settings = scene.surface, scene.repulsion._replace(smallest=0.0, thickness=THICKNESS)
    scene = scene._replace(repulsion=settings)
    corners, constants = pairs_at(surface, settings, points)
    assert (constants[:, 3] == 0).any()
    assert (constants[:, 3] == 1).any()

    matrices, forces = [], []
    for chosen in (slice(0), slice(None)):
        own, numbers, force = corners[chosen], constants[chosen], np.zeros_like(points)
        pattern, moved = pattern_with(scene.pattern, own)
        matrix = linear_system(scene, known, motion, holder, own, numbers, pattern, moved, force)
        matrices.append(dense(pattern, matrix))
        forces.append(force)
    expected, pushes = np.zeros((nodes, nodes, 3, 3)), np.zeros_like(points)
    for (kind, *corner), numbers in zip(corners.tolist(), constants.tolist(), strict=True):
        sign, count, stiffness, with_obstacle = numbers
        tensors = (points[corner], velocities[corner], velocities[corner], known.inverse_mass[corner])
        friction = torch.tensor(MU_OBSTACLE if with_obstacle else MU_CLOTH, dtype=torch.float64)
        numbers = (sign, count, stiffness, THICKNESS, scene.time_step)
        pair = twin.Pair(kind, *(torch.as_tensor(value) for value in tensors), friction, *numbers)
        pushes[corner] += pair.forces().numpy()
        blocks = pair.step_matrix().numpy()
        for a, i in enumerate(corner):
            for b, j in enumerate(corner):
                if max(i, j) < nodes:
                    expected[i, j] += blocks[a, b]
    scale = np.abs(matrices[1]).max()
    np.testing.assert_allclose(matrices[1] - matrices[0], expected, atol=1e-12 * scale)
    np.testing.assert_allclose(forces[1] - forces[0], pushes, atol=1e-12 * np.abs(forces[1]).max())
    assert np.abs(expected).max() > 1e-3 * scale
    coupled = np.abs(matrices[0]).max(axis=(2, 3)) > 0
    assert (np.abs(expected).max(axis=(2, 3)) > 0)[~coupled].any()  # the pattern had to grow
