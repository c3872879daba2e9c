"""Pairs between the simulated surface and recorded points, by brute force; and what they say of a motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.clouds.sampling import SurfacePoints
from diffcloud.clouds.visibility import seen_places
from diffcloud.estimation.matching import Motion, Pairs, nearest_places, pairs_forth
from diffcloud.estimation.pose import NUISANCE, PoseSpace
from diffcloud.estimation.targets import Crop, LostPixels
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


def sharp_crop(height, frames=1):
    """A crop of recordings without noise."""
    return Crop(height, torch.zeros(frames, dtype=torch.float64))


def at_points(moved):
    """Places that are points by themselves: each its own node."""
    nodes = torch.arange(moved.shape[2]).reshape(1, 1, -1, 1).expand(*moved.shape[:3], 3)
    return SurfacePoints(nodes, torch.full_like(moved, 1 / 3))


class TestSurface:
    """What a recorded cloud tells of the surface that it was taken from."""

    def test_normals_of_a_sphere(self, generator):
        points = torch.randn(3000, 3, generator=generator, dtype=torch.float64)
        points /= points.norm(dim=-1, keepdim=True)
        cloud = NeighbourIndex(points)
        assert float((cloud.normals * points).sum(-1).abs().min()) > 0.98
        assert cloud.spacing == pytest.approx(0.5 * math.sqrt(4 * math.pi / 3000), rel=0.1)  # of a Poisson process

    @pytest.mark.parametrize("count", [1, 2])
    def test_too_few_points_have_none(self, count):
        cloud = NeighbourIndex(torch.rand(count, 3, dtype=torch.float64))
        assert bool((cloud.normals == 0).all())
        assert cloud.spacing == 0.0
        assert cloud.from_surface == (0.0, 0.0)

    def test_how_far_points_and_their_surface_are_apart(self, generator):
        """Of a Poisson process on a plane, E|x - nearest|² = 1 / (π density); across it, the points' own noise."""
        points = torch.rand(20_000, 3, generator=generator, dtype=torch.float64)
        points[:, 2] = 1e-4 * torch.randn(20_000, generator=generator, dtype=torch.float64)
        along, across = NeighbourIndex(points).from_surface
        assert along == pytest.approx(1 / (math.pi * 20_000), rel=0.1)
        assert across**0.5 == pytest.approx(1e-4 * (1 + 1 / 12) ** 0.5, rel=0.1)


class TestCrop:
    NOISE = 0.002

    def weights(self, heights):
        return Crop(0.1, torch.tensor([self.NOISE**2], dtype=torch.float64)).weights(heights[None])[0]

    def test_weights_rise_from_zero_over_the_noise(self):
        above = self.NOISE * torch.tensor([-1.0, 0.0, 1e-6, 1.0, 5.0, torch.nan], dtype=torch.float64)
        expected = torch.tensor([0.0, 0.0, 0.0, 1 - math.exp(-0.5), 1.0, 0.0], dtype=torch.float64)
        torch.testing.assert_close(self.weights(0.1 + above), expected, rtol=0, atol=1e-5)

    def test_a_table_beside_the_cloth_hardly_counts(self, generator):
        """Ten times as many points lie on the table as on the cloth. Noise lifts 6 % of them above the crop."""
        table, cloth = (torch.randn(count, generator=generator, dtype=torch.float64) for count in (100_000, 10_000))
        table = self.weights(0.1 + self.NOISE * (table - 1.55))
        assert 0.05 < float((table > 0).double().mean()) < 0.07
        assert float(table.sum()) < 0.15 * float(self.weights(0.15 + self.NOISE * cloth).sum())


class TestForth:
    def test_below_the_cut_nothing_counts(self, generator):
        moved = torch.rand(2, 1, 40, 3, generator=generator, dtype=torch.float64)
        clouds = [NeighbourIndex(torch.rand(30, 3, generator=generator, dtype=torch.float64))]
        pairs, _ = pairs_forth(at_points(moved), [moved], [clouds], crop=sharp_crop(0.4), share=1.0)
        assert torch.equal(pairs.weights > 0, moved[..., 2] >= 0.4)
        torch.testing.assert_close(pairs.weights.sum((1, 2)), torch.ones(2, dtype=torch.float64))

    def test_the_partner_is_the_nearest(self, generator):
        moved = torch.rand(2, 2, 40, 3, generator=generator, dtype=torch.float64)
        clouds = [NeighbourIndex(torch.rand(30, 3, generator=generator, dtype=torch.float64)) for _ in range(2)]
        pairs, _ = pairs_forth(at_points(moved), [moved], [clouds], crop=None, share=0.5)
        for frame, cloud in enumerate(clouds):
            expected = torch.cdist(moved[:, frame], cloud.points.expand(2, -1, -1)).amin(-1)
            torch.testing.assert_close((moved[:, frame] - pairs.partners[:, frame]).norm(dim=-1), expected)


CENTRE = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
POSED = PoseSpace.build({name: 0.1 for name in NUISANCE if name != "lag"}, CENTRE, length_unit_m=1.0)


