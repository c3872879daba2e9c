"""The pose of a recording: its transform, what is read from text and records."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from diffcloud.errors import ConfigError
from diffcloud.estimation.alignment import aligned
from diffcloud.estimation.pose import NUISANCE, PoseSpace, parse_priors

CENTRE = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
EVERY = dict.fromkeys(NUISANCE, 0.1)


def space(*names: str, unit: float = 1.0) -> PoseSpace:
    return PoseSpace.build(dict.fromkeys(names or NUISANCE, 0.1), CENTRE, length_unit_m=unit)


@pytest.fixture
def poses(generator):
    return 0.3 * torch.randn(4, len(NUISANCE), generator=generator, dtype=torch.float64)


@pytest.fixture
def points(generator):
    return torch.randn(4, 2, 5, 3, generator=generator, dtype=torch.float64)


class TestTransform:
    def test_a_rotation_vector_about_the_centre_and_a_shift(self, points, poses):
        found = space().moved(points, poses)
        x, y, z, tilt_x, tilt_y, yaw, _, scale = poses.T
        for row in range(len(poses)):
            turn = Rotation.from_rotvec([tilt_x[row], tilt_y[row], yaw[row]]).as_matrix()
            shift = np.array([x[row], y[row], z[row]])
            expected = math.exp(scale[row]) * (points[row].numpy() - CENTRE.numpy()) @ turn.T + CENTRE.numpy() + shift
            np.testing.assert_allclose(found[row].numpy(), expected, atol=1e-12)

    def test_back_is_its_inverse(self, points, poses):
        recorded = points[0]
        there = space().back(recorded, poses)
        torch.testing.assert_close(space().moved(there, poses), recorded.expand_as(there))

    def test_distances_scale(self, points, poses):
        moved = space().moved(points, poses)
        before, after = ((of[:, 0] - of[:, 1]).norm(dim=-1) for of in (points, moved))
        torch.testing.assert_close(after, poses[:, -1, None].exp() * before)

    def test_depths_that_are_too_large_scale_about_the_camera(self, points):
        """So a scale about the centre and a shift tell of the same clouds."""
        camera, part = torch.tensor([1.2, 0.1, 0.9], dtype=torch.float64), 0.03
        seen = camera + math.exp(part) * (points - camera)
        shift = (math.exp(part) - 1) * (CENTRE - camera)
        values = torch.cat([shift, torch.tensor([part], dtype=torch.float64)]).expand(4, -1)
        torch.testing.assert_close(space("x", "y", "z", "scale").moved(points, values), seen)

    def test_zero_leaves_all_in_place(self, points):
        torch.testing.assert_close(space().moved(points, torch.zeros(4, len(NUISANCE), dtype=torch.float64)), points)

    @pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 1.0, 4.0])
    def test_rates_are_those_of_differences(self, points, poses, generator, size):
        poses = size * poses
        velocities = torch.randn(points.shape, generator=generator, dtype=torch.float64)
        whole, step = space(), 1e-6

        def at(values):
            return whole.moved(points + whole.lags(values)[..., None, None] * velocities, values)

        clock = torch.zeros(points.shape[:-1], dtype=torch.long)
        found = whole.rates(points + whole.lags(poses)[..., None, None] * velocities, poses, velocities, clock)
        for index in range(len(NUISANCE)):
            way = torch.zeros_like(poses)
            way[:, index] = step
            expected = (at(poses + way) - at(poses - way)) / (2 * step)
            torch.testing.assert_close(found[index], expected, rtol=1e-7, atol=1e-8)

    def test_what_is_not_free_is_zero(self, points):
        values = torch.full((4, 1), 0.2, dtype=torch.float64)
        found = space("yaw").moved(points, values)
        torch.testing.assert_close(found[..., 2], points[..., 2])
        torch.testing.assert_close(found.mean((1, 2))[:, 2], points.mean((1, 2))[:, 2])


class TestSearch:
    def test_the_scale_stays_until_distances_are_capped_as_in_the_loss(self):
        """Of a quadratic loss in x and scale, whose slope couples them."""
        seen, lowest = [], torch.tensor([0.05, 0.03], dtype=torch.float64)
        curvature = torch.tensor([[1.0, 0.8], [0.8, 1.0]], dtype=torch.float64)

        def terms(poses, factor, entries):
            seen.append((factor, float(poses[0, 1])))
            slope = (poses - lowest) @ curvature
            return 1e-9 + ((poses - lowest) * slope).sum(-1), slope, curvature.expand(len(poses), -1, -1)

        found = aligned(space("x", "scale"), torch.zeros(1, 2).double(), terms, (4.0, 2.0, 1.0, 1.0, 1.0, 1.0))
        assert [scale for factor, scale in seen if factor > 1.0] == [0.0, 0.0]
        torch.testing.assert_close(found[0], lowest, atol=1e-4, rtol=0)


class TestText:
    def test_units_are_told_or_si(self):
        assert parse_priors("x=10cm, y=0.05,yaw=30deg,lag=20ms") == pytest.approx(
            {"x": 0.1, "y": 0.05, "yaw": math.pi / 6, "lag": 0.02}
        )

    def test_none(self):
        assert parse_priors("none") == {}

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("jaw=30deg", "Unknown alignment variable 'jaw'. Did you mean 'yaw'"),
            ("x", "x takes how far it may well be off, a positive number in one of m, cm, mm, such as x=2cm"),
            ("yaw=30", "one of rad, deg, such as yaw=5deg"),
            ("x=30deg", "one of m, cm, mm"),
            ("yaw=1m", "one of rad, deg"),
            ("x=0.1parsec", "one of m, cm, mm"),
            ("x=-1cm", "positive"),
            ("x=nan", "positive"),
            ("x=0", "positive"),
            ("x=1e999", "positive"),
            ("x=1,x=2", "names x twice"),
            ("", "Unknown alignment variable ''"),
        ],
    )
    def test_typed_wrongly(self, text, message):
        with pytest.raises(ConfigError, match=message):
            parse_priors(text)


class TestRecords:
    def test_lengths_are_kept_in_metres(self, poses):
        scene = space(unit=0.35)
        kept = scene.described(poses[0], length_unit_m=0.35)
        assert kept["x"].value == pytest.approx(0.35 * float(poses[0, 0]))
        assert (kept["x"].prior, kept["x"].unit) == (pytest.approx(0.1), "m")
        assert kept["yaw"].value == pytest.approx(float(poses[0, 5]))
        torch.testing.assert_close(scene.of(kept, length_unit_m=0.35), poses[0])

    @pytest.mark.parametrize("priors", [{"jaw": 0.1}, {"x": 0.0}, {"x": math.inf}])
    def test_priors_that_are_none(self, priors):
        with pytest.raises(ConfigError):
            PoseSpace.build(priors, CENTRE, length_unit_m=1.0)
