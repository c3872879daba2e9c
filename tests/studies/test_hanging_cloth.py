"""Parts of the study of a hanging cloth, on made data whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from typer.testing import CliRunner

from diffcloud.errors import EpisodeError
from studies import hanging_cloth as study
from tests.docs.form import check_form

VALUES = {"added_mass": 0.4, "linear_drag": 0.8, "air_density": 0.6}


def bar(times):
    """[K, 3] Still for 0.4 s, then two swings of 0.15 m, then still."""
    y = 0.15 * np.sin(2 * np.pi * 0.5 * np.clip(times - 0.4, 0.0, 4.0))
    return np.stack([np.zeros_like(times), y, 0.4 + 0.2 * y**2], 1)


def recording(values=VALUES, seed=0):
    """Of the simulated cloth, shifted and turned, on 8 x 8 places of each of 40 frames."""
    rng = np.random.default_rng(seed)
    steps = 0.02 * np.arange(1, 321)
    held = np.linspace(-0.15, 0.15, 7)[:, None] * [1.0, 0, 0]
    start = np.array([0.0, 0.0, 0.4]) + held
    track = np.repeat((bar(steps) - bar(np.zeros(1)))[:, None], 7, 1)
    run, _ = study.simulate(track, values)
    times = np.sort(rng.uniform(0.5, 6.3, 40))
    low = (times / 0.02).astype(int)
    share = (times / 0.02 - low)[:, None, None]
    nodes = run.positions[0].numpy()
    at = (nodes[low] * (1 - share) + nodes[low + 1] * share).reshape(40, 7, 7, 3)
    tent = np.maximum(0, 1 - np.abs(np.linspace(0.4, 5.6, 8)[:, None] - np.arange(7)))
    points = np.einsum("ai,bj,fijc->fabc", tent, tent, at)[:, ::-1].reshape(40, 64, 3) + np.array([0.01, -0.02, 0.405])
    return study.Recording("made", times, np.ascontiguousarray(points), np.ones((40, 64), bool), start, track, 4.4)


@pytest.mark.parametrize(("period", "decay"), [(0.93, 0.1), (1.085, 0.7), (1.3, 1.2)])
def test_a_damped_oscillation_has_its_period_and_decay(period, decay):
    times = np.sort(np.random.default_rng(2).uniform(3.0, 5.5, 25))
    values = -0.4 + 0.1 * np.exp(-decay * (times - 3)) * np.cos(2 * np.pi * times / period + 1)
    assert study.swing(times, values) == pytest.approx((period, decay), abs=1e-3)


def test_the_cloth_swings_as_a_hanging_chain_and_slower_with_air():
    """The first period of a chain is 4 π / 2.4048 sqrt(L / g) (Bernoulli); inertia without weight stretches it."""
    still = study.simulated_swing({"added_mass": 1e-6, "linear_drag": 1e-6, "air_density": 1e-6})[0]
    assert still == pytest.approx(4 * math.pi / 2.4048 * math.sqrt(0.3 / 9.81), rel=0.02)
    airy = study.simulated_swing({"added_mass": 0.44, "linear_drag": 1e-6, "air_density": 1e-6})[0]
    assert airy / still == pytest.approx(1.2, rel=0.01)


def test_derivatives_of_distances_are_those_of_differences():
    made = recording()
    free = ("added_mass", "air_density")
    pose = np.array([0.004, 0.006, -0.003, 0.02, -0.03, 0.05, 0.004])
    values = VALUES | {"added_mass": 0.7}
    _, slopes = study.residuals(made, *study.simulate(made.track, values, free), pose)

    def at(index, by):
        changed, moved = dict(values), pose.copy()
        if index < 2:
            changed[free[index]] *= math.exp(by)
        else:
            moved[index - 2] += by
        return study.residuals(made, *study.simulate(made.track, changed), moved)[0]

    for index in range(9):
        difference = (at(index, 1e-5) - at(index, -1e-5)) / 2e-5
        off = np.abs(difference - slopes[:, index])
        # where the nearest place leaps between faces, or time between steps, there is no derivative
        share = 0.05 if index == 8 else 1e-3  # the motion is linear between steps, and its velocity a mean over two
        assert np.quantile(off, 0.9) < share * np.abs(slopes[:-1, index]).max(), index


def test_a_fit_finds_the_air_of_a_simulated_recording():
    made = recording()
    found = study.fit([made], {"added_mass": 0.7, "linear_drag": 0.4, "air_density": 1.0}, tuple(VALUES))
    assert found["added_mass"] == pytest.approx(0.4, abs=0.02)
    pose, rms = study.find_pose(made, study.simulate(made.track, found)[0])
    assert rms < 0.001
    np.testing.assert_allclose(pose[1:3], [-0.02, 0.005], atol=1e-3)  # along the bar, inner points of a cloth say little
    assert study.free_swing(made)[0] == pytest.approx(study.simulated_swing(VALUES)[0], rel=0.04)


class TestFiles:
    @pytest.fixture
    def raw(self):
        made, times = recording(), np.arange(0.0, 6.4, 0.05)
        still = np.tile([0.0, 0.0, 0.0, 1.0], (len(times), 1))
        tool = bar(times) + np.array([0, 0, study._BAR])
        return {
            "cloud_times": made.times + 0.3, "clouds": made.points.astype(np.float32), "tool_times": times,
            "tool_positions": tool, "tool_quaternions_xyzw": still,
        }  # fmt: skip

    def test_a_recording_is_read(self, tmp_path, raw):
        raw["clouds"][3, :5] = np.nan
        np.savez(tmp_path / "one.npz", **raw)
        found = study.read_recording(tmp_path / "one.npz")
        made = recording()
        assert found.stop == pytest.approx(4.4, abs=0.06)
        index = np.searchsorted(made.times, found.times[5])
        assert np.abs(made.times - found.times[5]).min() < 0.03
        assert 0 <= index <= len(made.times)
        np.testing.assert_allclose(found.track[-1, 3], bar(np.array([6.35]))[0] - bar(np.zeros(1))[0], atol=1e-6)
        assert (~found.seen).sum() <= 5

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"clouds": np.zeros((40, 63, 3))}, "has the shapes"),
            ({"cloud_times": np.ones(40)}, "times that do not increase"),
            ({"tool_quaternions_xyzw": np.zeros((128, 4))}, "quaternions of length zero"),
            ({"tool_positions": np.zeros((128, 3))}, "The bar moves at 0.000 m/s at most"),
            ({"clouds": np.full((40, 64, 3), np.nan)}, "clouds with more than 8 points"),
            ({"clouds": np.array([None])}, "is not a readable recording of a hanging cloth"),
        ],
    )
    def test_what_is_no_recording_is_refused(self, tmp_path, raw, change, message):
        np.savez(tmp_path / "one.npz", **(raw | change))
        with pytest.raises(EpisodeError, match=message):
            study.read_recording(tmp_path / "one.npz")

    def test_a_folder_without_the_recordings_is_refused(self, tmp_path):
        import typer

        app = typer.Typer()
        app.command()(study.main)
        done = CliRunner().invoke(app, [str(tmp_path), "--out", str(tmp_path / "page.md")])
        assert done.exit_code == 1
        assert "Error: " in done.output
        assert "holds 0 recordings, without range30_rep1, range60_rep1, range90_rep1" in done.output
        assert not list(tmp_path.iterdir())


def test_a_page_says_what_was_found():
    models = ("air_density alone", "added density by the free swing", "added density by the clouds")
    rms = dict.fromkeys(study.FITTED, 12.0) | {"other": 11.0, "another": 13.0}
    rows = [study.Row(model, VALUES, rms, 1.1, 0.7) for model in models]
    page = study._page(rows, dict.fromkeys(rms, (1.09, 0.8)), "x.png")
    assert "period of 1.090 s (median of 5 swings)" in page
    assert "The median RMS of the 2 predicted recordings falls from 12.0 to 12.0 mm." in page
    assert "| air_density alone | 12.0 | 12.0 | 12.0 | 12.0 | 1.100 | 0.70 | 0.40 | 0.80 | 3.60 |" in page
    check_form(page)
