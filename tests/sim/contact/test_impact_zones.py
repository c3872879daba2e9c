"""Impact zones: selection and projection against slow twins, conservation laws, and what happens when it cannot work."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from diffcloud.errors import UnresolvedContactError
from diffcloud.mesh import grid_cloth
from diffcloud.sim.contact import impact_zones
from diffcloud.sim.contact.frames import MeetingPairs
from diffcloud.sim.contact.impact_zones import (
    Constraints,
    DualRows,
    ImpactSettings,
    dual_rows,
    resolve,
    select_disjoint,
    solve_dual,
)
from diffcloud.sim.contact.surface import ContactSurface

THICKNESS = 5e-4
NO_FRICTION = (torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))


def constraints(rng: np.random.Generator, batch: int, count: int, points: int) -> Constraints:
    """Random rows on random points, some of them twice."""
    entry = torch.arange(batch).repeat_interleave(count)
    nodes = torch.as_tensor(np.stack([rng.choice(points, 4, replace=False) for _ in entry]))
    normals = torch.as_tensor(rng.normal(size=(len(entry), 3)))
    normals /= normals.norm(dim=1, keepdim=True)
    share = torch.as_tensor(rng.random(len(entry)))
    weights = torch.stack([torch.ones_like(share), -share, -0.5 * (1 - share), -0.5 * (1 - share)], dim=1)
    for start in range(0, len(entry), count):  # a constraint found twice
        nodes[start + 1], normals[start + 1], weights[start + 1] = nodes[start], normals[start], weights[start]
    place = torch.arange(count).repeat(batch)
    pairs = MeetingPairs(torch.zeros_like(entry), entry, nodes, nodes[:, :2], torch.ones_like(share))
    return Constraints(pairs, share, share, weights, normals, place)


def test_selection_is_the_sequential_greedy_one(rng):
    for _ in range(50):
        count = 40
        entry = torch.as_tensor(np.sort(rng.integers(0, 3, count)))
        points = torch.as_tensor(np.stack([rng.choice(15, 4, replace=False) for _ in range(count)]))
        movable = points < 11
        time = torch.as_tensor(rng.random(count))
        expected, used = [], set()
        for index in np.argsort(np.floor(time.numpy() * 1e4), kind="stable"):
            own = {(int(entry[index]), int(p)) for p, free in zip(points[index], movable[index], strict=True) if free}
            if own and not own & used:
                expected.append(int(index))
                used |= own
        assert select_disjoint(entry, points, movable, time, 15).tolist() == expected


def test_projection_is_the_least_distance(rng):
    """Against Lawson & Hanson's least distance programming, entry by entry."""
    batch, count, points = 6, 9, 14
    found = constraints(rng, batch, count, points)
    inverse_mass = torch.as_tensor(0.5 + rng.random((batch, points)))
    inverse_mass[:, 0] = 0.0
    target = torch.as_tensor(rng.normal(size=(batch, count)))
    target[:, 1] = target[:, 0]
    rows = dual_rows(found, inverse_mass)
    force, _ = solve_dual(rows, target, torch.zeros_like(rows.used))
    assert (force >= 0).all()
    moved = rows.move(force)
    for entry in range(batch):
        matrix = rows.matrix[entry].flatten(1).numpy()
        scale = np.repeat(np.sqrt(inverse_mass[entry, rows.points].numpy()), 3)
        g, h = matrix * scale, target[entry].numpy()
        u, _ = nnls(np.vstack([g.T, h[None]]), np.append(np.zeros(g.shape[1]), 1.0))
        r = np.vstack([g.T, h[None]]) @ u - np.append(np.zeros(g.shape[1]), 1.0)
        expected = (-r[:-1] / r[-1]) * scale
        np.testing.assert_allclose(moved[entry, rows.points].numpy().ravel(), expected, atol=1e-9)


def test_projection_conserves_momentum(rng):
    """Σ m Δx = 0 where nothing is fixed: the weights of an impact sum to zero."""
    found = constraints(rng, 4, 6, 20)
    mass = torch.as_tensor(0.5 + rng.random((4, 20)))
    rows = dual_rows(found, 1 / mass)
    force, _ = solve_dual(rows, torch.as_tensor(rng.normal(size=(4, 6))), torch.zeros_like(rows.used))
    momentum = (mass[..., None] * rows.move(force)).sum(1)
    assert momentum.abs().max() < 1e-12
    assert rows.move(force).abs().max() > 0.1


