"""Pairs between the simulated surface and recorded points, by brute force; and what they say of a motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfacePoints, SurfaceSampler
from diffcloud.clouds.visibility import seen_places
from diffcloud.fit.matching import Pairs, nearest_places, pairs_forth
from diffcloud.fit.targets import LostPixels
from diffcloud.mesh.shapes import grid_cloth


@pytest.fixture
def sheet(generator):
    """A wavy 5 x 5 cloth at two frames [1, 2, 25, 3], and its faces."""
    mesh = grid_cloth(5, 5, 0.4, 0.4)
    nodes = torch.as_tensor(mesh.nodes, dtype=torch.float64)[None, None].expand(1, 2, -1, -1).clone()
    nodes[..., 2] += 0.05 * torch.sin(12 * nodes[..., 0])
    nodes[:, 1] += 0.02 * torch.randn(nodes[:, 1].shape, generator=generator, dtype=torch.float64)
    return nodes, torch.as_tensor(mesh.faces)


def test_the_nearest_place_on_a_surface_is_trimeshs(sheet, generator):
    nodes, faces = sheet
    queries = nodes.mean(2, keepdim=True) + 0.2 * torch.randn(1, 2, 200, 3, generator=generator, dtype=torch.float64)
    found, _ = nearest_places(nodes, faces, queries)
    assert bool((found.barycentric >= -1e-12).all())
    torch.testing.assert_close(found.barycentric.sum(-1), torch.ones(1, 2, 200, dtype=torch.float64))
    for frame in range(2):
        mesh = trimesh.Trimesh(nodes[0, frame].numpy(), faces.numpy(), process=False)
        expected, _, _ = trimesh.proximity.closest_point_naive(mesh, queries[0, frame].numpy())
        np.testing.assert_allclose(found.of(nodes)[0, frame].numpy(), expected, atol=1e-9)


def test_a_guess_changes_no_nearest_place(sheet, generator):
    nodes, faces = sheet
    queries = nodes.mean(2, keepdim=True) + 0.2 * torch.randn(1, 2, 200, 3, generator=generator, dtype=torch.float64)
    found, there = nearest_places(nodes, faces, queries)
    for guesses in (there, torch.randint(len(faces), there.shape, generator=generator), torch.zeros_like(there)):
        again, _ = nearest_places(nodes, faces, queries, guesses)
        torch.testing.assert_close(again.of(nodes), found.of(nodes), rtol=0.0, atol=1e-15)


def test_a_place_on_several_faces_belongs_to_the_first_of_them(sheet, generator):
    """Whatever the guess, the other meshes, and the last digit of the query."""
    nodes, faces = sheet
    corners = nodes + 0.0
    corners[..., 2] -= 0.1 * (corners[..., :2] - corners[..., :2].mean(2, keepdim=True)).square().sum(-1)  # a dome's rim
    queries = torch.cat([corners + torch.tensor([0.3, 0.1, 0.2]), corners], dim=2)  # beside its rim, and on its corners
    found, there = nearest_places(corners, faces, queries)
    on_corner = (found.barycentric.amax(-1) > 1 - 1e-9) & (torch.arange(50) >= 25)
    assert int(on_corner.sum()) == 50
    first = torch.stack([(faces == node).any(-1).nonzero()[0, 0] for node in range(25)])
    assert bool((there[:, :, 25:] == first).all())
    for _ in range(5):
        guesses = torch.randint(len(faces), there.shape, generator=generator)
        near = queries + 1e-15 * torch.randn(queries.shape, generator=generator, dtype=torch.float64)
        assert torch.equal(nearest_places(corners, faces, near, guesses)[1], there)
        assert torch.equal(nearest_places(corners[:, 1:], faces, near[:, 1:])[1], there[:, 1:])


def test_faces_without_area_have_a_nearest_place():
    corners = torch.zeros(1, 1, 3, 3, dtype=torch.float64)
    corners[..., 1, 0] = corners[..., 2, 0] = 1.0
    queries = torch.tensor([[[[0.5, 1.0, 0.0], [-1.0, 0.0, 0.0], [3.0, 0.0, 1.0]]]], dtype=torch.float64)
    found = nearest_places(corners, torch.tensor([[0, 1, 2]]), queries)[0].of(corners)
    torch.testing.assert_close(found[0, 0, :, 0], torch.tensor([0.5, 0.0, 1.0], dtype=torch.float64))


def test_normals_are_those_of_the_faces(sheet, generator):
    nodes, faces = sheet
    places = SurfaceSampler.build(faces, 50, generator=generator).draw(nodes)
    corners = places.corners(nodes)
    normals = places.normals(nodes)
    torch.testing.assert_close(normals.norm(dim=-1), torch.ones(1, 2, 50, dtype=torch.float64))
    for corner in (1, 2):
        edge = corners[..., corner, :] - corners[..., 0, :]
        assert float((edge * normals).sum(-1).abs().max()) < 1e-12


def at_points(moved):
    """Places that are points by themselves: each its own node."""
    nodes = torch.arange(moved.shape[2]).reshape(1, 1, -1, 1).expand(*moved.shape[:3], 3)
    return SurfacePoints(nodes, torch.full_like(moved, 1 / 3))


class TestForth:
    def test_below_the_cut_nothing_counts(self, generator):
        moved = torch.rand(2, 1, 40, 3, generator=generator, dtype=torch.float64)
        clouds = [NeighbourIndex(torch.rand(30, 3, generator=generator, dtype=torch.float64))]
        pairs, _ = pairs_forth(at_points(moved), moved, clouds, cut=0.4, share=1.0)
        assert torch.equal(pairs.weights > 0, moved[..., 2] >= 0.4)
        torch.testing.assert_close(pairs.weights.sum((1, 2)), torch.ones(2, dtype=torch.float64))

    def test_the_partner_is_the_nearest(self, generator):
        moved = torch.rand(2, 2, 40, 3, generator=generator, dtype=torch.float64)
        clouds = [NeighbourIndex(torch.rand(30, 3, generator=generator, dtype=torch.float64)) for _ in range(2)]
        pairs, _ = pairs_forth(at_points(moved), moved, clouds, cut=None, share=0.5)
        for frame, cloud in enumerate(clouds):
            expected = torch.cdist(moved[:, frame], cloud.points.expand(2, -1, -1)).amin(-1)
            torch.testing.assert_close((moved[:, frame] - pairs.partners[:, frame]).norm(dim=-1), expected)


def some_pairs(generator, *, count=30):
    moved, partners = torch.rand(2, 2, 3, count, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(torch.randn(moved.shape, generator=generator, dtype=torch.float64), dim=-1)
    weights = torch.rand(moved.shape[:3], generator=generator, dtype=torch.float64)
    return moved, Pairs(at_points(moved), partners, normals, torch.full((3,), 0.1, dtype=torch.float64), weights, 1.0)


class TestTerms:
    @pytest.mark.parametrize("cap", [0.5, torch.inf])
    def test_the_slope_is_half_of_the_gradient(self, generator, cap):
        moved, pairs = some_pairs(generator)
        rates = torch.randn(4, *moved.shape, generator=generator, dtype=torch.float64)
        loss, slope, _ = pairs.terms(moved, rates, cap)
        leaf = moved.clone().requires_grad_()
        found = pairs.losses(leaf, cap).sum(-1)
        (gradient,) = torch.autograd.grad(found.sum(), leaf)
        torch.testing.assert_close(loss, found.detach())
        torch.testing.assert_close(2 * slope, torch.einsum("kblni,blni->bk", rates, gradient))

    def test_the_curvature_is_between_sliding_and_being_bound(self, generator):
        """A move along the normal counts in full, one along the surface less, and never more than if bound to a point."""
        moved, pairs = some_pairs(generator)
        rates = torch.randn(3, *moved.shape, generator=generator, dtype=torch.float64)
        _, _, curvature = pairs.terms(moved, rates, torch.inf)
        bound = torch.einsum("jblni,kblni,bln->bjk", rates, rates, pairs.weights)
        assert bool((torch.linalg.eigvalsh(bound - curvature) > 0).all())
        assert bool((torch.linalg.eigvalsh(curvature) > 0).all())
        along = pairs.normals[None]
        _, _, whole = pairs.terms(moved, along, torch.inf)
        torch.testing.assert_close(whole[:, 0, 0], pairs.weights.sum((1, 2)))

    def test_what_is_farther_than_the_cap_draws_at_nothing(self, generator):
        moved, pairs = some_pairs(generator)
        rates = torch.randn(2, *moved.shape, generator=generator, dtype=torch.float64)
        loss, slope, curvature = pairs.terms(moved, rates, 1e-6)
        torch.testing.assert_close(loss, 1e-12 * pairs.weights.sum((1, 2)))
        assert float(slope.abs().max()) == float(curvature.abs().max()) == 0.0


def test_positions_that_are_no_numbers_have_some_place(sheet):
    nodes, faces = sheet
    queries = torch.full((1, 2, 3, 3), torch.nan, dtype=torch.float64)
    found, _ = nearest_places(nodes, faces, queries)
    torch.testing.assert_close(found.barycentric.sum(-1), torch.ones(1, 2, 3, dtype=torch.float64))


class TestSeen:
    """A square screen of 20 cm lies level 10 cm above another."""

    @pytest.fixture
    def screens(self):
        corners = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=torch.float64) * 0.1
        nodes = torch.cat([corners, corners + torch.tensor([0, 0, 0.1])])[None, None]
        faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        return nodes, torch.cat([faces, faces + 4])

    def seen(self, screens, points, eyes, near=0.005):
        nodes, faces = screens
        found = seen_places(nodes, faces, torch.tensor([[points]]).double(), torch.tensor([eyes]).double(), near=near)
        return found[0, 0].tolist()

    def test_from_above_only_the_upper_one(self, screens):
        points = [[0.02, 0.03, 0.0], [0.02, 0.03, 0.1]]
        assert self.seen(screens, points, [[0.0, 0.0, 1.0]]) == [False, True]

    def test_from_below_only_the_lower_one(self, screens):
        points = [[0.02, 0.03, 0.0], [0.02, 0.03, 0.1]]
        assert self.seen(screens, points, [[0.0, 0.0, -1.0]]) == [True, False]

    def test_two_cameras_see_what_either_does(self, screens):
        points = [[0.02, 0.03, 0.0], [0.02, 0.03, 0.1], [0.02, 0.03, 0.05]]
        assert self.seen(screens, points, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]) == [True, True, False]

    def test_from_the_side_past_the_rim(self, screens):
        assert self.seen(screens, [[0.0, 0.0, 0.05]], [[1.0, 0.0, 0.05]]) == [True]

    def test_an_eye_between_is_not_hidden_by_what_lies_behind_it(self, screens):
        assert self.seen(screens, [[0.0, 0.01, 0.0]], [[0.0, 0.0, 0.05]]) == [True]

    def test_a_layer_that_lies_on_it_does_not_hide_a_point(self, screens):
        points = [[0.02, 0.03, 0.097]]
        assert self.seen(screens, points, [[0.0, 0.0, 1.0]], near=0.005) == [True]
        assert self.seen(screens, points, [[0.0, 0.0, 1.0]], near=0.001) == [False]

    def test_a_blind_camera_sees_nothing(self, screens):
        nodes, faces = screens
        points, eyes = torch.tensor([[[[0.02, 0.03, 0.0], [0.02, 0.03, 0.1]]]]), torch.tensor([[[0.0, 0, 1], [0.0, 0, -1]]])
        for blind, expected in (([1, 0], [True, False]), ([0, 1], [False, True]), ([1, 1], [False, False])):
            unable = torch.tensor(blind, dtype=torch.bool).expand(1, 1, 2, 2)
            found = seen_places(nodes, faces, points.double(), eyes.double(), near=0.005, blind=unable)
            assert found[0, 0].tolist() == expected

    def test_lost_pixels_blind_a_camera(self):
        """It looks down from a metre; one column of its three is lost, in the second frame alone."""
        pose = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1]], dtype=torch.float64)
        pixels = torch.zeros(2, 3, 3, dtype=torch.bool)
        pixels[1, :, 2] = True
        lost = LostPixels(pose, torch.tensor([[10.0, 10.0], [1.0, 1.0]], dtype=torch.float64), pixels)
        points = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0.2, 0, 0], [0.0, 0, 2.0], [-0.14, 0.14, 0]])
        points = torch.cat([points, torch.full((1, 3), torch.nan)])  # of a motion that diverged
        found = lost.blind(points.double().expand(1, 2, -1, -1))
        assert found[0].tolist() == [[False] * 3 + [True, True, False, True], [False, True, True, True, True, False, True]]

    def test_by_brute_force(self, sheet, generator):
        nodes, faces = sheet
        points = nodes.mean(2, keepdim=True) + 0.1 * torch.randn(1, 2, 80, 3, generator=generator, dtype=torch.float64)
        eyes = torch.tensor([[[1.0, 0.2, 0.6], [-0.8, 0.3, 0.5]]], dtype=torch.float64)
        found = seen_places(nodes, faces, points, eyes, near=0.005)
        for frame in range(2):
            mesh = trimesh.Trimesh(nodes[0, frame].numpy(), faces.numpy(), process=False)
            for index, point in enumerate(points[0, frame].numpy()):
                assert bool(found[0, frame, index]) == any(not blocked(mesh, point, eye) for eye in eyes[0].numpy())


def blocked(mesh, point, eye, *, near=0.005):
    """Whether a face of the mesh crosses the line of sight, by solving for each plane and place."""
    for a, b, c in mesh.triangles:
        try:
            t, v, w = np.linalg.solve(np.stack([eye - point, a - b, a - c], axis=1), a - point)
        except np.linalg.LinAlgError:
            continue
        if near / np.linalg.norm(eye - point) < t < 1 and v >= 0 and w >= 0 and v + w <= 1:
            return True
    return False
