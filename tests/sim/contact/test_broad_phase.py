"""Candidate pairs against a look at all of them, with boxes that touch exactly, and against another library."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffcloud.mesh import grid_cloth
from diffcloud.sim.contact.broad_phase import candidates, corners_of
from diffcloud.sim.contact.surface import Surface, contact_surface
from tests.sim.contact.scenes import box, crumpled, together
from tests.sim.twins import broad_phase as twin

MARGIN = 0.02


def compared(surface: Surface, places: np.ndarray, others: np.ndarray, margin: float, among_fixed: bool = False) -> int:
    """How many pairs the kernel finds; each once, and the same as the twin."""
    asked = surface._replace(movable=np.ones_like(surface.movable)) if among_fixed else surface
    point_face, edge_edge = candidates(asked, places, others, margin)
    expected = twin.candidates(surface, places, others, margin, among_fixed)
    assert not point_face[:, 2].any()
    assert not edge_edge[:, 2].any()
    for found, wanted in zip((point_face[:, :2], np.sort(edge_edge[:, :2], axis=1)), expected, strict=True):
        told = [tuple(pair) for pair in found.tolist()]
        assert len(told) == len(set(told)), "each pair once"
        assert set(told) == wanted
    return sum(map(len, expected))


@pytest.mark.parametrize("among_fixed", [False, True])
@pytest.mark.parametrize("touches_itself", [False, True])
@pytest.mark.parametrize("movable", [(False, False), (True, False), (True, True)])
def test_candidates_are_all_pairs_that_may_touch_once(rng, among_fixed, touches_itself, movable):
    surface, points = crumpled(rng)
    surface = surface._replace(movable=np.array([True, *movable]), touches_itself=touches_itself)
    for _ in range(2):
        assert compared(surface, points, points + 0.02 * rng.normal(size=points.shape), MARGIN, among_fixed) > 10


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_boxes_that_touch_exactly_are_candidates(axis, side):
    """Two flat squares a quarter apart, in numbers without rounding: at this margin boxes touch, at none below."""
    lower, upper = grid_cloth(2, 2, 1.0, 1.0), grid_cloth(2, 2, 1.0, 1.0)
    turn = np.roll(np.eye(3), axis + 1, axis=1)  # the normal along each axis
    nodes = np.concatenate([lower.nodes, np.add(upper.nodes, (0.0, 0.0, side * 0.25))]) @ turn
    surface = contact_surface(together(lower, upper), [])
    touching = compared(surface, nodes, nodes, 0.25)
    apart = compared(surface, nodes, nodes, 0.25 - 2.0**-20)
    assert touching == apart + 8 * 2 + 5 * 5 - 4  # all but opposite sides, which are one apart


@pytest.mark.parametrize("spacing", [0.0, 0.125, 0.25])
def test_many_equal_coordinates(spacing):
    """A lattice has the same lowest coordinate many times, on all axes, and points that coincide."""
    mesh = grid_cloth(4, 5, 0.75, 1.0)
    whole = together(*(replace(mesh, nodes=np.add(mesh.nodes, (0.0, 0.0, spacing * layer))) for layer in range(3)))
    for margin in (0.0, 0.125, 0.25):
        assert compared(contact_surface(whole, []), whole.nodes, whole.nodes, margin) > 100


@pytest.mark.parametrize("stretch", [1.0, 20.0])
def test_many_boxes(rng, stretch):
    """A cloth of a thousand faces over a box of a few: those lie in cells, not in a sweep; some may be far larger."""
    cloth = grid_cloth(24, 24, 0.5, 0.5)
    obstacles = [box((-0.2, -0.2, -0.2), (0.15, 0.2, -0.01))]
    surface = contact_surface(cloth, obstacles, all_edges=True)
    points = np.concatenate([cloth.nodes, obstacles[0].nodes])
    points[: len(cloth.nodes)] += rng.normal(size=cloth.nodes.shape) * [0.02, 0.02, 0.02]
    ends = points.copy()
    ends[: len(cloth.nodes)] += 0.01 * rng.normal(size=cloth.nodes.shape)
    ends[:40] += 0.01 * (stretch - 1) * rng.normal(size=(40, 3))
    point_face, edge_edge = candidates(surface, points, ends, MARGIN)
    for found, one, other in (
        (point_face, surface.points[:, None], surface.faces),
        (edge_edge, surface.edges, surface.edges),
    ):
        (low, high), (other_low, other_high) = (
            (np.minimum(points, ends)[of].min(axis=1), np.maximum(points, ends)[of].max(axis=1)) for of in (one, other)
        )
        hits = ((low[:, None] <= other_high + MARGIN) & (other_low <= high[:, None] + MARGIN)).all(axis=-1)
        wanted = {
            (a, b)
            for a, b in np.argwhere(hits).tolist()
            if (one is not other or a < b) and twin.may_touch(surface, one[a].tolist(), other[b].tolist())
        }
        assert {tuple(sorted(pair) if one is other else pair) for pair in found[:, :2].tolist()} == wanted
        assert len(found) == len(wanted) > 1000


@pytest.mark.parametrize("side", [5, 24])
@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_what_is_not_finite_does_no_harm(side, wrong):
    surface = contact_surface(grid_cloth(side, side, 0.5, 0.5), [])
    for points in (np.full((side * side, 3), wrong), grid_cloth(side, side, 0.5, 0.5).nodes):
        points[0] = wrong
        for found in candidates(surface, points, points, MARGIN):
            assert (found >= 0).all()
            assert found.max(initial=0) < len(surface.edges)


def test_nothing_can_touch():
    mesh = grid_cloth(2, 2, 1.0, 1.0)
    surface = contact_surface(mesh, [], touches_itself=False)
    assert compared(surface, mesh.nodes, mesh.nodes, 1.0) == 0
    assert compared(contact_surface(mesh, []), mesh.nodes, mesh.nodes, 1.0) == 2 + 2  # opposite corners and sides


def test_corners_of_pairs():
    surface, _ = crumpled(np.random.default_rng(0))
    assert corners_of(surface, 1, 3, 7) == (*surface.edges[3], *surface.edges[7])
    assert corners_of(surface, 0, 3, 7) == (surface.points[3], *surface.faces[7])


def test_candidates_agree_with_another_library(rng):
    """On a cloth alone; it enlarges each box by the margin's half, too."""
    ipctk = pytest.importorskip("ipctk")
    mesh = grid_cloth(6, 6, 0.3, 0.3)
    surface = contact_surface(mesh, [])
    start = mesh.nodes + rng.normal(size=mesh.nodes.shape) * [0.05, 0.05, 0.02]
    end = start + 0.02 * rng.normal(size=start.shape)
    theirs = ipctk.CollisionMesh(start, surface.edges.astype(np.int32), surface.faces.astype(np.int32))
    listed = ipctk.Candidates()
    listed.build(theirs, np.asfortranarray(start), np.asfortranarray(end), 0.5 * MARGIN, ipctk.BruteForce())
    point_face, edge_edge = candidates(surface, start, end, MARGIN)
    assert {tuple(pair) for pair in point_face[:, :2].tolist()} == {(c.vertex_id, c.face_id) for c in listed.fv_candidates}
    expected = {tuple(sorted((c.edge0_id, c.edge1_id))) for c in listed.ee_candidates}
    assert {tuple(sorted(pair)) for pair in edge_edge[:, :2].tolist()} == expected
    assert len(expected) > 100
