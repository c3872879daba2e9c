"""Repulsion and friction of mesh pairs against a slow twin in numpy, conservation laws, and the step matrix."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from diffcloud.mesh import SurfaceMesh, grid_cloth
from diffcloud.mesh.topology import directed_edges
from diffcloud.sim.contact.pairs import candidates
from diffcloud.sim.contact.proximity import ProximitySettings, Slots, find_proximity
from diffcloud.sim.contact.surface import ContactSurface
from tests.sim.contact.scenes import box

THICKNESS = 0.02
ALL_PAIRS = "diffcloud.sim.contact.broad_phase._ALL_PAIRS"
STIFFNESS = 1e5
DT = 0.02
MU = (0.3, 0.6)


def crumpled(rng: np.random.Generator, batch: int) -> tuple[ContactSurface, torch.Tensor]:
    """A crumpled cloth partly in the shell of two boxes that nearly touch."""
    cloth = grid_cloth(5, 5, 0.3, 0.3)
    obstacles = [box((-0.1, -0.1, -0.2), (0.08, 0.11, 0.0)), box((-0.4, -0.4, -0.6), (0.4, 0.4, -0.211))]
    surface = ContactSurface.build(cloth, obstacles, all_edges=True)
    rest = np.concatenate([cloth.nodes, *(mesh.nodes for mesh in obstacles)])
    points = np.repeat(rest[None], batch, axis=0)
    points[:, :25] += rng.normal(size=(batch, 25, 3)) * [0.05, 0.05, 0.02]
    return surface, torch.as_tensor(points)


@pytest.mark.parametrize("most", [0, 10**9], ids=["grid", "all pairs"])
@pytest.mark.parametrize("among_fixed", [False, True])
@pytest.mark.parametrize("touches_itself", [False, True])
@pytest.mark.parametrize("movable", [(False, False), (True, False)])
def test_candidates_are_all_pairs_that_may_touch_once(rng, monkeypatch, most, among_fixed, touches_itself, movable):
    monkeypatch.setattr(ALL_PAIRS, most)
    surface, points = crumpled(rng, 2)
    surface = replace(surface, movable=torch.tensor([True, *movable]), touches_itself=touches_itself)
    start, end = points, points + 0.02 * torch.as_tensor(rng.normal(size=points.shape))
    owner, moves = surface.owner.tolist(), surface.movable.tolist()

    def may_touch(one: list[int], other: list[int]) -> bool:
        a, b = owner[one[0]], owner[other[0]]
        apart = not set(one) & set(other)
        return apart and (a != b or (a == 0 and touches_itself)) and (moves[a] or moves[b] or among_fixed)

    def boxes_meet(entry: int, one: list[int], other: list[int]) -> bool:
        a, b = (torch.cat([start[entry, corners], end[entry, corners]]) for corners in (one, other))
        return bool((a.amin(0) - THICKNESS / 2 <= b.amax(0) + THICKNESS / 2).all()) and bool(
            (b.amin(0) - THICKNESS / 2 <= a.amax(0) + THICKNESS / 2).all()
        )

    single = [[point] for point in surface.points.tolist()]
    faces, edges = surface.faces.tolist(), surface.edges.tolist()
    wanted = {
        "point_face": itertools.product(enumerate(single), enumerate(faces)),
        "edge_edge": itertools.combinations(enumerate(edges), 2),
    }
    for found in candidates(surface, (start, end), THICKNESS, among_fixed=among_fixed):
        primitives = found.primitives if found.kind == "point_face" else found.primitives.sort(dim=1).values
        told = [tuple(row) for row in torch.cat([found.entry[:, None], primitives], dim=1).tolist()]
        expected = {
            (entry, i, j)
            for (i, one), (j, other) in wanted[found.kind]
            if may_touch(one, other)
            for entry in range(2)
            if boxes_meet(entry, one, other)
        }
        assert len(told) == len(set(told)), "each pair once"
        assert set(told) == expected


def twin(surface: ContactSurface, points: np.ndarray, smallest: float) -> dict[tuple[int, ...], int]:
    """points of a pair -> how many slots it holds, by loops over everything."""
    faces, edges = surface.faces.numpy(), surface.edges.numpy()
    owner, cloth = surface.owner.numpy(), surface.cloth_points
    corner = points[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    node_normal = np.zeros_like(points)
    for face in faces:
        for k in range(3):
            e1, e2 = points[face[(k + 1) % 3]] - points[face[k]], points[face[(k + 2) % 3]] - points[face[k]]
            node_normal[face[k]] += np.cross(e1, e2) / (e1 @ e1 * (e2 @ e2))
    node_normal /= np.linalg.norm(node_normal, axis=1, keepdims=True)
    slots: dict[tuple, tuple[float, tuple[int, ...]]] = {}

    def offer(primitive: tuple, side: bool, height: float, pair: tuple[int, ...]) -> None:
        key = (*primitive, bool(side))
        if key not in slots or abs(height) < slots[key][0]:
            slots[key] = (abs(height), pair)

    def meets(a: int, b: int) -> bool:  # not within one obstacle
        return owner[a] != owner[b] or owner[a] == 0

    for node, (index, face) in itertools.product(surface.points.numpy(), enumerate(faces)):
        if node in face or not meets(node, face[0]):
            continue
        y0, y1, y2 = points[face]
        c = np.cross(y1 - y0, y2 - y0)
        if c @ c < smallest:
            continue
        n = c / np.linalg.norm(c)
        height = (points[node] - y0) @ n
        foot = points[node] - height * n
        b = np.linalg.lstsq(np.vstack([np.array([y0, y1, y2]).T, np.ones(3)]), np.append(foot, 1.0), rcond=None)[0]
        if abs(height) > 2 * THICKNESS or (b < -1e-6).any():
            continue
        pair = (node, *face)
        offer(("point", node), n @ node_normal[node] < 0, height, pair)
        offer(("face", index), -n @ normal[index] < 0, height, pair)

    def outside(place: np.ndarray, edge: int) -> bool:
        for s in (0, 1):
            face = surface.edge_faces[edge, s]
            q, other = points[edges[edge][s]], points[edges[edge][1 - s]]
            if face >= 0 and (other - q) @ np.cross(normal[face], place - q) < 0:
                return False
        return True

    for first, second in itertools.combinations(range(len(edges)), 2):
        p, q = edges[first], edges[second]
        if set(p) & set(q) or not meets(p[0], q[0]):
            continue
        (p0, p1), (q0, q1) = points[p], points[q]
        c = np.cross(p1 - p0, q1 - q0)
        if c @ c < smallest:
            continue
        n = c / np.linalg.norm(c)
        height = (p0 - q0) @ n
        s, t, _ = np.linalg.solve(np.array([p1 - p0, q0 - q1, -n]).T, q0 - p0)
        if abs(height) > 2 * THICKNESS or not (-1e-6 <= s <= 1 + 1e-6 and -1e-6 <= t <= 1 + 1e-6):
            continue
        if not (outside(p0 + s * (p1 - p0), second) and outside(q0 + t * (q1 - q0), first)):
            continue
        pair = (*p, *q)
        offer(("edge", first), n @ (node_normal[p[0]] + node_normal[p[1]]) < 0, height, pair)
        offer(("edge", second), -n @ (node_normal[q[0]] + node_normal[q[1]]) < 0, height, pair)
    count: dict[tuple[int, ...], int] = {}
    for height, pair in slots.values():
        if height < THICKNESS and min(pair) < cloth:  # only those push, and obstacles do not move
            count[tuple(int(p) for p in pair)] = count.get(tuple(int(p) for p in pair), 0) + 1
    return count


@pytest.mark.parametrize("smallest", [1e-6, 1e-4])
def test_pairs_and_counts_are_those_of_the_slow_twin(rng, smallest):
    surface, points = crumpled(rng, 12)
    settings = ProximitySettings(STIFFNESS, THICKNESS, smallest, count_once=False)
    found = find_proximity(surface, settings, Slots.build(surface, settings, points[:1]), points)
    doubled = 0
    for entry in range(len(points)):
        expected = twin(surface, points[entry].numpy(), smallest)
        own = found.pairs.entry == entry
        listed = zip(found.pairs.points[own].tolist(), found.count[own].tolist(), strict=True)
        assert {tuple(pair): count for pair, count in listed} == expected
        doubled += sum(count == 2 for count in expected.values())
    assert doubled > 10
    assert (found.pairs.edge_edge == 1).sum() > 10
    assert found.with_obstacle.any()
    assert not found.with_obstacle.all()


def test_obstacles_hold_slots_against_the_cloth():
    """A node of one box near a face of another keeps a cloth node that is farther away out of the face's slot."""
    cloth = grid_cloth(2, 2, 0.05, 0.05)
    floor = SurfaceMesh(np.array([[-1, -1, -0.015], [1, -1, -0.015], [0, 2, -0.015]]), np.array([[0, 1, 2]]))
    counts = []
    for bottom in (-0.005, 0.5):
        obstacles = [box((0.3, 0.3, bottom), (0.32, 0.32, 1.0)), floor]
        surface = ContactSurface.build(cloth, obstacles, all_edges=True)
        points = torch.as_tensor(np.concatenate([cloth.nodes, *(mesh.nodes for mesh in obstacles)]))[None]
        points[0, 0, 2] -= 0.001
        settings = ProximitySettings(STIFFNESS, THICKNESS, count_once=False)
        found = find_proximity(surface, settings, Slots.build(surface, settings, points), points)
        counts.append(found.count.tolist())
    assert sorted(counts[0]) == [1, 1, 1, 1]
    assert sorted(counts[1]) == [1, 1, 1, 2]


