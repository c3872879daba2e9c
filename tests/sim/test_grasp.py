"""A pivot yields as a rigid square of its size, on every mesh."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from diffcloud.mesh import ClothMesh, grid_cloth
from diffcloud.sim.build import build_system
from diffcloud.sim.grasp import Grasp, inside, nodes_under_pad, stretching_factors, window
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.materials import isotropic
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import Surrounding
from tests.conftest import small_lift
from tests.sim.directional import Episode, directions
from tests.sim.test_gradients import compare

PLACES = {"corner": (0.0, 0.0), "edge": (0.5, 0.0), "inside": (0.5, 0.5)}
WITHIN = {"corner": 0.07, "edge": 0.11, "inside": 0.17}
"""Largest error of the compliance; where edges are as long as the square."""


def sheet(cells: int, place: str, through: int = 0) -> tuple[ClothMesh, int]:
    """A unit square and its node at a place, where diagonals meet (0) or not (1)."""
    node = round(PLACES[place][1] * cells) * (cells + 1) + round(PLACES[place][0] * cells)
    return grid_cloth(cells + 1, cells + 1, 1.0, 1.0, through=node + through), node


def compliance(mesh: ClothMesh, node: int, place: str, factors: np.ndarray, rigid: float = 0.0) -> float:
    """Displacement by a unit force in the plane, of linear elasticity with E h = 1, ν = 0.2; the far sides are fixed.

    Args:
        rigid: side of a square around the node that moves as one.
    """
    moduli = np.array([[1, 0.2, 0], [0.2, 1, 0], [0, 0, 0.4]]) / (1 - 0.2**2)
    corner = mesh.verts[mesh.face_verts]
    across = np.roll(corner, -1, 1) - np.roll(corner, -2, 1)
    strain = np.zeros((len(corner), 3, 6))
    strain[:, 0, 0::2] = strain[:, 2, 1::2] = across[..., 1]
    strain[:, 1, 1::2] = strain[:, 2, 0::2] = -across[..., 0]
    strain /= 2 * mesh.face_area[:, None, None]
    blocks = np.einsum("fki,kl,flj,f->fij", strain, moduli, strain, mesh.face_area * factors)
    number = np.arange(2 * len(mesh.verts)).reshape(-1, 2)
    if rigid:
        number[inside(mesh.verts, *window(mesh.verts[node], np.zeros(2), np.ones(2), rigid))] = number[node]
    of = number[mesh.face_verts].reshape(-1, 6)
    rows, columns = np.repeat(of, 6, axis=1).ravel(), np.tile(of, (1, 6)).ravel()
    matrix = coo_array((blocks.ravel(), (rows, columns)), (number.size, number.size)).tocsc()
    x, y = mesh.verts.T
    end = 1 - 1e-9
    fixed = {"corner": (x > end) | (y > end), "edge": y > end, "inside": (x > end) | (y > end) | (x < 1e-9) | (y < 1e-9)}
    free = np.setdiff1d(np.unique(of), number[fixed[place]])
    way = {"corner": np.array([-1, -1]) / 2**0.5, "edge": np.array([0, -1]), "inside": np.array([0, 1])}[place]
    force, moved = np.zeros(number.size), np.zeros(number.size)
    force[number[node]] = way
    moved[free] = spsolve(matrix[free][:, free], force[free])
    return float(moved[number[node]] @ way)


@pytest.mark.parametrize("through", [0, 1])
@pytest.mark.parametrize("place", PLACES)
def test_a_pivot_yields_as_a_rigid_square_on_every_mesh(place, through):
    size = 1 / 8
    coarse, fine = (compliance(*sheet(n, place), place, np.ones(2 * n * n), size) for n in (48, 96))
    square = 2 * fine - coarse
    alone = []
    for cells in (4, 6, 8, 12, 16, 32, 48):
        mesh, node = sheet(cells, place, through)
        found = compliance(mesh, node, place, stretching_factors(mesh, [node], Grasp("pivot", size)))
        assert found == pytest.approx(square, rel=WITHIN[place]), cells
        alone.append(compliance(mesh, node, place, np.ones(2 * cells**2)))
    assert alone[-1] > 1.8 * alone[0]  # a single node has no limit


def test_a_hanging_sheet_is_as_long_on_every_mesh():
    """Hung by a corner: where the point 0.3 m along its edges comes to rest under the corner."""

    def length(cells: int, grasp: Grasp | None) -> float:
        flat = grid_cloth(cells + 1, cells + 1, 0.3, 0.3)
        around = Surrounding(air_density=0.0, self_contact=False)
        material = isotropic("sheet", density=0.25, stretching=400.0, bending=1e-5, poisson=0.2, damping=0.01)
        nodes = np.column_stack([flat.nodes[:, 0] - flat.nodes[:, 1], np.zeros(len(flat.nodes)), -flat.nodes.sum(1)])
        mesh = ClothMesh(nodes / 2**0.5, flat.verts, flat.vert_node, flat.face_verts)
        handles = Handles((Handle(0),), hard=True, grasp=grasp)
        system = build_system(
            mesh, material, time_step=0.05, handles=handles, surrounding=around, integrator="implicit", order=1
        )
        with torch.no_grad():
            end = rollout(system, 120).positions[0, -1, :, 2]
        return float(end[0] - end[-1]) - 0.3 * 2**0.5

    pivots = [length(cells, Grasp("pivot", 0.02)) for cells in (6, 12, 24)]
    nodes = [length(cells, None) for cells in (6, 12, 24)]
    assert np.ptp(pivots) < 0.04 * np.mean(pivots)
    assert np.ptp(nodes) > 0.2 * np.mean(nodes)


def test_only_faces_at_a_pivot_are_scaled():
    mesh = grid_cloth(7, 7, 0.3, 0.3)
    assert (stretching_factors(mesh, [0], None) == 1).all()
    assert (stretching_factors(mesh, [0, 1], Grasp("pad", 0.02)) == 1).all()
    assert (stretching_factors(mesh, [0, 1], Grasp("pivot", 0.02)) == 1).all()  # held side by side: no point load
    factors = stretching_factors(mesh, [0, 48], Grasp("pivot", 0.02))
    at = np.isin(mesh.faces, [0, 48]).any(1)
    assert at.sum() == 4
    assert (factors[~at] == 1).all()
    # K = 0.81, c = 1.38, g = 0.2, h = 50 mm
    np.testing.assert_allclose(factors[at], 1 / (1 + 0.81 / 1.38 * np.log(0.2 * 0.05 / 0.02)))


def test_a_pad_on_any_mesh_lies_within_the_patch_of_its_node():
    mesh = grid_cloth(7, 7, 0.3, 0.3)
    apart = ClothMesh(
        np.concatenate([mesh.nodes, mesh.nodes + np.array([1.0, 0, 0])]),
        np.concatenate([mesh.verts + np.array([9.0, 0]), mesh.verts]),
        np.arange(98),
        np.concatenate([mesh.face_verts, mesh.face_verts + 49]),
    )
    assert nodes_under_pad(apart, 48, 0.055) == [40, 41, 47, 48]
    assert nodes_under_pad(apart, 49 + 24, 0.101) == [49 + n for n in (16, 17, 18, 23, 24, 25, 30, 31, 32)]
    assert nodes_under_pad(apart, 49 + 3, 0.101) == [49 + n for n in (2, 3, 4, 9, 10, 11, 16, 17, 18)]


@pytest.mark.parametrize("grip", ["pivot", "upright_pad"])
def test_derivatives_of_an_episode(grip):
    episode = Episode.build(small_lift(gap_m=1.0, grip=grip, integrator="implicit", nodes=(4, 4)), 6)
    found = compare(episode, directions(episode, per_field=1))
    assert found.pop("friction")[0] == 0.0
    for name, (value, forward, central) in found.items():
        assert value != 0.0, name
        assert forward <= 1e-8, name
        assert central <= 1e-6, name
