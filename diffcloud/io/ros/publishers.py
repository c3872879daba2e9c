"""Separate the joint states of a robot's driver from those of other publishers.

Several nodes may publish the same joints: the driver, a controller (desired angles), or joint_state_publisher (zeros).
Mixed together, they describe an arm that jumps back and forth. Topic, sender, frame and joint names distinguish
publishers. If all of these are equal, continuity of the angles is used.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError

Floats = NDArray[np.float64]

_JUMP_RAD, _FASTEST_RAD_S = 0.02, 10.0
"""Largest change between messages of one driver: the first plus the second times the time between them."""
_LEAST_PART, _LEAST_COUNT = 0.05, 3
"""Smallest share and number of a publisher's messages in a topic. Fewer jumps are faulty messages of one driver."""
_MOST_TRACKS = 8
_STILL_RAD = 1e-3
"""Joints that move by less during the recording are considered stationary."""


@dataclass(frozen=True)
class JointMessage:
    """A sensor_msgs/JointState message with its time and origin."""

    time_s: float
    topic: str
    sender: str
    """Node name in ROS 1. ROS 2 does not record it, so there it is the number of the connection."""
    message: Any


@dataclass(frozen=True)
class _Publisher:
    """Messages that come from one node, as far as can be determined."""

    topic: str
    messages: tuple[JointMessage, ...]
    names: frozenset[str]
    """Names of the requested joints in these messages."""
    moves: bool

    def contradicts(self, other: _Publisher) -> bool:
        """Whether both publish a common joint in overlapping time ranges."""
        first, second = ([held.time_s for held in one.messages] for one in (self, other))
        return bool(self.names & other.names) and max(min(first), min(second)) < min(max(first), max(second))


def of_one_driver(
    where: str, messages: Sequence[JointMessage], needed: Collection[str], named: Collection[str]
) -> tuple[list[JointMessage], list[str]]:
    """Select one publisher per joint. Return its messages in order of arrival, and warnings about omitted messages.

    Args:
        where: name of the recording, for messages.
        messages: messages in order of arrival. If the user selected topics, only theirs.
        needed: joints of interest.
        named: topics that the user selected, also as TOPIC#NUMBER for one of several publishers.

    Raises:
        EpisodeError: several publishers send the same joints, and none or several are selected.
    """
    publishers = _publishers(messages, frozenset(needed))
    candidates = {
        index
        for pair in combinations(range(len(publishers)), 2)
        if publishers[pair[0]].contradicts(publishers[pair[1]])
        for index in pair
    }
    labels = _labels(publishers, sorted(candidates))
    plain = {name.partition("#")[0] for name in named if "#" not in name}
    asked = {index for index in candidates if labels[index] in named}
    numbered = {name for name in named if "#" in name}
    if unknown := sorted(numbered - set(labels.values())):
        raise EpisodeError(_candidates(where, publishers, labels, f"There is no {unknown[0]}. "))
    kept = candidates
    if asked:
        kept = asked | {index for index in candidates if publishers[index].topic in plain}
    moving = {index for index in kept if publishers[index].moves}
    if named and len({publishers[index].topic for index in kept}) == 1 and len(moving) == 1:
        kept = moving  # the topic is selected, and only one of its publishers moves
    if any(publishers[first].contradicts(publishers[second]) for first, second in combinations(sorted(kept), 2)):
        raise EpisodeError(_candidates(where, publishers, labels, ""))
    warnings = [
        f"{labels[index]}: {len(publishers[index].messages)} joint states of another publisher were left out."
        for index in sorted(candidates - kept)
    ]
    if not candidates:
        return list(messages), warnings
    held = {
        id(message) for index, one in enumerate(publishers) if index not in candidates - kept for message in one.messages
    }
    return [message for message in messages if id(message) in held], warnings


