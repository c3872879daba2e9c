"""When clouds were taken, where their stamps are late: found from the upper end of a cloth that hangs from its gripper."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from diffcloud.io.episodes import Episode

Floats = NDArray[np.float64]

_PART = 1 / 8
"""Of the points of a cloud, those that show its upper end, and as many below them."""
_END_M = 0.006
"""Standard deviation of the upper end against the gripper."""
_JITTER_S = 0.04
"""Standard deviation of one cloud's lag about the expected lag."""
_MOST_S, _GRID_S = 0.8, 0.005
"""Lags that are looked for: up to the first, in steps of the second."""
_MOVES_M_S = 0.2
"""A gripper that moves faster shows the time."""
_FEW = 10
"""Clouds of a moving gripper, below which only the common lag is known."""
_LATE_S = 0.1
"""A smaller common lag is left to the fit: what hangs from a corner turns under it, which looks like a small lag."""
_OUTLIER_S = 0.15
"""A lag that is farther from the median does not tell the expected lag."""
_EVEN_S = 0.005
"""Standard deviation of the times between clouds, below which they predict nothing."""
_LONGEST_S = 0.25
"""A longer time since the cloud before says nothing about the lag."""


@dataclass(frozen=True)
class Lags:
    """How late the stamps of F clouds are."""

    seconds: Floats
    """[F] [s]"""
    spread_m: tuple[float, float]
    """Mean distance of the upper end from its usual place under the gripper [m], before and after."""

    @property
    def sentence(self) -> str:
        low, middle, high = np.quantile(self.seconds, [0.05, 0.5, 0.95])
        before, after = (1e3 * spread for spread in self.spread_m)
        return (
            f"the clouds are stamped {middle:.2f} s late ({low:.2f} to {high:.2f} s), and their times were corrected: the "
            f"upper end of the cloth is now {after:.0f} mm from its place under the gripper, before {before:.0f} mm"
        )


def corrected_stamps(episode: Episode) -> tuple[Episode, Lags | None]:
    """The recording of a hanging cloth with each cloud at the time at which it was taken.

    A cloud is often stamped when it is published. Its upper end is at the gripper, so the track tells when it was taken. A
    cloud also waits until the cloud before it is processed, so the time since then predicts a part of the lag. Where the
    gripper stands still, this prediction alone counts.

    Args:
        episode: with the track of one gripper, in metres, z up.

    Returns:
        The episode, with times from 0 and the gripper at these times, and the lags; the episode itself and None, where the
        clouds are not late or the gripper never moves fast enough to tell.
    """
    if episode.gripper is None or episode.frame_count < _FEW:
        return episode, None
    found = stamp_lags(episode)
    if found is None or np.median(found.seconds) < _LATE_S:
        return episode, None
    taken = episode.times - found.seconds
    kept = np.flatnonzero((taken >= episode.times[0]) & (np.maximum.accumulate(taken) == taken))
    kept = kept[np.diff(taken[kept], prepend=-np.inf) > 1e-3]
    every = CubicSpline(episode.times, episode.gripper)
    frames = [episode.frame(int(frame)) for frame in kept]
    points = np.isin(np.repeat(np.arange(episode.frame_count), np.diff(episode.offsets)), kept)
    chosen = replace(
        episode,
        points=episode.points[points],
        offsets=np.cumsum([0, *map(len, frames)], dtype=np.int64),
        times=taken[kept] - taken[kept[0]],
        gripper=np.asarray(every(taken[kept])),
        camera=None if episode.camera is None else episode.camera[points],
        pixel=None if episode.pixel is None else episode.pixel[points],
        sigma=None if episode.sigma is None else episode.sigma[points],
        lost=None if episode.lost is None else episode.lost[kept],
    )
    return chosen, found


def upper_end(points: NDArray[np.floating]) -> Floats:
    """[3] the middle of a cloud's upper end: points [N, 3] near it, continued upwards by half their height."""
    order = points[:, 2].argsort()[::-1]
    count = max(round(_PART * len(points)), 1)
    return np.asarray(
        1.5 * points[order[:count]].mean(0) - 0.5 * points[order[count : 2 * count]].mean(0), dtype=np.float64
    )


def stamp_lags(episode: Episode) -> Lags | None:
    """How late each cloud of a hanging cloth is stamped; None where the gripper moves too little to tell.

    Args:
        episode: with the track of one gripper, in metres, z up.
    """
    assert episode.gripper is not None
    stamps, track = episode.times, CubicSpline(episode.times, episode.gripper.mean(axis=1))
    ends = np.stack([upper_end(episode.frame(frame)) for frame in range(episode.frame_count)])

    def away(times: Floats) -> Floats:
        return np.asarray(ends.reshape(-1, *[1] * (times.ndim - 1), 3) - track(np.clip(times, stamps[0], stamps[-1])))

    def spread(offsets: Floats) -> float:
        return float(np.linalg.norm(offsets - np.median(offsets, axis=0), axis=1).mean())

    tried = np.arange(0.0, _MOST_S, _GRID_S)
    common = float(tried[np.argmin([spread(away(stamps - lag)) for lag in tried])])
    offset = np.median(away(stamps - common), axis=0)
    since = np.minimum(np.diff(stamps, prepend=2 * stamps[0] - stamps[1]), _LONGEST_S)
    expected, jitter, lags = np.full(len(stamps), common), 3 * _JITTER_S, np.full(len(stamps), common)
    speed = track.derivative()
    for _ in range(5):
        around = expected[:, None] + np.arange(-0.3, 0.3 + _GRID_S, _GRID_S)
        apart = (away(stamps[:, None] - around) - offset) / _END_M
        cost = (apart**2).sum(-1) + ((around - expected[:, None]) / jitter) ** 2
        lags = np.take_along_axis(around, cost.argmin(1)[:, None], 1)[:, 0]
        offset = np.median(away(stamps - lags), axis=0)
        fast = np.linalg.norm(speed(np.clip(stamps - lags, stamps[0], stamps[-1])), axis=1) > _MOVES_M_S
        if fast.sum() < _FEW:
            return None
        usual = fast & (np.abs(lags - np.median(lags[fast])) < _OUTLIER_S)
        line = np.polyfit(since[usual], lags[usual], int(since[usual].std() > _EVEN_S))
        expected, jitter = np.polyval(line, since), _JITTER_S
    return Lags(lags, (spread(away(stamps)), spread(away(stamps - lags))))