@pytest.fixture
def contact(rng):
    surface, points = crumpled(rng, 2)
    settings = ProximitySettings(STIFFNESS, THICKNESS)
    found = find_proximity(surface, settings, Slots.build(surface, settings, points[:1]), points)
    velocities = torch.as_tensor(rng.normal(size=points.shape))
    velocities[:, 25:] = 0.0
    mass = torch.as_tensor(0.01 + 0.01 * rng.random((2, 25)))
    inverse_mass = torch.cat([1 / mass, torch.zeros(2, 16, dtype=torch.float64)], dim=1)
    mu = tuple(torch.full((2,), value, dtype=torch.float64) for value in MU)
    return found, found.at(points, velocities, inverse_mass, mu, DT), points, velocities, inverse_mass


def test_once_counts_once(contact):
    assert (contact[0].count == 1).all()


def test_repulsion_is_the_gradient_of_its_energy(contact):
    """With frozen normals and weights: force = -dE/dx and stiffness = d²E/dx², E = K c³/(6 τ)."""
    _, at, points, _, _ = contact
    moved = points[:, :25].clone().requires_grad_(True)
    everything = torch.cat([moved, points[:, 25:]], dim=1)
    height = (at.normals * (at.weights[..., None] * at.pairs.gather(everything)).sum(1)).sum(-1)
    energy = (STIFFNESS * at.pairs.area * (THICKNESS - height).clamp(min=0) ** 3 / (6 * THICKNESS)).sum()
    (gradient,) = torch.autograd.grad(energy, moved, create_graph=True)
    zero = torch.zeros_like(moved)
    torch.testing.assert_close(at.forces(zero, zero), -gradient)
    direction = torch.randn(moved.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    (product,) = torch.autograd.grad(gradient, moved, direction)
    torch.testing.assert_close(at.forces(direction, zero) - at.forces(zero, zero), -product)


def test_cloth_on_cloth_conserves_momentum(contact):
    """Self-contact alone: forces sum to zero, and repulsion has no moment."""
    found, at, points, velocities, _ = contact
    own = ~found.with_obstacle
    alone = type(at)(
        found,
        at.pairs.where(own),
        at.weights[own],
        at.normals[own],
        at.normal_force[own],
        at.stiffness[own],
        at.gamma[own],
    )
    zero = torch.zeros(2, 25, 3, dtype=torch.float64)
    repulsion = alone.forces(zero, zero)
    friction = alone.forces(zero, velocities[:, :25]) - repulsion
    assert repulsion.abs().max() > 1e-3
    assert friction.abs().max() > 1e-3
    assert repulsion.sum(1).abs().max() < 1e-12
    assert friction.sum(1).abs().max() < 1e-12
    assert torch.linalg.cross(points[:, :25], repulsion).sum(1).abs().max() < 1e-12


def test_friction_is_coulombs_and_never_reverses(contact):
    found, at, _, velocities, inverse_mass = contact
    gathered = at.pairs.gather(velocities)
    velocity = (at.weights[..., None] * gathered).sum(1)
    sliding = velocity - (at.normals * velocity).sum(-1, keepdim=True) * at.normals
    force = at.gamma * sliding.norm(dim=1)
    mu = torch.where(found.with_obstacle, *MU)
    assert (force <= mu * at.normal_force * (1 + 1e-12)).all()
    inverse = (at.weights.square() * at.pairs.gather(inverse_mass)).sum(-1)
    assert (at.gamma * DT * inverse <= 1 + 1e-12).all()
    limited = torch.isclose(force, mu * at.normal_force)
    sticking = torch.isclose(at.gamma * DT * inverse, torch.ones_like(inverse))
    assert (limited | sticking).all()
    assert limited.any()


def test_couplings_are_the_matrix_of_the_forces(contact):
    _, at, _, _, _ = contact
    couplings = at.couplings(DT)
    matrix = torch.zeros(2, 25, 25, 3, 3, dtype=torch.float64)
    matrix.index_put_((couplings.entry, couplings.rows, couplings.columns), couplings.blocks, accumulate=True)
    velocity = torch.randn(2, 25, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    zero = torch.zeros_like(velocity)
    expected = -DT * (at.forces(DT * velocity, velocity) - at.forces(zero, zero))
    torch.testing.assert_close(torch.einsum("bijxy,bjy->bix", matrix, velocity), expected)


def test_nothing_near_is_none(rng):
    surface, points = crumpled(rng, 1)
    settings = ProximitySettings(STIFFNESS, 1e-6)
    points[:, :25, 2] = 1.0 + 0.1 * torch.arange(25)
    assert find_proximity(surface, settings, Slots.build(surface, settings, points), points) is None


def test_directed_edges_of_an_obstacle():
    edges, sides = directed_edges(box((0, 0, 0), (1, 1, 1)).faces)
    assert len(edges) == 18
    assert (sides >= 0).all()