def test_cycling_entries_take_the_certain_solver(rng, monkeypatch):
    found = constraints(rng, 5, 12, 10)
    rows = dual_rows(found, torch.ones(5, 10, dtype=torch.float64))
    target = torch.as_tensor(rng.normal(size=(5, 12)))
    target[:, 1] = target[:, 0]
    expected = rows.move(solve_dual(rows, target, torch.zeros_like(rows.used))[0])
    monkeypatch.setattr(impact_zones, "_EXCHANGES", 1)
    torch.testing.assert_close(
        rows.move(solve_dual(rows, target, torch.zeros_like(rows.used))[0]), expected, atol=1e-9, rtol=1e-9
    )


def test_contradictory_constraints_give_a_finite_compromise(rng):
    found = constraints(rng, 1, 3, 6)
    normals = found.normals.clone()
    normals[1] = -normals[0]
    found = Constraints(found.pairs, found.time, found.sign, found.weights, normals, found.place)
    rows = dual_rows(found, torch.ones(1, 6, dtype=torch.float64))
    target = torch.tensor([[1.0, 1.0, -5.0]], dtype=torch.float64)
    force, _ = solve_dual(rows, target, torch.zeros_like(rows.used))
    assert torch.isfinite(force).all()
    # asked to move both ways by the same amount, it stays
    assert rows.move(force).abs().max() < 1e-6


class Fall:
    """Two crossing strips: the upper one falls through the lower one within the step."""

    def __init__(self) -> None:
        cloth = grid_cloth(2, 4, 0.1, 0.3)
        turned = cloth.nodes[:, [1, 0, 2]] * np.array([1, -1, 1]) + np.array([0.013, 0.017, 0.02])
        from diffcloud.mesh.topology import ClothMesh

        count = len(cloth.nodes)
        mesh = ClothMesh(
            np.concatenate([cloth.nodes, turned]),
            np.concatenate([cloth.verts, cloth.verts + 1.0]),
            np.concatenate([cloth.vert_node, cloth.vert_node + count]),
            np.concatenate([cloth.face_verts, cloth.face_verts + len(cloth.verts)]),
        )
        self.surface = ContactSurface.build(mesh, [], all_edges=True)
        self.start = torch.as_tensor(mesh.nodes)[None]
        self.upper = torch.arange(2 * count) >= count
        self.inverse_mass = torch.where(self.upper, 1.0, 2.0)[None].double()

    def candidate(self, distance: float) -> torch.Tensor:
        down = torch.tensor([0.004, -0.003, -distance], dtype=torch.float64)
        return self.start + torch.where(self.upper[:, None], down, 0.0)


def test_nothing_has_passed_and_momentum_is_kept():
    fall = Fall()
    candidate = fall.candidate(0.05).requires_grad_(True)
    settings = ImpactSettings(THICKNESS)
    found = resolve(fall.surface, settings, fall.start, candidate, fall.inverse_mass, NO_FRICTION, step=1)
    change = (found - candidate) / fall.inverse_mass[..., None]
    assert change.abs().max() > 1e-3
    assert change.sum(1).abs().max() < 1e-12
    # a second resolution finds no impact any more
    again = resolve(fall.surface, settings, fall.start, found.detach(), fall.inverse_mass, NO_FRICTION, step=1)
    assert torch.equal(again, found.detach())


def test_no_impact_leaves_the_candidate_alone():
    fall = Fall()
    candidate = fall.candidate(0.01)
    assert resolve(
        fall.surface, ImpactSettings(THICKNESS), fall.start, candidate, fall.inverse_mass, NO_FRICTION, step=1
    ) is (candidate)


