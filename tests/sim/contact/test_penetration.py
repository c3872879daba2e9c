"""The search for penetrations finds what is there and nothing else, on configurations made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffcloud.mesh import (
    ClothMesh,
    box_surface,
    cylinder_surface,
    grid_cloth,
    loop_cloth,
    rectangle_surface,
    sphere_surface,
)
from tests.sim.contact.penetration import edge_face_crossings, find_penetrations, inside, minimal_distance

BOX = box_surface([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1])
POLE = cylinder_surface([0, -1, 0], [0, 1, 0], 0.01, 12)


def sheet(count: int = 5, size: float = 0.4) -> ClothMesh:
    return grid_cloth(count, count, size, size)


def two_sheets(gap: float) -> ClothMesh:
    """A small sheet `gap` above a larger one: one mesh of two components."""
    lower, upper = sheet(5, 0.4), sheet(4, 0.15)
    count = len(lower.nodes)
    return ClothMesh(
        np.concatenate([lower.nodes, np.add(upper.nodes, (0.01, 0.02, gap))]),
        np.concatenate([lower.verts, np.add(upper.verts, (1, 0))]),
        np.arange(count + len(upper.nodes)),
        np.concatenate([lower.face_verts, upper.face_verts + count]),
    )


def kinds(positions, mesh, *obstacles) -> set[str]:
    return {found.kind for found in find_penetrations(np.asarray(positions), mesh, obstacles)}


@pytest.mark.parametrize("body", [BOX, POLE, sphere_surface([0, 0, 0], 0.1, 2)], ids=["box", "pole", "sphere"])
def test_inside_is_inside(body, rng):
    middle = body.nodes.mean(axis=0)
    scale = 0.99 * rng.uniform(0, 1, (200, 1))
    face = body.faces[rng.integers(len(body.faces), size=200)]
    on = (body.nodes[face] * rng.dirichlet(np.ones(3), 200)[..., None]).sum(axis=1)
    assert inside(middle + scale * (on - middle), body).all()
    assert not inside(middle + (1.01 + scale) * (on - middle), body).any()


@pytest.mark.parametrize(
    ("ends", "crosses"),
    [
        ([[0.2, 0.2, -1], [0.2, 0.2, 1]], True),
        ([[0.2, 0.2, 1], [0.2, 0.2, -1]], True),
        ([[0.2, 0.2, 0.1], [0.2, 0.2, 1]], False),  # ends above
        ([[0.6, 0.6, -1], [0.6, 0.6, 1]], False),  # beside
        ([[-1, 0.2, 0], [1, 0.2, 0]], False),  # in its plane
        ([[0.2, 0.2, 0], [0.2, 0.2, 1]], False),  # touches
        ([[0.2, 0.2, -1e-9], [0.2, 0.2, 1e-9]], True),
    ],
)
def test_edges_and_faces(ends, crosses):
    triangle = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], dtype=float)
    assert edge_face_crossings(np.array([ends], dtype=float), triangle).tolist() == [[crosses]]


def test_a_cloth_that_stays_above_is_clean():
    mesh = sheet()
    path = [np.add(mesh.nodes, (0, 0, z)) for z in (0.3, 0.2, 0.1001)]
    assert kinds(path, mesh, BOX, rectangle_surface([0, 0], [1, 1], -0.1)) == set()


def test_nodes_in_a_box_and_behind_a_table():
    mesh = sheet()
    path = [np.add(mesh.nodes, (0, 0, z)) for z in (0.2, 0.09)]
    assert "inside" in kinds(path, mesh, BOX)
    found = find_penetrations(np.array(path), mesh, [rectangle_surface([0, 0], [1, 1], 0.1)])
    assert {(item.kind, item.place, item.step) for item in found} == {("inside", "table", 1)}


def test_a_thin_pole_between_the_nodes_is_crossed_by_edges():
    mesh = sheet(4)  # no node at x = 0
    path = np.array([np.add(mesh.nodes, (0, 0, z)) for z in (0.05, 0.0)])
    found = find_penetrations(path, mesh, [POLE])
    assert {item.kind for item in found} == {"crossing"}
    assert not inside(path[-1], POLE).any()


def test_a_corner_pokes_through_one_face():
    mesh = sheet(2, 2.0)
    spike = box_surface([0.4, 0.2, -0.5], [0.42, 0.22, 0.1])  # thinner than the cloth's only faces
    found = find_penetrations(np.array([np.add(mesh.nodes, (0, 0, z)) for z in (0.2, 0.0)]), mesh, [spike])
    assert {item.place for item in found} == {"edge of obstacle 0, cloth face"}


@pytest.mark.parametrize("count", [4, 5])
def test_a_jump_over_a_thin_pole_is_found_whether_nodes_or_edges_meet_it(count):
    mesh = sheet(count)
    path = [np.add(mesh.nodes, (0, 0, z)) for z in (0.03, -0.03)]
    assert kinds(path, mesh, POLE) == {"through"}


def test_a_straight_path_that_cuts_a_corner_is_no_passage():
    mesh = grid_cloth(2, 2, 0.02, 0.02)
    above, beside = np.add(mesh.nodes, (0.08, 0, 0.101)), mesh.nodes[:, [2, 1, 0]] + [0.101, 0, 0.08]
    assert kinds([above, beside], mesh, BOX) == set()


def test_a_sheet_through_a_sheet():
    mesh = two_sheets(0.02)
    jump = np.where(np.arange(len(mesh.nodes))[:, None] < 25, 0.0, [0, 0, -0.04])
    assert kinds([mesh.nodes, mesh.nodes + jump], mesh) == {"through"}
    assert kinds([mesh.nodes, mesh.nodes + 0.4 * jump], mesh) == set()
    assert kinds([mesh.nodes, mesh.nodes + jump, mesh.nodes + jump], mesh) == {"through"}


def test_both_sheets_move_together_through_nothing():
    mesh = two_sheets(0.001)
    assert kinds([mesh.nodes, np.add(mesh.nodes, (0.3, 0, -0.5))], mesh) == set()


def test_a_tilted_sheet_cuts_another():
    mesh = two_sheets(0.05)
    tilted = mesh.nodes.copy()
    tilted[25:, 2] = 0.05 + 0.9 * tilted[25:, 0]
    assert "crossing" in kinds([mesh.nodes, tilted], mesh)
    cut_at_start = replace(mesh, nodes=tilted)
    assert kinds([tilted, tilted], cut_at_start) == set()  # there from the start: no finding


def test_a_fold_onto_itself_is_clean_until_it_cuts():
    mesh = sheet(7, 0.6)
    x, y, _ = mesh.nodes.T
    angle = np.clip(x / 0.1, -np.pi / 2, np.pi / 2)
    roll = np.column_stack([0.1 * np.cos(angle), y, 0.1 * np.sin(angle)])
    beyond = np.abs(x) > 0.05 * np.pi
    roll[beyond, 0] -= np.abs(x[beyond]) - 0.05 * np.pi
    assert kinds([roll, roll], mesh) == set()
    closed = roll.copy()
    closed[x > 0.29, 2] = -0.15
    assert "crossing" in kinds([roll, closed], mesh)


def test_distances_of_meshes(rng):
    upper = (np.add(sheet().nodes, (0.013, 0.02, 0.03)), sheet().faces)
    assert minimal_distance((sheet().nodes, sheet().faces), upper) == pytest.approx(0.03)
    ball = sphere_surface([0, 0, 0.5], 0.1, 3)
    assert minimal_distance((sheet().nodes, sheet().faces), (ball.nodes, ball.faces)) == pytest.approx(0.4, abs=2e-3)
    loop = loop_cloth(2, 4, 0.1, 0.8)  # a square tube: opposite sides are 0.2 apart
    assert minimal_distance((loop.nodes, loop.faces), (loop.nodes, loop.faces), apart=True) > 0.05
