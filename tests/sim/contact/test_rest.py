"""Pairs that are near at rest against distances measured in the plane, and fine meshes that fold on themselves."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.compiled import kernel
from diffcloud.mesh import grid_cloth
from diffcloud.mesh.shapes import loop_cloth
from diffcloud.scene.scenarios.grid import FOLD, LIFT, grid_scenario
from diffcloud.scene.scenarios.sheet import Sheet
from diffcloud.sim.contact.places import places
from diffcloud.sim.contact.rest import CREASE, near_at_rest
from diffcloud.sim.implicit.build import build_scene
from diffcloud.sim.implicit.room import room_around
from diffcloud.sim.implicit.scene import new_work
from diffcloud.sim.materials import preset
from diffcloud.sim.simulate import rollout
from diffcloud.sim.surrounding import ContactSettings, Surrounding
from tests.sim.contact.penetration import _edge_edge_distance, _point_face_distance, minimal_distance
from tests.sim.twins.forces import Forces

LONGER = 1.09
"""Paths through nodes and the middles of edges are at most so many times as long as straight ones, on these meshes."""


def pairs_of(lists) -> set[tuple[int, int]]:
    rows = np.repeat(np.arange(len(lists.starts) - 1), np.diff(lists.starts))
    return set(zip(rows.tolist(), lists.members.tolist(), strict=True))


def distances_in_the_plane(mesh, shifts=((0.0, 0.0),)) -> tuple[np.ndarray, np.ndarray]:
    """([V, F], [E, E]) of nodes and faces, and of edges, in material space; the least over periods of it."""
    edges, _ = mesh.edges
    at = np.pad(mesh.verts, ((0, 0), (0, 1)))
    vert = np.zeros(len(mesh.nodes), np.int64)
    vert[mesh.vert_node] = np.arange(len(mesh.verts))
    corners = at[mesh.face_verts]
    half = {
        tuple(sorted(mesh.faces[f, [a, (a + 1) % 3]])): corners[f, [a, (a + 1) % 3]]
        for f in range(len(mesh.faces))
        for a in range(3)
    }
    ends = np.array([half[tuple(sorted(edge))] for edge in edges.tolist()])
    to_faces, to_edges = [], []
    for shift in shifts:
        moved = np.array([*shift, 0.0])
        i, j = (index.ravel() for index in np.indices((len(mesh.nodes), len(corners))))
        to_faces.append(_point_face_distance(at[vert[i]] + moved, corners[j]).reshape(len(mesh.nodes), -1))
        i, j = (index.ravel() for index in np.indices((len(edges), len(edges))))
        to_edges.append(_edge_edge_distance(ends[i] + moved, ends[j]).reshape(len(edges), -1))
    return np.min(to_faces, axis=0), np.min(to_edges, axis=0)


def assert_near(mesh, distance: float, shifts=((0.0, 0.0),)) -> None:
    near = near_at_rest(mesh, distance)
    for found, true in zip((near.faces, near.edges), distances_in_the_plane(mesh, shifts), strict=True):
        listed = pairs_of(found)
        if found is near.edges:
            true = np.where(np.triu(np.ones_like(true), 1) > 0, true, np.inf)
        sure, possible = (set(zip(*np.nonzero(true < limit), strict=True)) for limit in (distance / LONGER, distance))
        assert sure <= listed <= possible
        assert len(sure) > len(true)


@pytest.mark.parametrize("through", [0, 1])
@pytest.mark.parametrize("shape", [(8, 8), (6, 11)])
@pytest.mark.parametrize("times", [0.8, 1.2, 2.3])
def test_near_pairs_are_those_that_are_near_in_the_plane(shape, through, times):
    mesh = grid_cloth(*shape, 0.07, 0.09, through=through)
    assert_near(mesh, times * 0.07 / (shape[0] - 1))


def test_distances_go_round_a_closed_band_where_its_ends_are_sewn_together():
    """The band is closed: nodes on both sides of its seam are near, though they are far apart in material space."""
    mesh = loop_cloth(4, 24, 0.02, 0.24)
    assert_near(mesh, 0.025, shifts=((0.0, 0.0), (0.24, 0.0), (-0.24, 0.0)))


def test_a_mesh_whose_faces_are_taller_than_the_distance_has_no_near_pairs():
    mesh = grid_cloth(7, 7, 0.2625, 0.2625)
    near = near_at_rest(mesh, CREASE * 0.003)
    assert len(near.faces.members) == len(near.edges.members) == 0
    assert len(near.faces.starts) == len(mesh.nodes) + 1
    assert len(near.edges.starts) == len(mesh.edges[0]) + 1


@kernel
def _pairs_at_rest(scene, parameters, points):
    work = new_work(scene, parameters, len(points), 0)
    return len(room_around(work, points, points).pairs)


@kernel
def _touching_at(scene, parameters, points):
    """How many places touch at points, all of pairs that are near at rest."""
    work = new_work(scene, parameters, len(points), 0)
    room = room_around(work, points, points)
    listed, numbers = places(work.surface, work.planes, work.law, room.pairs, room.distances, points, work.holder)
    count = 0
    for e in range(len(listed)):
        if numbers[e, 0] != 0 and numbers[e, 1] == -1:
            count += 1
    return count


@pytest.mark.parametrize("side", [13, 33, 64])
def test_a_flat_cloth_at_rest_has_no_contact_with_itself(side):
    """Half a diagonal of the finest one is shorter than the contact thickness, and twice the edges of the second one
    within two thicknesses."""
    lift = grid_scenario(LIFT.model_copy(update={"nodes": (side, side)})).scene
    cloth = Forces(lift.mesh, lift.material, lift.surrounding)
    scene = build_scene(cloth.system.setup, 0.0125)
    assert bool(len(scene.surface.rest_faces)) == bool(len(scene.surface.rest_edges)) == (side == 64)
    assert _pairs_at_rest(scene, cloth.parameters, np.ascontiguousarray(lift.mesh.nodes)) == 0


@pytest.mark.slow
@pytest.mark.parametrize("self_contact", [True, False])
def test_a_fold_of_a_mesh_finer_than_the_thickness_keeps_its_layers_apart(self_contact):
    """Half a diagonal is 2.8 mm, the thickness 3 mm. Away from the crease layers rest on each other, a good part of the
    thickness apart; without contact they lie in each other."""
    side, scale = 0.08, 0.08 / 0.2625
    supple = Sheet(density_kg_m2=0.3, stretching_n_m=60.0, bending_n_m=1e-6)
    options = {"size_m": (side, side), "nodes": (21, 21), "self_contact": self_contact, "material": supple}
    options |= {"grip": "pivot", "grip_m": 0.001}  # a pad that is not turned over would press on the layer below
    path = [(0.0, 0.0, 0.0, 0.0), (1.25, 0.0, 0.12 * scale, 0.26 * scale), (2.5, 0.0, 0.28 * scale, 0.006)]
    scenario = grid_scenario(FOLD.model_copy(update={**options, "path": path}))
    system, _ = scenario.scene.build()
    assert system.setup.surrounding.contact.repulsion_thickness > system.mesh.smallest_height
    nodes = rollout(system, scenario.steps).positions[0].numpy()
    along = (nodes[0] - nodes[0].mean(axis=0))[:, 1][system.mesh.faces]  # the fold goes along +y
    upper, lower = (system.mesh.faces[(sign * along > 0.008).all(axis=1)] for sign in (-1, 1))
    apart = minimal_distance((nodes[-1], upper), (nodes[-1], lower))
    assert apart > 1e-3 if self_contact else apart < 1e-4


@pytest.mark.parametrize("squeezed", [1.0, 0.6, 0.3])
def test_what_is_near_at_rest_repels_only_when_it_is_squeezed(squeezed):
    """A flat cloth whose half diagonals are below the thickness: no force at rest, nor at three fifths of its size. Below
    half, the thickness of near pairs, there is one."""
    mesh = grid_cloth(6, 6, 0.02, 0.02)
    cloth = Forces(mesh, preset("soft-knit"), Surrounding(contact=ContactSettings(1e4, 0.003, 3e-4)))
    scene = build_scene(cloth.system.setup, 0.0125)
    assert scene.law[1, 1] == pytest.approx(0.5 * 0.004 / 2**0.5)
    touching = _touching_at(scene, cloth.parameters, np.ascontiguousarray(squeezed * mesh.nodes))
    assert bool(touching) == (squeezed < 0.5)