def some_motion(generator, *, count=30):
    """Two motions at three frames, whose nodes are the places themselves, at two poses."""
    moved, partners = torch.rand(2, 2, 3, count, 3, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(torch.randn(moved.shape, generator=generator, dtype=torch.float64), dim=-1)
    weights = torch.rand(moved.shape[:3], generator=generator, dtype=torch.float64)
    pairs = Pairs(at_points(moved), partners, normals, torch.full((3,), 0.1, dtype=torch.float64), weights, 1.0)
    pose = 0.1 * torch.randn(2, len(POSED.names), generator=generator, dtype=torch.float64)
    return Motion(moved, None, pose, (pairs,))


class TestTerms:
    @pytest.mark.parametrize("cap", [0.5, torch.inf])
    def test_the_slope_is_half_of_the_gradient(self, generator, cap):
        motion = some_motion(generator)
        (pairs,) = motion.pairs
        loss, slope, _ = motion.terms(POSED, cap)
        pose = motion.pose.clone().requires_grad_()
        found = pairs.losses(POSED.moved(motion.nodes, pose), cap).sum(-1)
        (gradient,) = torch.autograd.grad(found.sum(), pose)
        torch.testing.assert_close(loss, found.detach())
        torch.testing.assert_close(2 * slope, gradient)

    def test_the_curvature_is_between_sliding_and_being_bound(self, generator):
        """A move along the normal counts in full, one along the surface less, and never more than if bound to a point."""
        motion = some_motion(generator)
        (pairs,) = motion.pairs
        _, _, curvature = motion.terms(POSED, torch.inf)
        rates = POSED.rates(motion.nodes, motion.pose, None, torch.zeros_like(pairs.weights, dtype=torch.long))
        bound = torch.einsum("jblni,kblni,bln->bjk", rates, rates, pairs.weights)
        assert bool((torch.linalg.eigvalsh(bound - curvature) > 0).all())
        assert bool((torch.linalg.eigvalsh(curvature) > 0).all())
        for axis, name in enumerate("xyz"):
            along = torch.nn.functional.one_hot(torch.tensor(axis), 3).double().expand_as(pairs.partners)
            _, _, whole = replace(motion, pairs=(replace(pairs, normals=along),)).terms(POSED, torch.inf)
            own = POSED.names.index(name)
            torch.testing.assert_close(whole[:, own, own], pairs.weights.sum((1, 2)))

    def test_what_is_farther_than_the_cap_draws_at_nothing(self, generator):
        motion = some_motion(generator)
        loss, slope, curvature = motion.terms(POSED, 1e-6)
        torch.testing.assert_close(loss, 1e-12 * motion.pairs[0].weights.sum((1, 2)))
        assert float(slope.abs().max()) == float(curvature.abs().max()) == 0.0


@pytest.mark.parametrize("free", [[], ["x", "yaw"], list(NUISANCE)])
class TestTermsOfPosedFaces:
    """Places on the faces of a moving cloth, and on a body that stands still beside it, at poses."""

    BODY = 7
    """Nodes."""

    @pytest.fixture
    def motion(self, sheet, generator, free):
        wavy, faces = sheet
        cloth, body = len(wavy[0, 0]), len(wavy[0, 0]) + torch.arange(self.BODY)
        nodes = wavy.expand(3, -1, -1, -1) + 0.01 * self.randn(generator, 3, 2, cloth, 3)
        nodes = torch.cat([nodes, self.randn(generator, 3, 2, self.BODY, 3)], dim=2)
        faces = torch.cat([faces, torch.stack([body[:-2], body[1:-1], body[2:]], dim=-1)])
        chosen = faces[torch.randint(len(faces), (3, 2, 60), generator=generator)]
        places = SurfacePoints(chosen, torch.rand(60, 3, generator=generator, dtype=torch.float64).expand(3, 2, -1, -1))
        partners = nodes[:1].mean(2, keepdim=True) + 0.3 * self.randn(generator, 1, 2, 60, 3)
        weights = torch.rand(2, 60, generator=generator, dtype=torch.float64).expand(3, -1, -1)
        pairs = Pairs(places, partners.expand(3, -1, -1, -1), None, torch.tensor([0.1, 0.2]).double(), weights, 1.0)
        return Motion(nodes, self.randn(generator, *nodes.shape), 0.1 * self.randn(generator, 3, len(free)), (pairs,))

    @pytest.fixture
    def space(self, free):
        return PoseSpace.build(dict.fromkeys(free, 0.1), CENTRE, length_unit_m=1.0)

    @staticmethod
    def randn(generator, *shape):
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    @staticmethod
    def places(motion, space, nodes, pose):
        return space.moved(motion.pairs[0].places.of(replace(motion, nodes=nodes, pose=pose).shown(space)), pose)

    def columns(self, motion, space):
        """[B, L, N, 3, d] derivatives of the places in the recording by the pose."""
        found = torch.autograd.functional.jacobian(lambda pose: self.places(motion, space, motion.nodes, pose), motion.pose)
        same = range(3)  # of the batch
        return found[same, ..., same, :]

    def test_the_slope_is_half_of_the_gradient(self, motion, space):
        loss, slope, _ = motion.terms(space, 0.4)
        (pairs,) = motion.pairs
        moved = self.places(motion, space, motion.nodes, motion.pose).requires_grad_()
        found = pairs.losses(moved, 0.4).sum(-1)
        (gradient,) = torch.autograd.grad(found.sum(), moved)
        torch.testing.assert_close(loss, found.detach())
        torch.testing.assert_close(2 * slope, torch.einsum("blnik,blni->bk", self.columns(motion, space), gradient))
        assert 0 < int((gradient == 0).all(-1).sum()) < gradient[..., 0].numel()  # some are beyond the cap

    def test_they_slide_along_the_faces(self, motion, space):
        """As along stated normals that are the faces'."""
        (pairs,) = motion.pairs
        corners = pairs.places.corners(motion.shown(space))
        across = torch.linalg.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        normals = torch.nn.functional.normalize(space.carried(across, motion.pose), dim=-1)
        expected = replace(motion, pairs=(replace(pairs, normals=normals),)).terms(space, 0.4)
        for found, of in zip(motion.terms(space, 0.4), expected, strict=True):
            torch.testing.assert_close(found, of)

    def test_the_curvature_is_that_of_the_columns(self, motion, space):
        (pairs,) = motion.pairs
        normals = torch.nn.functional.normalize(torch.ones_like(pairs.partners), dim=-1)
        _, _, curvature = replace(motion, pairs=(replace(pairs, normals=normals),)).terms(space, torch.inf)
        away = self.places(motion, space, motion.nodes, motion.pose) - pairs.partners
        beside = away - (away * normals).sum(-1, keepdim=True) * normals
        beside = beside / (beside.square().sum(-1, keepdim=True) + pairs.spacing[:, None, None] ** 2).sqrt()
        columns = self.columns(motion, space)
        expected = 0.0
        for way in (normals, beside):
            along = torch.einsum("blnik,blni->blnk", columns, way)
            expected = expected + torch.einsum("blnj,blnk,bln->bjk", along, along, pairs.weights)
        torch.testing.assert_close(curvature, expected)

    def test_what_motions_and_frames_share_need_not_be_copied(self, motion, space):
        (pairs,) = motion.pairs
        shared = motion.velocities[:1, :1].expand(3, 2, -1, -1)
        partners, weights = pairs.partners[:, :1].expand(-1, 2, -1, -1), pairs.weights[:, :1].expand(-1, 2, -1)
        whole = replace(motion, velocities=shared, pairs=(replace(pairs, partners=partners, weights=weights),))
        (of,) = whole.pairs
        places = SurfacePoints(of.places.nodes.clone(), of.places.barycentric.contiguous())
        copied = replace(of, places=places, partners=of.partners.contiguous(), weights=of.weights.contiguous())
        expected = replace(whole, velocities=shared.contiguous(), pairs=(copied,)).terms(space, 0.4)
        for found, one in zip(whole.terms(space, 0.4), expected, strict=True):
            assert torch.equal(found, one)

    def test_a_frame_in_which_nothing_counts_and_positions_that_are_no_numbers_lose_as_they_do(self, motion, space):
        (pairs,) = motion.pairs
        weights = pairs.weights.clone()
        weights[0, 1] = 0.0
        nodes = motion.nodes.clone()
        nodes[1, 0, 3] = torch.nan
        motion = replace(motion, nodes=nodes, pairs=(replace(pairs, weights=weights),))
        loss, slope, _ = motion.terms(space, 0.4)
        expected = motion.pairs[0].losses(self.places(motion, space, nodes, motion.pose), 0.4).sum(-1)
        torch.testing.assert_close(loss, expected, equal_nan=True)
        assert loss.isnan().tolist() == [False, True, False]
        assert bool(slope.isfinite().all())

    def test_a_face_without_area_has_no_normal(self, motion, space):
        nodes = motion.nodes[..., :1, :].expand(motion.nodes.shape)
        _, _, curvature = replace(motion, nodes=nodes, velocities=torch.zeros_like(nodes)).terms(space, torch.inf)
        assert bool(curvature.isfinite().all())

    def test_what_does_not_belong_together_is_refused(self, motion, space, free):
        (pairs,) = motion.pairs
        with pytest.raises(AssertionError):
            replace(motion, pose=motion.pose[:1]).terms(space, 0.4)
        with pytest.raises(AssertionError):
            replace(motion, pairs=(replace(pairs, partners=pairs.partners[:2]),)).terms(space, 0.4)
        if "lag" in free:
            with pytest.raises(AssertionError):
                replace(motion, velocities=None).terms(space, 0.4)

    def test_all_pairs_count(self, motion, space):
        twice = replace(motion, pairs=(*motion.pairs, *motion.pairs)).terms(space, 0.4)
        for found, once in zip(twice, motion.terms(space, 0.4), strict=True):
            torch.testing.assert_close(found, 2 * once)


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