def _publishers(messages: Sequence[JointMessage], needed: frozenset[str]) -> list[_Publisher]:
    """Group messages with the requested joints into publishers, in order of their first messages."""
    groups: dict[tuple[str, str, str, tuple[str, ...]], list[JointMessage]] = {}
    for held in messages:
        names = tuple(held.message.name)
        if needed & set(names) and len(held.message.position) >= len(names):
            groups.setdefault((held.topic, held.sender, held.message.header.frame_id, names), []).append(held)
    found = []
    for (topic, _, _, names), group in groups.items():
        columns = [column for column, name in enumerate(names) if name in needed]
        angles = np.array([np.asarray(held.message.position, np.float64)[columns] for held in group])
        times = np.array([held.time_s for held in group])
        for rows in _continuous(times, angles) if len(columns) > 1 else [np.arange(len(group))]:
            moves = bool(np.ptp(angles[rows], axis=0).max() > _STILL_RAD)
            own = tuple(group[row] for row in rows)
            found.append(_Publisher(topic, own, needed & set(names), moves))
    return found


def _continuous(times: Floats, angles: Floats) -> list[NDArray[np.int64]]:
    """Split rows of angles [N, J] into drivers whose messages alternate. Returns one group if they do not alternate."""
    whole = [np.arange(len(times))]
    jumps = _apart(np.diff(angles, axis=0)) > _JUMP_RAD + _FASTEST_RAD_S * np.diff(times).clip(0)
    if jumps.sum() < 2 * _LEAST_COUNT:
        return whole
    tracks: list[list[int]] = []
    for row in range(len(times)):  # sequential, because each assignment depends on the previous ones
        last = [track[-1] for track in tracks]
        away = _apart(angles[row] - angles[last]) if last else np.zeros(0)
        reach = _JUMP_RAD + _FASTEST_RAD_S * (times[row] - times[last]).clip(0)
        away = np.where(away <= reach, away, np.inf)
        if last and np.isfinite(away.min()):
            tracks[int(away.argmin())].append(row)
        elif len(tracks) < _MOST_TRACKS:
            tracks.append([row])
        else:
            return whole
    least = max(_LEAST_COUNT, _LEAST_PART * len(times))
    large = [np.array(track) for track in tracks if len(track) >= least]
    alternate = any(max(a[0], b[0]) < min(a[-1], b[-1]) for a, b in combinations(large, 2))
    return large if alternate else whole


def _apart(difference: Floats) -> Floats:
    """[N] largest angle difference of a joint, modulo whole turns, since continuous joints may wrap around."""
    return np.asarray(np.abs((difference + np.pi) % (2 * np.pi) - np.pi).max(axis=-1))


def _labels(publishers: Sequence[_Publisher], candidates: Sequence[int]) -> dict[int, str]:
    """Publisher -> the label for the user to select: the topic, with a number if publishers on it conflict."""
    labels: dict[int, str] = {}
    for topic in {publishers[index].topic for index in candidates}:
        own = [index for index in candidates if publishers[index].topic == topic]
        labels |= dict.fromkeys(own, topic)
        within = {
            index for pair in combinations(own, 2) if publishers[pair[0]].contradicts(publishers[pair[1]]) for index in pair
        }
        labels |= {index: f"{topic}#{number}" for number, index in enumerate(sorted(within), start=1)}
    return labels


def _candidates(where: str, publishers: Sequence[_Publisher], labels: dict[int, str], problem: str) -> str:
    listed = "; ".join(
        f"{labels[index]} ({len(one.messages)} messages of {', '.join(sorted(one.names))}, "
        + (f"{'moving' if one.moves else 'standing still'})")
        for index, one in enumerate(publishers)
        if index in labels
    )
    example = next((labels[index] for index in labels if publishers[index].moves), "TOPIC")
    if not labels:
        return f"{where}: {problem}Only one publisher sends these joints at a time; name the topic without a number."
    return (
        f"{where}: {problem}Several publishers send the same joints at the same time: {listed}. Name the one that "
        f"measured the arm with --topic, such as `--topic '{example}'`."
    )
