"""Sampling and grouping against loops that are obviously right."""

from __future__ import annotations

import pytest
import torch

from diffcloud.errors import ConfigError
from diffcloud.regressors import grouping
from diffcloud.regressors.grouping import ball_groups, canonical_start, farthest_points, gather_points, space_time_groups


def clouds(generator, batch=3, points=40, dtype=torch.float64):
    return torch.rand(batch, points, 3, generator=generator, dtype=dtype)


def slow_start(cloud):
    middle = (cloud.amin(0) + cloud.amax(0)) / 2
    return max(range(len(cloud)), key=lambda i: (float((cloud[i] - middle).square().sum()), *cloud[i].tolist()))


def slow_farthest(cloud, count):
    chosen = [slow_start(cloud)]
    while len(chosen) < count:
        chosen.append(
            max(range(len(cloud)), key=lambda i: min(float((cloud[i] - cloud[j]).square().sum()) for j in chosen))
        )
    return chosen


def slow_group(distance, count, order):
    """Members of one ball of radius one from distances in radii, filled up with the first."""
    inside = [i for i, d in enumerate(distance) if d <= 1]
    if order == "nearest":
        inside.sort(key=lambda i: distance[i])
    inside = inside or [min(range(len(distance)), key=lambda i: distance[i])]
    return (inside + [inside[0]] * count)[:count]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_farthest_points_are_those_of_the_loop(generator, dtype):
    points = clouds(generator, dtype=dtype)
    found = farthest_points(points, 12)
    assert found.tolist() == [slow_farthest(cloud, 12) for cloud in points]


def test_the_start_depends_on_the_set_alone_even_with_ties(generator):
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)  # eight equally far from the middle
    for _ in range(5):
        order = torch.randperm(8, generator=generator)
        start = corners[order][canonical_start(corners[order][None])[0]]
        assert start.tolist() == [1, 1, 1]


def test_all_points_are_taken_in_the_end_and_no_more_can_be_asked(generator):
    points = clouds(generator, points=9)
    assert farthest_points(points, 9).sort(1).values.tolist() == [list(range(9))] * 3
    with pytest.raises(ConfigError, match="10 centroids cannot be taken from clouds of 9 points"):
        farthest_points(points, 10)


@pytest.mark.parametrize("order", ["cloud", "nearest"])
@pytest.mark.parametrize("chunk_bytes", [2**28, 2000])  # all at once, and a few centroids at a time
def test_ball_groups_are_those_of_the_loop(generator, order, chunk_bytes, monkeypatch):
    monkeypatch.setattr(grouping, "_CHUNK_BYTES", chunk_bytes)
    points = clouds(generator)
    centroids = torch.cat([points[:, :7], points[:, :1] + 5], dim=1)  # the last one's balls are empty
    radii, counts = (0.2, 0.45), (4, 50)  # the second asks for more than there are points
    for found, radius, count in zip(ball_groups(points, centroids, radii, counts, order=order), radii, counts, strict=True):
        distance = (centroids[:, :, None] - points[:, None]).norm(dim=-1) / radius
        assert found.tolist() == [[slow_group(row.tolist(), count, order) for row in cloud] for cloud in distance]


@pytest.mark.parametrize("order", ["cloud", "nearest"])
def test_space_time_groups_reach_farther_across_time(generator, order):
    points, times = clouds(generator), torch.rand(3, 40, generator=generator, dtype=torch.float64)
    found = space_time_groups(points, times, points[:, :6], times[:, :6], radius=0.3, growth=0.2, count=8, order=order)
    reach = 0.3 * (1 + 0.2 * (times[:, :6, None] - times[:, None]).abs())
    distance = (points[:, :6, None] - points[:, None]).norm(dim=-1) / reach
    assert found.tolist() == [[slow_group(row.tolist(), 8, order) for row in cloud] for cloud in distance]


def test_gathering_is_indexing_and_adds_up_derivatives(generator):
    values = clouds(generator, points=5).requires_grad_(True)
    index = torch.randint(0, 5, (3, 4, 6), generator=generator)
    found = gather_points(values, index)
    assert torch.equal(found, torch.stack([cloud[i] for cloud, i in zip(values, index, strict=True)]))
    found.sum().backward()
    uses = torch.stack([i.flatten().bincount(minlength=5) for i in index])
    assert torch.equal(values.grad, uses[..., None].expand(-1, -1, 3).double())
