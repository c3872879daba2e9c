"""Continuous detection against polynomial roots, dense sampling in time, and central differences."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from diffcloud.sim.contact.frames import MeetingPairs
from diffcloud.sim.contact.impact_times import coplanarity, coplanarity_cubic, first_impacts, meeting_time, unit_roots


def random_pairs(count: int, generator: torch.Generator) -> MeetingPairs:
    index = torch.arange(count)
    points = (4 * index)[:, None] + torch.arange(4)
    kind = torch.randint(0, 2, (count,), generator=generator)
    return MeetingPairs(kind, torch.zeros_like(index), points, points[:, :2], torch.ones(count, dtype=torch.float64))


@pytest.fixture
def motion(generator):
    start = torch.randn(2000, 4, 3, dtype=torch.float64, generator=generator)
    return start, start + 1.5 * torch.randn(2000, 4, 3, dtype=torch.float64, generator=generator)


def test_roots_are_those_of_the_polynomial(rng):
    cubic = rng.normal(size=(500, 4))
    cubic[:100, 3] = 0.0  # quadratic
    cubic[100:200, 2:] = 0.0  # linear
    cubic[200:250, 3] *= 1e-14  # nearly quadratic
    found = unit_roots(torch.as_tensor(cubic)).numpy()
    for coefficients, roots in zip(cubic, found, strict=True):
        expected = np.roots(np.trim_zeros(coefficients[::-1], "f"))
        expected = np.sort(expected[np.isreal(expected)].real)
        expected = expected[(expected >= 0) & (expected <= 1)]
        np.testing.assert_allclose(np.unique(roots[np.isfinite(roots)]), expected, atol=1e-9)


def test_special_cubics():
    cubic = torch.tensor(
        [
            [0.0, 0.0, 0.0, 0.0],  # coplanar throughout: met at once
            [0.0, 1.0, 0.0, 0.0],  # at the start
            [-1.0, 1.0, 0.0, 0.0],  # at the end
            [1.0, 0.0, 0.0, 0.0],  # never
            [-0.06, 0.56, -1.5, 1.0],  # (t - 0.2)(t - 0.3)(t - 1)
        ],
        dtype=torch.float64,
    )
    roots = unit_roots(cubic)
    assert roots[0, 0] == 0
    assert roots[1, 0] == 0
    assert roots[2, 0] == 1
    assert not torch.isfinite(roots[3]).any()
    torch.testing.assert_close(roots[4], torch.tensor([0.2, 0.3, 1.0], dtype=torch.float64), atol=1e-9, rtol=0)


def test_cubic_is_the_volume(motion, generator):
    start, end = motion
    pairs = random_pairs(len(start), generator)
    cubic = coplanarity_cubic(pairs, start, end)
    for time in (0.0, 0.3, 1.0):
        powers = torch.tensor([1, time, time**2, time**3], dtype=torch.float64)
        torch.testing.assert_close(cubic @ powers, coplanarity(pairs, start + time * (end - start)))


def test_first_impact_agrees_with_dense_sampling(motion, generator):
    """A twin without algebra: the volume changes its sign between two samples while the places are on both primitives."""
    start, end = motion
    pairs = random_pairs(len(start), generator)
    found, time = first_impacts(pairs, start, end, 0.0)
    samples = 2001
    times = torch.linspace(0, 1, samples, dtype=torch.float64)
    expected = torch.full((len(start),), torch.inf, dtype=torch.float64)
    before = coplanarity(pairs, start)
    for low, high in itertools.pairwise(times):
        now = coplanarity(pairs, start + high * (end - start))
        middle = pairs.frames(start + 0.5 * (low + high) * (end - start)).weights
        hit = (before.sign() != now.sign()) & pairs.covers(middle, 0.0) & torch.isinf(expected)
        expected[hit] = 0.5 * (low + high)
        before = now
    got = torch.full_like(expected, torch.inf)
    got[found] = time
    agree = (got - expected).abs() < 1.0 / samples
    agree |= torch.isinf(got) & torch.isinf(expected)
    # sampling misses two roots between two samples, and errs on places within a sample of a border
    assert (~agree).sum() <= 0.005 * len(start)
    assert len(found) > 150


def test_impact_time_has_the_derivative_of_the_root(motion, generator):
    start, end = motion
    pairs = random_pairs(len(start), generator)
    found, _ = first_impacts(pairs, start, end, 0.0)
    pairs, start, end = pairs.where(found[:50]), start[found[:50]], end[found[:50]]
    _, time = first_impacts(pairs, start, end, 0.0)
    direction = torch.randn(start.shape, dtype=torch.float64, generator=generator)
    h = 1e-6

    def moved(step: float) -> torch.Tensor:
        roots = unit_roots(coplanarity_cubic(pairs, start + step * direction, end - step * direction))
        return roots.gather(1, (roots - time[:, None]).abs().argmin(1, keepdim=True)).squeeze(1)

    tracked = torch.zeros((), dtype=torch.float64, requires_grad=True)
    value = meeting_time(pairs, time, start + tracked * direction, end - tracked * direction)
    torch.testing.assert_close(value, time)
    expected = (moved(h) - moved(-h)) / (2 * h)
    for index in range(len(time)):
        (slope,) = torch.autograd.grad(value[index], tracked, retain_graph=True)
        assert float(slope) == pytest.approx(float(expected[index]), rel=1e-4, abs=1e-6)
