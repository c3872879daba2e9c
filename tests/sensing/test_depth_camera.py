"""The depth camera errs as stereo does, and smoothing takes back what noise added."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from diffcloud.sensing.depth_camera import DepthNoise, published_cameras
from diffcloud.sensing.smoothing import smooth_depth

NOISE = DepthNoise()
EXACT = DepthNoise(subpixel_px=0.0, step_px=0.0, edge_dropout=0.0, flying=0.0, holes=0.0)
SHAPE = (120, 212)
SEEN = np.zeros(SHAPE, dtype=bool)


def camera(noise: DepthNoise):
    return published_cameras(SHAPE[1], SHAPE[0], noise=noise)[0]


def wall(distance: float) -> np.ndarray:
    return np.full(SHAPE, distance)


def test_without_faults_depth_is_true_to_the_millimetre(rng):
    depth = wall(0.9) + np.linspace(0, 0.2, SHAPE[1])
    depth[:10] = np.inf
    measured = camera(EXACT).measure(depth, SEEN, rng)
    assert (measured[:9] == 0).all()
    np.testing.assert_allclose(measured[11:] * 0.001, depth[11:], atol=0.00051)


def test_noise_grows_with_the_square_of_the_distance(rng):
    spread = []
    for distance in (0.6, 1.2):
        measured = camera(replace(NOISE, holes=0.0)).measure(wall(distance), SEEN, rng) * 0.001
        spread.append(measured.std())
        assert spread[-1] == pytest.approx(float(NOISE.sigma_m(np.array(distance))), rel=0.1)
        assert abs(measured.mean() - distance) < 0.1 * spread[-1] + 0.0005
    assert spread[1] / spread[0] == pytest.approx(4.0, rel=0.15)


def test_hidden_pixels_and_holes_have_no_depth(rng):
    hidden = SEEN.copy()
    hidden[:, :50] = True
    measured = camera(replace(NOISE, holes=0.02)).measure(wall(1.0), hidden, rng)
    assert (measured[:, :50] == 0).all()
    assert 0.005 < (measured[:, 50:] == 0).mean() < 0.05


def test_borders_lose_pixels_and_let_others_fly(rng):
    depth = wall(0.8)
    depth[:, 106:] = 1.2
    measured = camera(NOISE).measure(depth, SEEN, rng)[:, 105:107] * 0.001
    assert (measured == 0).mean() == pytest.approx(NOISE.edge_dropout, abs=0.1)
    between = (measured > 0.85) & (measured < 1.1)
    assert between.mean() == pytest.approx(NOISE.flying * 0.25 / 0.4, abs=0.06)


def test_smoothing_leaves_a_plane_and_takes_most_of_the_noise(rng):
    sigma = float(NOISE.sigma_m(np.array(1.0)))
    use = np.ones(SHAPE, dtype=bool)
    plane = 1 / (1.1 - 1e-3 * np.arange(SHAPE[1])[None, :] + 5e-4 * np.arange(SHAPE[0])[:, None])
    np.testing.assert_allclose(smooth_depth(plane, use, 2, sigma), plane, rtol=1e-12)
    noisy = 1 / (1 / plane + sigma * rng.normal(size=SHAPE))
    assert (smooth_depth(noisy, use, 2, sigma) - plane).std() < 0.35 * (noisy - plane).std()


def test_smoothing_reaches_over_no_border_and_uses_no_pixel_it_must_not(rng):
    step = wall(0.8)
    step[:, 106:] = 0.9
    use = np.ones(SHAPE, dtype=bool)
    np.testing.assert_allclose(smooth_depth(step, use, 2, 0.003), step, rtol=1e-12)
    use[40:60, 40:60] = False
    spoilt = np.where(use, step, 0.805)
    found = smooth_depth(spoilt, use, 2, 0.003)
    np.testing.assert_allclose(found, spoilt, rtol=1e-12)
