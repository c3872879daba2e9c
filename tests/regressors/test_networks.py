"""Sizes, invariance, and the shortcut of the first layers."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from diffcloud.errors import ConfigError
from diffcloud.regressors import build_network, frames_seen, layer_sizes
from diffcloud.regressors.grouping import gather_points
from diffcloud.regressors.layers import LocalNetwork, highest

HEAD = [(1024, 512), (512, 256), (256, 2)]
GLOBAL = [(256, 512), (512, 1024)]
SIZES = {
    "mlp": [(3, 64), (64, 64), (64, 64), (64, 128), (128, 1024), *HEAD],
    "pointnet2": [
        *[(3, 32), (32, 32), (32, 64)],
        *[(3, 64), (64, 64), (64, 128)],
        *[(3, 64), (64, 96), (96, 128)],
        *[(323, 64), (64, 64), (64, 128)],
        *[(323, 128), (128, 128), (128, 256)],
        *[(323, 128), (128, 128), (128, 256)],
        *[(643, 256), *GLOBAL],
        *HEAD,
    ],
    "meteornet": [
        *[(4, 32), (32, 32), (32, 64)],
        *[(68, 64), (64, 64), (64, 128)],
        *[(132, 128), (128, 128), (128, 256)],
        *[(259, 256), *GLOBAL],
        *HEAD,
    ],
}
"""(inputs, outputs) of every layer for two parameters, from the papers."""


@pytest.mark.parametrize("model", SIZES)
def test_layers_have_the_published_sizes(model):
    network = build_network(model, 2)
    rows = layer_sizes(network)
    assert [(row.inputs, row.outputs) for row in rows] == SIZES[model]
    # weights and bias, and a scale and a shift of the normalisation of all but the last
    expected = sum(a * b + b for a, b in SIZES[model]) + sum(2 * b for _, b in SIZES[model][:-1])
    assert sum(row.parameters for row in rows) == expected == sum(p.numel() for p in network.parameters())
    documented = (Path(__file__).parents[2] / "docs" / "regressors.md").read_text(encoding="utf-8")
    assert re.search(rf"\| {model} \|.*\| {expected:,} \|", documented), f"{model} has {expected:,} parameters"


def test_centroids_neighbours_radii_and_dropout_are_the_published_ones():
    pointnet2, meteornet = build_network("pointnet2", 2), build_network("meteornet", 2, frames=25)
    layout = [(level.centroids, level.radii, level.neighbours) for level in (pointnet2.first, pointnet2.second)]
    assert layout == [(512, (0.1, 0.2, 0.4), (16, 32, 128)), (128, (0.2, 0.4, 0.8), (32, 64, 128))]
    modules = meteornet.modules_in_time
    assert [(m.centroids, m.neighbours, m.radius) for m in modules] == [(1024, 32, 0.5), (512, 32, 1.0), (128, 32, 2.0)]
    rates = {model: [m.p for m in build_network(model, 2).modules() if isinstance(m, torch.nn.Dropout)] for model in SIZES}
    assert rates == {"mlp": [0.0, 0.3], "pointnet2": [0.5, 0.5], "meteornet": [0.0, 0.0]}
    assert {model: frames_seen(model) for model in SIZES} == {"mlp": "loss", "pointnet2": "loss", "meteornet": "all"}


@pytest.mark.parametrize("model", SIZES)
def test_the_order_of_the_points_does_not_matter(model, generator):
    torch.manual_seed(0)
    frames = 3 if model == "meteornet" else 1
    network = build_network(model, 2, frames=frames, order="nearest", density=0.125).eval()
    clouds = torch.rand(2, frames, 150, 3, generator=generator) - 0.5
    shuffled = clouds[:, :, torch.randperm(150, generator=generator)]
    with torch.no_grad():
        first, second = network(clouds), network(shuffled)
    assert not torch.equal(first[0], first[1])  # it does look at the clouds
    if model == "mlp":
        assert torch.equal(first, second)
    torch.testing.assert_close(first, second, rtol=0, atol=1e-5)


def test_the_first_layer_is_that_of_joined_positions_and_features(generator):
    """The product with the features is taken before the grouping; a plain layer on the joined vectors is its twin."""
    torch.manual_seed(0)
    network = LocalNetwork(4, 5, (6, 7)).double().eval()
    relative = torch.rand(2, 3, 8, 4, generator=generator, dtype=torch.float64)
    features = torch.rand(2, 20, 5, generator=generator, dtype=torch.float64)
    index = torch.randint(0, 20, (2, 3, 8), generator=generator)
    joined = torch.cat([relative, gather_points(features, index)], dim=-1)
    expected = network.rest(network.first(joined)).amax(2)
    torch.testing.assert_close(network(relative, features, index), expected)


@pytest.mark.parametrize("model", SIZES)
def test_networks_keep_double_precision_and_take_small_clouds(model):
    network = build_network(model, 3, frames=2).double()
    outputs = network(torch.rand(2, 2, 6, 3, dtype=torch.float64))
    assert outputs.shape == (2, 3)
    assert outputs.dtype == torch.float64


@pytest.mark.parametrize("model", SIZES)
def test_one_batch_can_be_learned_by_heart(model, generator):
    torch.manual_seed(0)
    frames = 3 if model == "meteornet" else 1
    network = build_network(model, 2, frames=frames, dropout=0.0, order="nearest", density=0.125)
    clouds = torch.rand(6, frames, 24, 3, generator=generator) - 0.5
    targets = torch.rand(6, 2, generator=generator)
    optimiser = torch.optim.Adam(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 60)
    for _ in range(60):
        loss = (network(clouds) - targets).abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    assert loss.item() < 0.02  # of the range


def test_an_unknown_model_is_named():
    with pytest.raises(ConfigError, match=r"'pointnet'. Did you mean 'pointnet2'.* Allowed: meteornet, mlp, pointnet2"):
        frames_seen("pointnet")


def test_highest_is_torchs_maximum_also_of_repeated_points():
    values = torch.randn(3, 4, 7, 5).double()
    values = torch.relu(torch.cat([values, values[:, :, :2]], dim=2)).requires_grad_(True)  # zeros and repeats are ties
    weights = torch.randn(3, 4, 5).double()
    found, expected = highest(values), values.max(2).values
    assert torch.equal(found, expected)
    gradients = [torch.autograd.grad((one * weights).sum(), values)[0] for one in (found, expected)]
    assert torch.equal(*gradients)
