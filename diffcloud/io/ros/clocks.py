"""Times of ROS messages, including messages without a time stamp.

In a simulator's recording, stamp 0 is the start of simulated time. Elsewhere it means that the message was not stamped.
Then the time at which the recorder received the message is used, converted to the clock of the stamped messages.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from diffcloud.io.recordings import EPOCH_S

Floats = NDArray[np.float64]

_OTHER_CLOCK_S = 60.0
"""Largest delay between stamp and arrival. A larger difference means another clock, such as simulated time."""


def message_times(stamps: Mapping[str, Sequence[tuple[float, float]]]) -> tuple[dict[str, Floats], list[str]]:
    """Return (topic -> times [N] of its messages [s], warnings about messages without a stamp).

    Args:
        stamps: topic -> (stamp, arrival) of each message in order of arrival [s]. A stamp of 0 or less means none.
    """
    pairs = {topic: np.array(held, dtype=np.float64).reshape(-1, 2) for topic, held in stamps.items()}
    every = np.concatenate([np.zeros((0, 2)), *pairs.values()])
    stamped = every[every[:, 0] > 0]
    simulated = bool(len(stamped) and np.median(stamped[:, 0]) < EPOCH_S)
    offset = float(np.median(stamped[:, 0] - stamped[:, 1])) if len(stamped) else 0.0
    if abs(offset) < _OTHER_CLOCK_S:
        offset = 0.0
    times, warnings = {}, []
    for topic, held in pairs.items():
        own = held[:, 0].copy()
        missing = own <= 0
        if missing.any() and not (simulated and (own > 0).any()):
            own[missing] = held[missing, 1] + offset
            warnings.append(
                f"{topic}: {int(missing.sum())} of {len(own)} messages are stamped 0; the times at which they were "
                "received are taken"
                + (", moved to the clock of the stamped messages." if offset else ". Motion is late by their delay.")
            )
        times[topic] = own
    return times, warnings
