"""tf: poses of frames relative to each other over time.

Each frame has one parent, so frames form one or several trees. The path between two frames goes through their nearest
common ancestor. For example, camera and robot base may both be children of `world`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError

Floats = NDArray[np.float64]

_MOVED_M, _MOVED_RAD = 0.002, np.deg2rad(0.2)
"""Largest motion of a frame that is considered fixed."""
_LEAST_NORM = 1e-3
"""Smallest norm of a valid quaternion."""
_LOOKED_AT = 1000
"""Approximate number of times at which a fixed frame is checked."""


@dataclass(frozen=True)
class _Edge:
    """Transform of a frame relative to its parent over time."""

    parent: str
    stamps: Floats
    """[N] sorted times [s]."""
    matrices: Floats
    """[N, 4, 4] child-to-parent transforms."""

    def at(self, times: Floats) -> Floats:
        """[T, 4, 4] transforms at the stamps nearest to `times`."""
        after = np.searchsorted(self.stamps, times).clip(0, len(self.stamps) - 1)
        before = (after - 1).clip(0)
        nearest = np.where(np.abs(self.stamps[before] - times) < np.abs(self.stamps[after] - times), before, after)
        return self.matrices[nearest]


def refuse_conflicts(transforms: Sequence[tuple[str, Any]], where: str) -> None:
    """Check that topics do not contradict each other.

    Args:
        transforms: (topic, geometry_msgs/TransformStamped).

    Raises:
        EpisodeError: two topics give a frame different poses. The message names both.
    """
    owners: dict[str, dict[str, list[Any]]] = {}
    for topic, item in transforms:
        owners.setdefault(_plain(item.child_frame_id), {}).setdefault(topic, []).append(item)
    for child, by_topic in owners.items():
        if len(by_topic) > 1 and not _agree([item for held in by_topic.values() for item in held]):
            raise EpisodeError(
                f"{where}: several topics of transforms place {child!r} differently: {', '.join(sorted(by_topic))}. Name "
                f"those to take with --topic, such as `--topic {min(by_topic)}`. Name /tf_static "
                "too, if it is needed."
            )


def _agree(items: Sequence[Any]) -> bool:
    """Whether all transforms have the same parent and pose, within the tolerance."""
    if len({_plain(item.header.frame_id) for item in items}) > 1:
        return False
    moves = np.array([[getattr(item.transform.translation, axis) for axis in "xyz"] for item in items])
    turns = np.array([[getattr(item.transform.rotation, axis) for axis in "xyzw"] for item in items])
    along = np.abs(turns @ turns[0])
    return bool(np.abs(moves - moves[0]).max() <= _MOVED_M and (along >= np.cos(_MOVED_RAD / 2)).all())


class TransformTree:
    """All transforms of a recording as a tree of frames.

    Args:
        transforms: (time [s], geometry_msgs/TransformStamped).
    """

    def __init__(self, transforms: list[tuple[float, Any]]) -> None:
        grouped: dict[str, list[tuple[float, Any]]] = {}
        for t, item in transforms:
            grouped.setdefault(_plain(item.child_frame_id), []).append((t, item))
        self._edges: dict[str, _Edge] = {}
        self._doubtful: dict[str, list[str]] = {}
        self.warnings: list[str] = []
        for child, every in grouped.items():
            entries = [(t, item) for t, item in every if _is_valid(item.transform)]
            if len(entries) < len(every):
                left = f"{len(every) - len(entries)} of {len(every)} transforms of {child!r}"
                self.warnings.append(f"{left} in tf are invalid (a zero quaternion, or not finite), and were left out.")
            if not entries:
                continue
            parents = sorted({_plain(item.header.frame_id) for _, item in entries})
            if len(parents) > 1:
                self._doubtful[child] = parents
                continue
            entries.sort(key=lambda entry: entry[0])
            moves = [item.transform for _, item in entries]
            matrices = np.tile(np.eye(4), (len(moves), 1, 1))
            turns = [[move.rotation.x, move.rotation.y, move.rotation.z, move.rotation.w] for move in moves]
            matrices[:, :3, :3] = Rotation.from_quat(np.array(turns)).as_matrix()
            matrices[:, :3, 3] = [[move.translation.x, move.translation.y, move.translation.z] for move in moves]
            self._edges[child] = _Edge(parents[0], np.array([t for t, _ in entries]), matrices)

    def lookup(self, target: str, source: str, times: Floats) -> Floats:
        """[T, 4, 4] transform from `source` to `target` at times [T]. Each edge uses its nearest stamp.

        Raises:
            EpisodeError: tf does not connect the frames, or a frame between them has two parents.
        """
        up, down = self._way(target, source)
        return np.linalg.inv(self._chain(down, times)) @ self._chain(up, times)

    @property
    def frames(self) -> set[str]:
        """All that a transform has as parent or child."""
        return {*self._edges, *(edge.parent for edge in self._edges.values())}

    def root(self, frame: str) -> str:
        """The frame without a parent to which this one belongs."""
        return self._above(frame)[-1]

    def moving_stamps(self, target: str, source: str) -> list[Floats]:
        """Stamps [N] [s] of each transform between two frames that changes, so not of tf_static.

        Raises:
            EpisodeError: as `lookup`.
        """
        return [edge.stamps for edge in self._edges_on(target, source) if np.ptp(edge.matrices, axis=0).any()]

    def _edges_on(self, target: str, source: str) -> list[_Edge]:
        return [self._edges[frame] for way in self._way(target, source) for frame in way]

    def stamps(self, frame: str) -> Floats:
        """[N] times at which the frame's pose relative to its parent was sent [s]. Empty if never."""
        edge = self._edges.get(_plain(frame))
        return np.empty(0) if edge is None else edge.stamps

    def fixed(self, target: str, source: str) -> Floats:
        """[4, 4] constant transform from `source` to `target`.

        Raises:
            EpisodeError: as `lookup`, or `source` moves relative to `target`.
        """
        stamps = [edge.stamps for edge in self._edges_on(target, source)]
        times = np.unique(np.concatenate([np.zeros(1), *stamps]))
        poses = self.lookup(target, source, times[:: 1 + len(times) // _LOOKED_AT])
        turns = Rotation.from_matrix(poses[:, :3, :3]) * Rotation.from_matrix(poses[0, :3, :3]).inv()
        moved, turned = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max(), turns.magnitude().max()
        if moved > _MOVED_M or turned > _MOVED_RAD:
            raise EpisodeError(
                f"in tf {_plain(source)!r} moves relative to {_plain(target)!r}, by {1000 * moved:.0f} mm and "
                f"{np.rad2deg(turned):.1f} degrees"
            )
        return np.asarray(poses[0])

    def _way(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Return the frames from `source`, and from `target`, up to but without their nearest common ancestor."""
        up, down = self._above(source), self._above(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            for frame in (up[-1], down[-1]):
                if frame in self._doubtful:
                    parents = " and ".join(map(repr, self._doubtful[frame]))
                    raise EpisodeError(f"tf gives the frame {frame!r} two parents, {parents}; it must have one")
            frames = self.frames
            known = f"its frames are {', '.join(sorted(frames))}" if frames else "the recording has none"
            raise EpisodeError(f"tf does not connect {_plain(source)!r} with {_plain(target)!r}; {known}")
        return up[: up.index(common)], down[: down.index(common)]

    def _above(self, frame: str) -> list[str]:
        """Return the frame and its ancestors up to the root."""
        found = [_plain(frame)]
        while found[-1] in self._edges and self._edges[found[-1]].parent not in found:
            found.append(self._edges[found[-1]].parent)
        return found

    def _chain(self, frames: list[str], times: Floats) -> Floats:
        """[T, 4, 4] transform from frames[0] to the parent of the last frame. Each frame is the child of the next."""
        result = np.tile(np.eye(4), (len(times), 1, 1))
        for frame in frames:
            result = self._edges[frame].at(times) @ result
        return result


def _is_valid(transform: Any) -> bool:
    turn, shift = transform.rotation, transform.translation
    quaternion, numbers = [turn.x, turn.y, turn.z, turn.w], [shift.x, shift.y, shift.z]
    return bool(np.isfinite([*quaternion, *numbers]).all() and np.linalg.norm(quaternion) > _LEAST_NORM)


def _plain(frame: str) -> str:
    """Normalise a frame name. ROS 1 allows a leading slash."""
    return frame.strip("/")
