"""Clusters that are never connected with the cloth are removed."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.io.episodes import Episode
from diffcloud.sensing.filters import without_strays
from diffcloud.sensing.visible_region import with_cut_planes

RNG = np.random.default_rng(0)


def patch(centre, count=200, size=0.1):
    return centre + size * (RNG.random((count, 3)) - 0.5) * [1, 1, 0.1]


def test_strays_go_and_a_corner_that_joins_later_stays():
    cloth, corner, stray = np.array([0.0, 0.0, 0.1]), np.array([0.18, 0.0, 0.1]), np.array([-0.5, 0.1, 0.1])
    apart = [np.concatenate([patch(cloth), patch(corner, 40, 0.04), patch(stray, 150)]) for _ in range(3)]
    joined = [np.concatenate([patch(cloth), patch((cloth + corner) / 2), patch(corner, 40, 0.04)]) for _ in range(2)]
    episode = Episode.from_frames([*apart, *joined], 0.1 * np.arange(5))
    found = without_strays(episode, 0.03)
    assert found.meta["quality"]["strays"] == [150, 150, 150, 0, 0]
    assert np.diff(found.offsets).tolist() == [240, 240, 240, 440, 440]
    assert found.points[:, 0].min() > -0.1


def test_a_frame_is_never_emptied():
    frames = [patch(np.array([-0.5, 0.0, 0.1]), 50), *[patch(np.zeros(3)) for _ in range(3)]]
    found = without_strays(Episode.from_frames(frames, 0.1 * np.arange(4)), 0.03)
    assert np.diff(found.offsets).tolist() == [50, 200, 200, 200]


def test_the_cut_of_each_camera_is_its_lowest_point():
    points = np.array([[0, 0, 0.055], [0, 0, 0.2], [0, 0, 0.075], [0, 0, 0.3]])
    episode = Episode.from_frames([points], np.zeros(1), meta={"cameras": ["overhead", "side", "third"]})
    found = with_cut_planes(
        Episode(episode.points, episode.offsets, episode.times, camera=np.uint8([0, 0, 1, 1]), meta=episode.meta)
    )
    assert found.meta["cut_planes"] == {
        "overhead": pytest.approx([0, 0, 1, 0.055]),
        "side": pytest.approx([0, 0, 1, 0.075]),
    }
