"""Impact zones: projection and passes against slow twins, conservation laws, derivatives, and what cannot work."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest

from diffcloud.arcsim.contact.dual import HARD, REGULAR, applied, gram, least_distance, solve_active, solve_dual
from diffcloud.arcsim.contact.impact_derivatives import resolve_reverse, resolve_tangent
from diffcloud.arcsim.contact.impact_zones import (
    PASSES,
    TOUCH,
    Impacts,
    Projection,
    move,
    no_impacts,
    resolve,
    take_zone,
    zones,
)
from diffcloud.arcsim.contact.neighbours import no_neighbours
from diffcloud.compiled import kernel
from diffcloud.mesh import ClothMesh, SurfaceMesh, grid_cloth
from diffcloud.sim.contact.surface import Surface, contact_surface
from tests.arcsim.twins import impacts as twin
from tests.sim.contact.scenes import box, together

THICKNESS = 5e-4
CHOICES = Projection(THICKNESS, 0.0, 0.0)


# --- one zone --------------------------------------------------------------------------------------------------------


@dataclass
class Zone:
    """Rows on some points."""

    points: np.ndarray
    """[m, 4]"""
    rows: np.ndarray
    """[m, 9] weights and normal, as in `Impacts.places`."""
    target: np.ndarray
    """[m]"""
    inverse_mass: np.ndarray
    """[N]"""

    def force(self, guess: float = 0.0) -> tuple[np.ndarray, float]:
        found = np.full(len(self.target), guess)
        regular = solve_dual(gram(self.points, self.rows, self.inverse_mass), self.target, found)
        return found, regular

    def moved(self, force: np.ndarray) -> np.ndarray:
        """[N, 3]"""
        found = np.zeros((len(self.inverse_mass), 3))
        move(self.points, self.rows, force, 1.0, self.inverse_mass, np.zeros_like(found), found)
        return found

    def matrix(self) -> np.ndarray:
        """W [m, 3 N]."""
        listed = zip(self.points.tolist(), self.rows, strict=True)
        return np.array([twin.Impact(0, p, r[:4], r[4:7]).row(len(self.inverse_mass)) for p, r in listed])


def random_zone(rng: np.random.Generator, count: int, points: int, *, twice: bool = True) -> Zone:
    """Random rows on random points, one of them twice."""
    nodes = np.stack([rng.choice(points, 4, replace=False) for _ in range(count)])
    share, normal = rng.random(count), rng.normal(size=(count, 3))
    rows = np.zeros((count, 9))
    rows[:, :4] = np.stack([np.ones(count), -share, -0.5 * (1 - share), -0.5 * (1 - share)], axis=1)
    rows[:, 4:7] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    target, inverse_mass = rng.normal(size=count), 0.5 + rng.random(points)
    if twice:
        nodes[1], rows[1], target[1] = nodes[0], rows[0], target[0]
    inverse_mass[0] = 0.0
    return Zone(nodes, rows, target, inverse_mass)


def test_rows_are_applied_as_the_matrix(rng):
    zone = random_zone(rng, 9, 14)
    x, matrix = rng.normal(size=(14, 3)), zone.matrix()
    np.testing.assert_allclose(applied(zone.points, zone.rows, x), matrix @ x.ravel(), rtol=1e-13, atol=1e-13)
    expected = matrix * np.repeat(zone.inverse_mass, 3) @ matrix.T
    np.testing.assert_allclose(gram(zone.points, zone.rows, zone.inverse_mass), expected, rtol=1e-13, atol=1e-13)
    force = rng.random(9)
    expected = np.repeat(zone.inverse_mass, 3) * (matrix.T @ force)
    np.testing.assert_allclose(zone.moved(force).ravel(), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("guess", [0.0, 1.0], ids=["cold", "all rows active before"])
@pytest.mark.parametrize("twice", [False, True])
def test_projection_of_a_zone_is_the_quadratic_programme(rng, twice, guess):
    """Against a search through all sets of active rows."""
    for _ in range(12):
        zone = random_zone(rng, 6, 14, twice=twice)
        force, _ = zone.force(guess)
        assert (force >= 0).all()
        expected = twin.least_move(zone.matrix(), zone.target, zone.inverse_mass)
        # redundant rows share their force by a regularisation of this size
        tolerance = (100 * REGULAR if twice else 1e-12) * np.linalg.cond(zone.matrix()[1:]) ** 2
        np.testing.assert_allclose(zone.moved(force).ravel(), expected, rtol=0, atol=max(tolerance, 1e-12))


def test_projection_of_many_rows_is_the_least_distance(rng):
    for _ in range(6):
        zone = random_zone(rng, 24, 26)
        expected = twin.least_move_of_many(zone.matrix(), zone.target, zone.inverse_mass)
        np.testing.assert_allclose(zone.moved(zone.force()[0]).ravel(), expected, atol=1e-9)


def test_projection_conserves_momentum(rng):
    """Σ m Δx = 0 where nothing is fixed: the weights of an impact sum to zero."""
    zone = random_zone(rng, 6, 20)
    zone.inverse_mass[0] = 1.0
    change = zone.moved(zone.force()[0])
    assert np.abs(twin.momentum(change, zone.inverse_mass)).max() < 1e-12
    assert np.abs(change).max() > 0.1


def unit_problem(zone: Zone) -> tuple[np.ndarray, np.ndarray]:
    matrix = gram(zone.points, zone.rows, zone.inverse_mass)
    scale = 1 / np.sqrt(np.diag(matrix))
    return matrix * scale * scale[:, None], zone.target * scale


@pytest.mark.parametrize("size", [1.0, 1e-6, 1e-12])
def test_the_certain_solver_finds_the_same(rng, size):
    """Whatever the unit: corrections of light cloth are small numbers."""
    for _ in range(10):
        matrix, right = unit_problem(random_zone(rng, 8, 14))
        active = least_distance(matrix, size * right, 10 * REGULAR)
        force = solve_active(matrix, size * right, active, REGULAR)
        assert (force >= 0).all()
        lacking = size * right - matrix @ force
        assert lacking.max() < 1e-9 * size
        assert np.abs(lacking[active]).max() < 1e-9 * size


def cycles(matrix: np.ndarray, right: np.ndarray) -> bool:
    """Whether exchanging all wrong rows at once, of a problem with unit diagonal, does not end within ten exchanges."""
    active = right > 0
    for _ in range(10):
        force = solve_active(matrix, right, active, REGULAR)
        following = np.where(active, force > 0, right - matrix @ force > 10 * REGULAR * np.abs(right).max())
        if (following == active).all():
            return False
        active = following
    return True


@pytest.mark.parametrize("size", [1.0, 1e-6, 1e-12])
def test_where_the_active_set_goes_round_in_circles_the_certain_solver_decides(size):
    rows = "4.6 -1.1 -0.7 4.2; -1.1 2.7 -2.0 -0.9; -0.7 -2.0 2.7 -1.2; 4.2 -0.9 -1.2 4.3"
    matrix = np.array([[float(number) for number in row.split()] for row in rows.split(";")])
    target = size * np.array([-0.9, 1.5, -0.4, -1.4])
    scale = 1 / np.sqrt(np.diag(matrix))
    assert cycles(matrix * scale * scale[:, None], target * scale)
    force = np.zeros(4)
    assert solve_dual(matrix, target, force) == REGULAR
    excess = matrix @ force - target
    assert (force >= 0).all()
    np.testing.assert_allclose(np.minimum(force, excess), 0.0, atol=1e-11 * size)  # complementary


@pytest.mark.parametrize("size", [1.0, 1e-6, 1e-12])
def test_contradictory_constraints_give_a_finite_compromise(rng, size):
    """Asked to move both ways by the same amount, it stays; what else is asked for is done."""
    zone = random_zone(rng, 3, 12, twice=False)
    zone.points[:] = [[1, 2, 3, 4], [1, 2, 3, 4], [5, 6, 7, 8]]
    zone.rows[1] = zone.rows[0]
    zone.rows[1, 4:7] *= -1
    for wanted in (-5.0, 0.01):
        zone = replace(zone, target=size * np.array([1.0, 1.0, wanted]))
        force, regular = zone.force()
        assert regular == HARD
        assert np.isfinite(force).all()
        moved = zone.moved(force)
        assert np.abs(moved[:5]).max() < 1e-6 * size
        reached = applied(zone.points, zone.rows, moved)[2]
        assert reached == pytest.approx(size * max(wanted, 0.0), rel=1e-6, abs=1e-9 * size)


def test_zones_are_the_impacts_joined_by_points_that_move(rng):
    for _ in range(50):
        met = np.column_stack([np.zeros(20, np.int64), *(rng.integers(0, 60, 20) for _ in range(4))])
        movable = rng.random(60) < 0.7
        label = zones(met, movable.astype(float))
        free = [{int(i) for i in row[1:] if movable[i]} for row in met]
        reached = np.eye(20, dtype=bool)
        for i, j in itertools.combinations(range(20), 2):
            reached[i, j] = reached[j, i] = bool(free[i] & free[j])
        for _ in range(5):  # paths of 2, 4, ... 32 steps
            reached = reached @ reached
        for i in range(20):
            assert (label[i] < 0) == (not free[i])
            if label[i] >= 0:
                np.testing.assert_array_equal(reached[i], label == label[i])
        chosen = take_zone(label, int(np.argmax(label >= 0)))
        assert (label[chosen] == -1).all()


# --- whole steps -----------------------------------------------------------------------------------------------------


@kernel
def resolve_alone(surface, choices, start, places, inverse_mass, record):
    """One step, with pairs of its own."""
    return resolve(surface, no_neighbours(surface, TOUCH), choices, start, places, inverse_mass, record)


@dataclass
class Fall:
    """Points that go straight from start to candidate within a step."""

    surface: Surface
    start: np.ndarray
    candidate: np.ndarray
    inverse_mass: np.ndarray
    choices: Projection = CHOICES

    def resolve(self, record: Impacts | None = None) -> tuple[np.ndarray, Impacts]:
        """(places, record)"""
        places = self.candidate.copy()
        resolved, record = resolve_alone(
            self.surface, self.choices, self.start, places, self.inverse_mass, record or no_impacts()
        )
        assert resolved
        return places, record

    def passes(self, record: Impacts) -> np.ndarray:
        """[P, 2]"""
        return record.passes[: record.used[1]]


def strips() -> ClothMesh:
    cloth = grid_cloth(2, 4, 0.1, 0.3)
    turned = cloth.nodes[:, [1, 0, 2]] * np.array([1, -1, 1]) + np.array([0.013, 0.017, 0.02])
    return together(cloth, replace(cloth, nodes=turned))


def two_strips(distance: float = 0.05) -> Fall:
    """Two crossing strips: the upper one falls through the lower one within the step."""
    mesh = strips()
    start = mesh.nodes + 1e-3 * np.random.default_rng(1).normal(size=mesh.nodes.shape)
    upper = np.arange(len(start)) >= len(start) // 2
    candidate = start + upper[:, None] * np.array([0.004, -0.003, -distance])
    return Fall(contact_surface(mesh, []), start, candidate, np.where(upper, 1.0, 2.0))


def folded(distance: float = 0.07) -> Fall:
    """A cloth folded once: its upper half falls on the lower one, and all of it on a box."""
    mesh = grid_cloth(7, 4, 0.24, 0.12)
    along = mesh.nodes[:, 1] - mesh.nodes[:, 1].min()
    arc = np.clip((along - 0.1) / 0.02, 0.0, np.pi)
    flat = np.minimum(along, 0.1) + 0.02 * np.sin(arc) - np.maximum(along - 0.1 - 0.02 * np.pi, 0.0)
    nodes = np.stack([mesh.nodes[:, 0], flat, 0.02 * (1 - np.cos(arc))], axis=1)
    nodes += 1e-3 * np.random.default_rng(2).normal(size=nodes.shape)
    obstacle = box((-0.031, 0.013, -0.2), (0.047, 0.2, -0.012))
    start = np.concatenate([nodes, obstacle.nodes])
    falls = np.where(arc > np.pi / 2, distance, 0.02)[:, None] * np.array([0.05, -0.1, -1.0])
    candidate = start.copy()
    candidate[: len(nodes)] += falls
    inverse_mass = np.concatenate([1 / np.random.default_rng(3).uniform(0.5, 1.0, len(nodes)), np.zeros(8)])
    return Fall(contact_surface(mesh, [obstacle], all_edges=True), start, candidate, inverse_mass)


def held_fold() -> Fall:
    """The same with two nodes of the upper half in a handle that carries them down through the lower one."""
    fall = folded()
    held = [21, 22]
    fall.inverse_mass[held] = 0.0
    fall.candidate[held] = fall.start[held] + [0.0, 0.0, -0.05]
    return fall


def two_corners() -> Fall:
    """A cloth's corner falls onto a table's inner edge, and meets the faces on both sides of it at the same time."""
    nodes = np.array([[0.0, 0, 0.01], [0.3, 0.1, 0.5], [-0.1, 0.3, 0.5]])
    cloth = ClothMesh(nodes, nodes[:, :2], np.arange(3), np.array([[0, 1, 2]]))
    table = SurfaceMesh(np.array([[-1, 0, 0], [1, 0, 0.0], [0, 1, 0], [0, -1, 0]]), np.array([[0, 1, 2], [0, 3, 1]]))
    start = np.concatenate([nodes, table.nodes])
    candidate = start.copy()
    candidate[0] += [0.02, 0.0, -0.03]
    inverse_mass = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0])
    return Fall(contact_surface(cloth, [table], all_edges=True), start, candidate, inverse_mass)


def between_plates(*heights: float) -> Fall:
    """A triangle falls fast between level plates."""
    nodes = np.array([[0.0, 0, 0], [0.3, 0.1, 0.0], [-0.1, 0.3, 0.0]])
    cloth = ClothMesh(nodes, nodes[:, :2], np.arange(3), np.array([[0, 1, 2]]))
    plates = [SurfaceMesh(np.array([[-5, -5, z], [5, -5, z], [0, 9, z]]), np.array([[0, 1, 2]])) for z in heights]
    start = np.concatenate([nodes, *(plate.nodes for plate in plates)])
    inverse_mass = np.where(np.arange(len(start)) < 3, 1.0, 0.0)
    candidate = start - inverse_mass[:, None] * [0.0, 0.0, 0.01]
    return Fall(contact_surface(cloth, plates, all_edges=True), start, candidate, inverse_mass)


FALLS = {"strips": two_strips, "fold": folded, "held fold": held_fold, "two corners": two_corners}


@pytest.fixture(params=FALLS)
def fall(request) -> Fall:
    return FALLS[request.param]()


def test_passes_are_those_of_the_slow_twin(fall):
    places, record = fall.resolve()
    expected, passes = twin.resolve(fall.surface, fall.start, fall.candidate, fall.inverse_mass, THICKNESS)
    assert fall.passes(record)[:, 1].tolist() == [len(fresh) for fresh in passes]
    listed = [impact for fresh in passes for impact in fresh]
    assert record.met[: len(listed)].tolist() == [[impact.kind, *impact.points] for impact in listed]
    for row, impact in zip(record.places, listed, strict=False):
        np.testing.assert_allclose(row[:4], impact.weights, atol=1e-8)
        np.testing.assert_allclose(row[4:7], impact.normal, atol=1e-8)
    np.testing.assert_allclose(places, expected, atol=1e-10)
    assert len(listed) >= 1


def test_nothing_has_passed_and_what_is_fixed_stays(fall):
    places, _ = fall.resolve()
    assert np.abs(places - fall.candidate).max() > 1e-3
    fixed = fall.inverse_mass == 0
    np.testing.assert_array_equal(places[fixed], fall.candidate[fixed])
    # a second resolution finds no impact any more
    again, after = replace(fall, candidate=places).resolve()
    np.testing.assert_array_equal(again, places)
    assert after.used.tolist() == [0, 0, 0]


def test_momentum_is_kept():
    fall = two_strips()
    places, _ = fall.resolve()
    assert np.abs(twin.momentum(places - fall.candidate, fall.inverse_mass)).max() < 1e-12


def test_no_impact_leaves_the_candidate_alone():
    fall = two_strips(0.01)
    places, record = fall.resolve()
    np.testing.assert_array_equal(places, fall.candidate)
    assert record.used.tolist() == [0, 0, 0]


def test_what_a_pass_has_left_alone_is_not_solved_again():
    """Two falls side by side are two zones; the one that needs fewer passes keeps its forces in the others."""
    near, far = two_strips(0.03), two_strips(0.08)
    single = [fall.resolve() for fall in (near, far)]
    count = len(near.start)
    shift = np.array([5.0, 0.0, 0.0])
    both = Fall(
        contact_surface(together(strips(), strips()), []),
        np.concatenate([near.start, far.start + shift]),
        np.concatenate([near.candidate, far.candidate + shift]),
        np.tile(near.inverse_mass, 2),
    )
    places, record = both.resolve()
    for (expected, _), found in zip(single, (places[:count], places[count:] - shift), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-11)
    rounds = [len(fall.passes(own)) for fall, (_, own) in zip((near, far), single, strict=True)]
    assert len(both.passes(record)) == max(rounds)
    assert min(rounds) < max(rounds)


def test_the_residue_is_left_out_of_each_correction():
    fall = two_strips()
    whole, _ = fall.resolve()
    part, record = replace(fall, choices=Projection(THICKNESS, 0.0, 1e-6)).resolve()
    if record.used[1] == 1:
        np.testing.assert_allclose(part - fall.candidate, (1 - 1e-6) * (whole - fall.candidate), atol=1e-15)
    np.testing.assert_allclose(part, whole, atol=1e-6)
    assert np.abs(part - whole).max() > 1e-9


def test_between_plates_closer_than_the_thickness_it_stays_between():
    """Both ask for more room than there is, and get half of it."""
    places, record = between_plates(-1e-4, 1e-4).resolve()
    np.testing.assert_allclose(places[:3, 2], 0.0, atol=1e-6)
    assert record.forces[record.used[2] - 1, 1] == HARD


def test_passes_that_do_not_end_are_reported():
    """A cloth that starts within a plate has no side to be kept on."""
    fall = between_plates(0.0)
    places = fall.candidate.copy()
    resolved, record = resolve_alone(fall.surface, fall.choices, fall.start, places, fall.inverse_mass, no_impacts())
    assert not resolved
    assert record.used[1] == PASSES
    assert np.isfinite(places).all()
    assert set(record.met[record.used[0] - 1, 1:].tolist()) & {0, 1, 2}


def test_a_record_holds_step_after_step(fall):
    """Rows of a step follow those of the steps before, whatever these found."""
    alone, own = fall.resolve()
    _, record = two_strips().resolve()
    used = record.used.copy()
    places, record = fall.resolve(record)
    np.testing.assert_array_equal(places, alone)
    for name, begin, end, count in zip(
        ("met", "places", "passes", "forces"),
        used[[0, 0, 1, 2]],
        record.used[[0, 0, 1, 2]],
        own.used[[0, 0, 1, 2]],
        strict=True,
    ):
        np.testing.assert_array_equal(getattr(record, name)[begin:end], getattr(own, name)[:count])


# --- derivatives -----------------------------------------------------------------------------------------------------


def limits(used: np.ndarray) -> np.ndarray:
    """A row of `Kept.begins`."""
    return np.array([0, *used, 0], np.int64)


class Derivatives:
    """Of a fall's places by start, candidate and inverse masses."""

    def __init__(self, fall: Fall, record: Impacts | None = None) -> None:
        self.fall = fall
        self.begin = limits(np.zeros(3, np.int64) if record is None else record.used.copy())
        self.places, self.record = fall.resolve(record)
        self.end = limits(self.record.used)

    def tangent(self, start: np.ndarray, candidate: np.ndarray, inverse_mass: np.ndarray) -> np.ndarray:
        """[K, N, 3] of directions [K, ...]."""
        fall, found = self.fall, candidate.copy()
        resolve_tangent(
            *(fall.choices, self.record, self.begin, self.end, fall.start, fall.candidate, fall.inverse_mass),
            *(start, inverse_mass, found),
        )
        return found

    def reverse(self, adjoint: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Gradients of adjoint · places by the start, the candidate and the inverse masses."""
        fall, candidate = self.fall, adjoint.copy()
        start, inverse_mass = np.zeros_like(adjoint), np.zeros(len(adjoint))
        resolve_reverse(
            *(fall.choices, self.record, self.begin, self.end, fall.start, fall.candidate, fall.inverse_mass),
            *(candidate, start, inverse_mass),
        )
        return start, candidate, inverse_mass

    def directions(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        shape = (count, *self.places.shape)
        moves = rng.normal(size=shape[:2]) * (self.fall.inverse_mass > 0)
        return rng.normal(size=shape), rng.normal(size=shape), moves


def check_transposed(derivatives: Derivatives, rng: np.random.Generator, tolerance: float) -> None:
    directions = derivatives.directions(rng, 3)
    for adjoint in rng.normal(size=(3, *derivatives.places.shape)):
        gradients = derivatives.reverse(adjoint)
        products = [(gradient * rates).reshape(3, -1) for gradient, rates in zip(gradients, directions, strict=True)]
        found = np.concatenate(products, axis=1)
        forward = derivatives.tangent(*directions) * adjoint
        scale = np.abs(found).sum(axis=1).max()
        np.testing.assert_allclose(found.sum(axis=1), forward.sum(axis=(1, 2)), rtol=0, atol=tolerance * scale)


def test_reverse_is_the_transpose_of_tangent(fall, rng):
    check_transposed(Derivatives(fall), rng, 1e-12)


def doubled(derivatives: Derivatives) -> Derivatives:
    """The same passes with each impact found twice, so that both share its force."""
    record, used = derivatives.record, derivatives.record.used
    forces = np.repeat(record.forces[: used[2]], 2, axis=0)
    forces[:, 0] /= 2
    met, places = np.repeat(record.met, 2, axis=0), np.repeat(record.places, 2, axis=0)
    found = Derivatives(derivatives.fall)
    found.record = Impacts(met, places, 2 * record.passes, forces, used * [2, 1, 2])
    found.end = limits(found.record.used)
    return found


def test_redundant_impacts_have_the_derivatives_of_one(fall, rng):
    once = Derivatives(fall)
    twice = doubled(once)
    check_transposed(twice, rng, 1e-12)
    directions, adjoint = once.directions(rng, 3), rng.normal(size=fall.start.shape)
    np.testing.assert_allclose(twice.tangent(*directions), once.tangent(*directions), atol=1e-9)
    for found, expected in zip(twice.reverse(adjoint), once.reverse(adjoint), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)


def test_contradictory_impacts_have_the_derivatives_of_the_compromise(rng):
    """Halfway between the plates: it follows the mean of both, but not its own candidate."""
    derivatives = Derivatives(between_plates(-1e-4, 1e-4))
    check_transposed(derivatives, rng, 1e-9)
    up = np.zeros((3, len(derivatives.places), 3))
    for row, points in enumerate((slice(0, 3), slice(3, 6), slice(6, 9))):
        up[row, points, 2] = 1.0
    found = derivatives.tangent(up, up, np.zeros(up.shape[:2]))
    np.testing.assert_allclose(found[:, :3, 2], np.array([[0.0], [0.5], [0.5]]) * np.ones(3), atol=1e-6)


def test_reverse_is_the_transpose_of_tangent_in_a_later_step(fall, rng):
    _, record = two_strips().resolve()
    check_transposed(Derivatives(fall, record), rng, 1e-12)


def test_a_later_step_has_the_derivatives_of_a_first(fall, rng):
    first, later = Derivatives(fall), Derivatives(fall, two_strips().resolve()[1])
    directions = first.directions(rng, 2)
    np.testing.assert_allclose(later.tangent(*directions), first.tangent(*directions), rtol=1e-9, atol=1e-12)


def same_impacts(one: Impacts, other: Impacts) -> bool:
    return (one.used == other.used).all() and (one.met[: one.used[0]] == other.met[: one.used[0]]).all()


def test_tangent_is_the_central_difference(fall, rng):
    """The step is swept: far ones see curvature and other impacts, near ones rounding."""
    derivatives = Derivatives(fall)
    for index in range(3):  # by each input
        rates = [direction * (k == index) for k, direction in enumerate(derivatives.directions(rng, 2))]
        found = derivatives.tangent(*rates)
        for d in range(2):
            errors = []
            for h in (1e-6, 1e-7, 1e-8):
                ends = [
                    replace(
                        fall,
                        start=fall.start + step * rates[0][d],
                        candidate=fall.candidate + step * rates[1][d],
                        inverse_mass=fall.inverse_mass + step * rates[2][d],
                    ).resolve()
                    for step in (h, -h)
                ]
                if all(same_impacts(record, derivatives.record) for _, record in ends):
                    errors.append(np.abs((ends[0][0] - ends[1][0]) / (2 * h) - found[d]).max())
            assert min(errors) < 1e-6 * max(1.0, np.abs(found[d]).max())


def test_what_is_fixed_has_derivatives_of_its_own_motion_only(rng):
    """A held node goes where its handle is, whatever pushes; its mass does not matter."""
    derivatives = Derivatives(held_fold())
    fixed = derivatives.fall.inverse_mass == 0
    start, candidate, _ = derivatives.directions(rng, 2)
    masses = rng.normal(size=candidate.shape[:2]) * fixed
    found = derivatives.tangent(start, candidate, masses)
    np.testing.assert_array_equal(found[:, fixed], candidate[:, fixed])
    np.testing.assert_array_equal(found, derivatives.tangent(start, candidate, 0 * masses))
    assert not derivatives.reverse(rng.normal(size=start.shape[1:]))[2][fixed].any()


def test_translation_passes_through(fall):
    """Everything moved alike moves the result alike."""
    derivatives = Derivatives(fall)
    rates = np.tile(np.eye(3)[:, None], (1, len(fall.start), 1))
    found = derivatives.tangent(rates, rates, np.zeros(rates.shape[:2]))
    np.testing.assert_allclose(found, rates, atol=1e-9)