def test_entries_of_a_batch_do_not_see_each_other(monkeypatch):
    """Nor are those solved again that a pass has left alone."""
    fall = Fall()
    solved = []
    original = impact_zones.solve_dual

    def counted(rows: DualRows, target: torch.Tensor, guess: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        solved.append(len(target))
        return original(rows, target, guess)

    monkeypatch.setattr(impact_zones, "solve_dual", counted)
    distances = (0.01, 0.04, 0.08)
    candidate = torch.cat([fall.candidate(d) for d in distances])
    settings = ImpactSettings(THICKNESS)
    batch = resolve(
        fall.surface,
        settings,
        fall.start.expand(3, -1, -1),
        candidate,
        fall.inverse_mass.expand(3, -1),
        NO_FRICTION,
        step=1,
    )
    assert solved[0] == 2  # nothing meets in the first entry
    assert solved[-1] == 1  # and one of the others takes more passes
    for index, distance in enumerate(distances):
        single = resolve(
            fall.surface, settings, fall.start, fall.candidate(distance), fall.inverse_mass, NO_FRICTION, step=1
        )
        torch.testing.assert_close(batch[index], single[0], atol=1e-11, rtol=0)


@pytest.mark.parametrize("friction", [False, True])
def test_derivatives_of_a_projection(friction):
    fall = Fall()
    settings = ImpactSettings(THICKNESS, friction=friction)
    coefficients = torch.full((1,), 0.3, dtype=torch.float64)

    def run(start: torch.Tensor, candidate: torch.Tensor, inverse_mass: torch.Tensor, coefficient: torch.Tensor):
        return resolve(fall.surface, settings, start, candidate, inverse_mass, (coefficient, coefficient), step=1)

    generator = torch.Generator().manual_seed(1)
    start = fall.start + 1e-3 * torch.randn(fall.start.shape, dtype=torch.float64, generator=generator)
    inputs = [start, start + fall.candidate(0.06) - fall.start, fall.inverse_mass, coefficients]
    inputs = [value.clone().requires_grad_(True) for value in inputs]
    assert torch.autograd.gradcheck(run, inputs, eps=1e-7, atol=2e-5, check_forward_ad=True, fast_mode=True)


def test_constant_normals_give_the_projection_as_derivative():
    """P = I - M⁻¹ Wᵀ (W M⁻¹ Wᵀ)⁻¹ W: idempotent, and its rows do not move."""
    fall = Fall()
    settings = ImpactSettings(THICKNESS, differentiate_normals=False)

    def run(candidate: torch.Tensor) -> torch.Tensor:
        return resolve(fall.surface, settings, fall.start, candidate, fall.inverse_mass, NO_FRICTION, step=1)

    candidate = fall.candidate(0.05)
    size = candidate.numel()
    jacobian = torch.autograd.functional.jacobian(run, candidate).reshape(size, size)
    torch.testing.assert_close(jacobian @ jacobian, jacobian, atol=1e-9, rtol=0)
    weighted = jacobian / fall.inverse_mass.repeat_interleave(3)[:, None]
    torch.testing.assert_close(weighted, weighted.T, atol=1e-9, rtol=0)


def test_friction_takes_at_most_the_coulomb_share():
    """One node on a face: sliding is shortened by μ times the normal correction, and never reversed."""
    from diffcloud.mesh import SurfaceMesh
    from diffcloud.mesh.topology import ClothMesh

    nodes = np.array([[0, 0, 0.01], [0.3, 0, 0.5], [0, 0.3, 0.5]])
    cloth = ClothMesh(nodes, nodes[:, :2], np.arange(3), np.array([[0, 1, 2]]))
    floor = SurfaceMesh(np.array([[-5, -5, 0], [5, -5, 0], [0, 9, 0.0]]), np.array([[0, 1, 2]]))
    surface = ContactSurface.build(cloth, [floor], all_edges=True)
    start = torch.cat([torch.as_tensor(nodes), torch.as_tensor(floor.nodes)])[None]
    candidate = start.clone()
    candidate[0, 0] += torch.tensor([0.02, 0.0, -0.03], dtype=torch.float64)
    inverse_mass = torch.tensor([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    lift = 0.02 + THICKNESS
    for coefficient, left in ((0.0, 0.02), (0.4, 0.02 - 0.4 * lift), (2.0, 0.0)):
        mu = torch.full((1,), coefficient, dtype=torch.float64)
        found = resolve(surface, ImpactSettings(THICKNESS, friction=True), start, candidate, inverse_mass, (mu, mu), step=1)
        assert float(found[0, 0, 2]) == pytest.approx(THICKNESS, abs=1e-12)
        assert float(found[0, 0, 0]) == pytest.approx(left, abs=1e-12)


def test_passes_that_do_not_end_are_reported(monkeypatch):
    monkeypatch.setattr(impact_zones, "_PASSES", 1)
    fall = Fall()
    candidate = torch.cat([fall.candidate(0.0), fall.candidate(0.05)])
    with pytest.raises(UnresolvedContactError, match=r"step 7, batch entries \[1\].*points \d+ \(cloth\)") as caught:
        resolve(
            fall.surface,
            ImpactSettings(THICKNESS),
            fall.start.expand(2, -1, -1),
            candidate,
            fall.inverse_mass.expand(2, -1),
            NO_FRICTION,
            step=7,
        )
    assert caught.value.entries == [1]
    assert "smaller time step" in str(caught.value)
