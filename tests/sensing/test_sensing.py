"""The whole-surface recorder draws what it should; filters remove what they should."""

from __future__ import annotations

import numpy as np
import pytest

from diffcloud.errors import EpisodeError
from diffcloud.mesh import box_surface, grid_cloth
from diffcloud.sensing.cameras import looking_at
from diffcloud.sensing.filters import clean_frame, in_large_clusters
from diffcloud.sensing.whole_surface import sample_surface


def sheet(height, size, count, rng):
    return np.column_stack([rng.uniform(-size, size, (count, 2)), np.full(count, height)])


def test_the_pose_is_a_right_handed_frame_that_looks_at_its_target():
    pose = looking_at((0.3, -0.4, 0.8), (0.0, 0.0, 0.0))
    rotation = pose[:3, :3]
    np.testing.assert_allclose(rotation.T @ rotation, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    local = rotation.T @ (np.zeros(3) - pose[:3, 3])
    np.testing.assert_allclose(local[:2], 0.0, atol=1e-12)
    assert local[2] > 0


class TestWholeSurface:
    BOX = box_surface([1.0, 0.0, 0.0], [1.2, 0.2, 0.2])

    def sampled(self, obstacle, seed=0):
        cloth = grid_cloth(4, 4, 0.2, 0.6)
        nodes = np.stack([np.add(cloth.nodes, (0, 0, z)) for z in (-0.1, -0.3)])
        times = np.array([0.0, 0.1])
        return sample_surface(nodes, cloth.faces, times, obstacle, points=3000, seed=seed, meta={"scenario": "s"})

    def test_points_lie_on_cloth_and_obstacle_in_proportion_to_area(self):
        episode = self.sampled(self.BOX)
        for index, height in enumerate((-0.1, -0.3)):
            points = episode.frame(index).astype(float)
            assert len(points) == 3000
            on_cloth = np.abs(points[:, 2] - height) < 1e-6
            assert on_cloth.mean() == pytest.approx(0.12 / (0.12 + 6 * 0.04), abs=0.005)
            local = points[~on_cloth] - [1.1, 0.1, 0.1]
            assert np.abs(local).max(axis=1) == pytest.approx(np.full((~on_cloth).sum(), 0.1), abs=1e-6)

    def test_frames_are_drawn_anew_and_reproducibly(self):
        episode = self.sampled(self.BOX)
        assert not np.allclose(episode.frame(0)[:, :2], episode.frame(1)[:, :2])
        np.testing.assert_array_equal(episode.points, self.sampled(self.BOX).points)
        assert not np.array_equal(episode.points, self.sampled(self.BOX, seed=1).points)

    def test_without_an_obstacle_only_the_cloth(self):
        episode = self.sampled(None)
        assert np.abs(episode.frame(0)[:, 2] + 0.1).max() < 1e-6
        assert episode.gripper is None  # a fit then moves the handles as the scene does
        assert episode.meta["noise_free"]


class TestFilters:
    def test_outliers_go_and_the_sheet_stays(self, rng):
        cloud = np.concatenate([sheet(0.0, 0.1, 2000, rng), rng.uniform(0.3, 0.6, (20, 3))]).astype(np.float32)
        keep, report = clean_frame(cloud, rng=rng)
        assert (keep < 2000).all()
        assert len(keep) > 1900
        assert (report.recorded, report.kept) == (2020, len(keep))

    def test_scraps_apart_from_the_cloth_go(self, rng):
        cloud = np.concatenate([sheet(0.0, 0.1, 2000, rng), sheet(0.1, 0.01, 90, rng), sheet(-0.1, 0.03, 110, rng)])
        kept = in_large_clusters(cloud, 0.03, 0.05)
        assert kept[:2000].all()
        assert not kept[2000:2090].any()
        assert kept[2090:].all()
        assert in_large_clusters(cloud[:0], 0.03, 0.05).shape == (0,)

    def test_crop_and_limit(self, rng):
        cloud = sheet(0.0, 0.1, 2000, rng).astype(np.float32)
        keep, report = clean_frame(cloud, crop=((0, -1, -1), (1, 1, 1)), neighbours=0, limit=100, rng=rng)
        assert (cloud[keep, 0] >= 0).all()
        assert len(np.unique(keep)) == 100  # without repetition
        assert report.cropped == (cloud[:, 0] >= 0).sum()

    def test_a_crop_that_leaves_nothing_shows_both_boxes(self, rng):
        with pytest.raises(EpisodeError, match=r"No point lies in the crop box.*the cloud spans"):
            clean_frame(sheet(0.0, 0.1, 50, rng).astype(np.float32), crop=((5, 5, 5), (6, 6, 6)), rng=rng)
