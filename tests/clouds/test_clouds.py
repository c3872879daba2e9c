"""Sampling, neighbours and Chamfer distances against brute force and exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from diffcloud.clouds import NeighbourIndex, SurfaceSampler, chamfer, one_sided_chamfer
from diffcloud.errors import ConfigError, EpisodeError
from diffcloud.mesh import grid_cloth

BOTH_TYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def naive_one_sided(source, target):
    """The definition, as loops."""
    return sum(min(float(((s - t) ** 2).sum()) for t in target) for s in source) / len(source)


@pytest.fixture
def faces():
    return torch.as_tensor(grid_cloth(4, 5, 0.3, 0.4).faces)


@pytest.fixture
def positions(rng):
    nodes = grid_cloth(4, 5, 0.3, 0.4).nodes
    return torch.as_tensor(nodes + 0.02 * rng.normal(size=(2, *nodes.shape)))


class TestSampling:
    def test_points_lie_on_their_faces_in_proportion_to_area(self, faces, generator):
        nodes = torch.tensor([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 5], [1, 0, 5], [0, 1, 5.0]], dtype=torch.float64)
        two = torch.tensor([[0, 1, 2], [3, 4, 5]])  # areas 3 : 1
        points = SurfaceSampler.build(two, 4000, generator=generator).sample(nodes)
        upper = points[:, 2] > 2.5
        assert int(upper.sum()) == pytest.approx(1000, abs=2)  # stratified: each face gets its share
        low = points[~upper]
        assert ((low[:, 0] >= 0) & (low[:, 1] >= 0) & (low[:, 0] / 3 + low[:, 1] <= 1 + 1e-12)).all()
        # uniform on the triangle: the mean is the centroid
        np.testing.assert_allclose(low.mean(0), [1.0, 1 / 3, 0.0], atol=0.05)

    def test_gradient_is_the_barycentric_weights(self, faces, positions, generator):
        sampler = SurfaceSampler.build(faces, 50, generator=generator)
        tracked = positions[0].clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(sampler.sample(tracked)[:, 1].sum(), tracked)
        assert float(gradient[:, 1].sum()) == pytest.approx(50)
        assert (gradient[:, [0, 2]] == 0).all()
        assert torch.autograd.gradcheck(sampler.sample, (tracked,), eps=1e-7, atol=1e-5)

    def test_same_seed_same_points_and_any_leading_shape(self, faces, positions):
        draw = [SurfaceSampler.build(faces, 30, generator=torch.Generator().manual_seed(3)) for _ in range(2)]
        both = draw[0].sample(positions[:, None].expand(-1, 3, -1, -1))
        assert both.shape == (2, 3, 30, 3)
        torch.testing.assert_close(both[1, 2], draw[1].sample(positions[1]))

    def test_a_subset_chooses_faces(self, faces, positions, generator):
        subset = torch.tensor([3, 7])
        allowed = set(faces[subset].flatten().tolist())
        sampler = SurfaceSampler.build(faces, 40, generator=generator, subset=subset)
        tracked = positions[0].clone().requires_grad_(True)
        (gradient,) = torch.autograd.grad(sampler.sample(tracked).sum(), tracked)
        assert set(gradient.abs().sum(-1).nonzero().flatten().tolist()) <= allowed

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"points": 0}, "At least one point"),
            ({"points": 5, "subset": torch.tensor([99])}, "face subset"),
            ({"points": 5, "subset": torch.tensor([], dtype=torch.long)}, "face subset"),
        ],
    )
    def test_bad_options(self, faces, generator, options, message):
        with pytest.raises(ConfigError, match=message):
            SurfaceSampler.build(faces, generator=generator, **options)


class TestNeighbours:
    @pytest.mark.parametrize(
        ("points", "message"),
        [(torch.zeros(0, 3), "at least one point"), (torch.zeros(4, 2), "shape"), (torch.full((4, 3), torch.nan), "NaN")],
    )
    def test_bad_targets(self, points, message):
        with pytest.raises(EpisodeError, match=message):
            NeighbourIndex(points)


class TestChamfer:
    @BOTH_TYPES
    def test_one_sided_is_the_definition(self, rng, dtype):
        source, target = (torch.as_tensor(rng.normal(size=(n, 3)), dtype=dtype) for n in (17, 23))
        found = one_sided_chamfer(source, NeighbourIndex(target))
        assert found.dtype == dtype
        assert float(found) == pytest.approx(naive_one_sided(source, target), rel=1e-5)
        assert float(one_sided_chamfer(target[:5], NeighbourIndex(target))) == 0.0

    def test_two_sided_ragged_batch(self, rng):
        sources = torch.as_tensor(rng.normal(size=(3, 11, 3)))
        targets = [torch.as_tensor(rng.normal(size=(n, 3))) for n in (4, 9, 20)]
        found = chamfer(sources, [NeighbourIndex(t) for t in targets])
        expected = [naive_one_sided(s, t) + naive_one_sided(t, s) for s, t in zip(sources, targets, strict=True)]
        np.testing.assert_allclose(found.numpy(), expected, rtol=1e-12)

    def test_gradients_are_exact_on_both_sides(self, rng):
        source = torch.as_tensor(rng.normal(size=(1, 9, 3))).requires_grad_(True)
        target = torch.as_tensor(rng.normal(size=(7, 3))).requires_grad_(True)
        assert torch.autograd.gradcheck(lambda s: one_sided_chamfer(s, NeighbourIndex(target.detach())), (source,))
        assert torch.autograd.gradcheck(lambda s, t: chamfer(s, [NeighbourIndex(t)]), (source, target))

    def test_batched_one_sided_is_each_alone(self, rng):
        sources, target = (
            torch.as_tensor(rng.normal(size=(4, 30, 3))),
            NeighbourIndex(torch.as_tensor(rng.normal(size=(40, 3)))),
        )
        together = one_sided_chamfer(sources, target)
        torch.testing.assert_close(together, torch.stack([one_sided_chamfer(s, target) for s in sources]))
