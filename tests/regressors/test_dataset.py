"""Training data: items and batches agree, parameters are scaled, frames are chosen, epochs differ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from diffcloud.errors import ConfigError
from diffcloud.regressors.dataset import Augmentation, CloudDataset
from tests.conftest import flat_set


def dataset(**options) -> CloudDataset:
    return CloudDataset(flat_set(runs=6, frames=4), points=30, **options)


@pytest.mark.parametrize(("frames", "count"), [("loss", 1), ("all", 4)])
def test_items_and_batches_agree(frames, count):
    data = dataset(frames=frames)
    clouds, parameters = data.batch([4, 1])
    assert clouds.shape == (2, count, 30, 3)
    assert clouds.dtype == parameters.dtype == torch.float32
    for place, run in enumerate((4, 1)):
        cloud, values = data[run]
        torch.testing.assert_close(cloud, clouds[place], rtol=0, atol=0)
        torch.testing.assert_close(values, parameters[place], rtol=0, atol=0)
    (loaded, values), *_ = DataLoader(data, batch_size=5)
    torch.testing.assert_close(loaded[[4, 1]], clouds, rtol=0, atol=0)
    assert values.shape == (5, 2)


def test_parameters_are_scaled_to_the_bounds():
    simulated = replace(flat_set(runs=2), parameters=np.array([[0.1, 10.0], [5.05, 0.1]]))
    torch.testing.assert_close(CloudDataset(simulated, points=5).batch([0, 1])[1], torch.tensor([[0, 1.0], [0.5, 0]]))


def test_frames_are_the_loss_frame_or_those_of_an_episode():
    moving = flat_set(runs=2, frames=4)
    moving = replace(
        moving, nodes=moving.nodes + np.arange(4, dtype=np.float32)[:, None, None], loss_frame=2, first_frame=1
    )
    heights = {}
    for frames in ("loss", "all"):
        data = CloudDataset(moving, Augmentation.none(), frames=frames, points=10)
        heights[frames] = data[0][0][..., 2].mean(-1).tolist()
        assert data.times.tolist() == pytest.approx([0.1 * height for height in heights[frames]])
    assert heights == {"loss": pytest.approx([2.0]), "all": pytest.approx([1.0, 2.0, 3.0])}


def test_epochs_and_seeds_give_fresh_clouds():
    data = dataset()
    first = data[0][0]
    data.set_epoch(1)
    assert not torch.equal(data[0][0], first)
    data.set_epoch(0)
    torch.testing.assert_close(data[0][0], first, rtol=0, atol=0)
    assert not torch.equal(dataset(seed=1)[0][0], first)


def test_workers_of_a_loader_give_the_same_clouds():
    alone, together = (
        torch.cat([clouds for clouds, _ in DataLoader(dataset(), batch_size=2, num_workers=count)]) for count in (0, 1)
    )
    torch.testing.assert_close(alone, together, rtol=0, atol=0)


def test_unknown_frames_are_refused():
    with pytest.raises(ConfigError, match="Unknown choice of frames 'last'"):
        dataset(frames="last")
