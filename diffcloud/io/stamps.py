"""Correction of late time stamps of clouds, for a cloth that hangs from its gripper.

A cloud is often stamped when it is published. The upper end of a hanging cloth is at the gripper, so the recorded track
of the gripper tells when the cloud was taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from diffcloud.io.episodes import Episode

Floats = NDArray[np.float64]

_PART = 1 / 8
"""Fraction of the points of a cloud that show its upper end, and of the next ones below."""
_END_M = 0.006
"""Standard deviation [m] of the upper end relative to the gripper."""
_JITTER_S = 0.04
"""Standard deviation [s] of the lag of one cloud about the expected lag."""
_MOST_S, _GRID_S = 0.8, 0.005
"""Largest common lag that is tried, and step between trial lags [s]."""
_MOVES_M_S = 0.2
"""Minimum speed [m/s] at which the gripper shows the time."""
_FEW = 10
"""Minimum number of clouds with a moving gripper. With fewer, the lags are unknown."""
_LATE_S = 0.1
"""Smallest median lag [s] that is corrected. A cloth that hangs from a corner swings about it, which looks like a small
lag. Smaller lags are estimated by the fit."""
_OUTLIER_S = 0.15
"""Lags farther from the median [s] are ignored when the expected lag is estimated."""
_EVEN_S = 0.005
"""Minimum standard deviation [s] of the intervals between clouds at which they predict the lag."""
_LONGEST_S = 0.25
"""Longest interval [s] since the previous cloud that affects the lag."""


@dataclass(frozen=True)
class Lags:
    """Lags of the time stamps of F clouds."""

    seconds: Floats
    """[F] stamp minus true time [s]."""
    spread_m: tuple[float, float]
    """Mean distance [m] of the upper end from its median position relative to the gripper, before and after correction."""

    @property
    def sentence(self) -> str:
        low, middle, high = np.quantile(self.seconds, [0.05, 0.5, 0.95])
        before, after = (1e3 * spread for spread in self.spread_m)
        return (
            f"the clouds are stamped {middle:.2f} s late ({low:.2f} to {high:.2f} s), and their times were corrected: the "
            f"upper end of the cloth is now {after:.0f} mm from its place under the gripper, before {before:.0f} mm"
        )


def corrected_stamps(episode: Episode) -> tuple[Episode, Lags | None]:
    """Return the recording of a hanging cloth with corrected time stamps, and the lags.

    Args:
        episode: recording in metres, z up, with the track of one gripper.

    Returns:
        The episode with times from 0 and the gripper interpolated at these times, and the lags. If the clouds are not
        late, or the gripper moves too slowly, the unchanged episode and None.
    """
    if episode.gripper is None or episode.frame_count < _FEW:
        return episode, None
    found = stamp_lags(episode)
    if found is None or np.median(found.seconds) < _LATE_S:
        return episode, None
    taken = episode.times - found.seconds
    kept = np.flatnonzero((taken >= episode.times[0]) & (np.maximum.accumulate(taken) == taken))
    kept = kept[np.diff(taken[kept], prepend=-np.inf) > 1e-3]
    gripper = np.asarray(CubicSpline(episode.times, episode.gripper)(taken[kept]))
    chosen = replace(episode.select_frames(kept), times=taken[kept] - taken[kept[0]], gripper=gripper)
    return chosen, found


def upper_end(points: NDArray[np.floating]) -> Floats:
    """Return the position [3] of the upper end of a cloud [N, 3], extrapolated from its highest points."""
    order = points[:, 2].argsort()[::-1]
    count = max(round(_PART * len(points)), 1)
    return np.asarray(
        1.5 * points[order[:count]].mean(0) - 0.5 * points[order[count : 2 * count]].mean(0), dtype=np.float64
    )


def stamp_lags(episode: Episode) -> Lags | None:
    """Estimate the lag of each cloud of a hanging cloth, or return None if the gripper moves too little.

    A cloud waits until the previous one is processed. So a line through the lags over the intervals between clouds gives
    the expected lag. Each lag minimizes the distance of the upper end from the gripper, with a Gaussian prior about the
    expected lag. While the gripper is at rest, the prior decides.

    Args:
        episode: recording in metres, z up, with the track of one gripper.
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
