"""Search for the initial state of a recorded cloth that hangs from its gripper.

A cloth may hang from a whole side, from the two corners of a side (taut or slack), or from one corner. Each hypothesis is
simulated until the cloth is at rest, aligned with the first cloud, and ranked by its RMS distance. A side and its two
corners often look alike at rest. Then the recorded motion decides. If that is not clear either, the side is chosen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from diffcloud.clouds.surface import NO_GUESS, find_on_surface
from diffcloud.errors import DivergedError, EpisodeError, SceneError
from diffcloud.estimation.targets import track_displacement
from diffcloud.io.episodes import Episode
from diffcloud.io.stamps import corrected_stamps
from diffcloud.scene.scenarios.catalogue import own_options
from diffcloud.scene.scenarios.hang import HangScenario, hang_scenario
from diffcloud.scene.scenarios.layout import Found, Layout
from diffcloud.sim.simulate import rollout

Floats = NDArray[np.float64]

HANG_FIELDS = ("held", "side", "rim_m", "yaw_deg", "span", "rate_hz", "frames", "steps_per_frame", "path")
"""Scenario fields that `find_hanging` determines."""
_STILL_M = 0.005
"""Displacement [m] below which the gripper is at rest."""
_FIRST_FRAMES, _FIRST_POINTS = 10, 3000
_UPRIGHT = 0.4
"""Minimum ratio of height to horizontal extent of a hanging cloud."""
_RIM = 0.12
"""Fraction of the height, from the top, that shows the held side."""
_EDGE = 0.01
"""Quantile of coordinates that is taken as the end of the cloud, because of noise."""
_TAUT = 0.96
"""Span above which the cloth counts as taut."""
CAP_M, WORST_M = 0.05, 0.025
"""Cap of a single distance, and largest accepted RMS distance of the best hypothesis [m]."""
_TIE, _SAME = 1.25, 1.1
"""Factors of the RMS distance within which hypotheses count as equal, at rest and in motion."""
_MOTION_FRAMES, _MOTION_S = 15, 3.0
_ALIGNING = 8
"""Number of iterations of the alignment."""
_FAR_M, _NEAR_M = 0.25, 0.03
"""Distances [m] of the held part from the gripper: refused above the first, and a warning above the second."""
_LONGEST_STEP_S = 0.02
"""Longest time step [s]. Longer steps would damp the swing."""
_REST_S = 1.0
"""Simulated time [s] before the first cloud. The initial state is the equilibrium of the nominal material, and in this time
the cloth comes to rest with the parameters of the fit."""
_PREPARED = "rest_s"
"""Key in the meta of a prepared episode: the time that was added."""
_SIGMAS = {"x": 0.01, "y": 0.01, "z": 0.01, "yaw": 0.1, "tilt_x": 0.035, "tilt_y": 0.035}
"""Prior standard deviations of the pose [m, rad]: of the held part, and of the cameras relative to gravity."""
_LAG_S = (0.05, 0.01)
"""Prior standard deviation [s] of the common lag, without and with corrected stamps."""


@dataclass(frozen=True)
class _Hypothesis:
    """A way to hang, aligned with the first cloud, and its RMS distance."""

    options: HangScenario
    rms_m: float

    @property
    def words(self) -> str:
        name = {"edge": "side", "corners": "two corners", "corner": "corner"}[self.options.held]
        slack = f", span {self.options.span:.2f}" if self.options.span < 1 else ""
        return f"{name} ({self.options.side}{slack}) {1e3 * self.rms_m:.0f} mm"


def hangs(episode: Episode) -> bool:
    """Return whether the first cloud is upright and below the gripper."""
    if episode.gripper is None:
        return False
    cloud = _first_cloud(episode)
    low, high = np.quantile(cloud, [_EDGE, 1 - _EDGE], axis=0)
    wide = float(np.linalg.norm((high - low)[:2]))
    return bool(high[2] - low[2] > _UPRIGHT * wide and episode.gripper[0, 0, 2] > np.median(cloud[:, 2]))


def hanging_size(episode: Episode) -> tuple[float, float]:
    """Return the extents [m] of the first cloud, longer one first: the sides of a cloth that hangs from a side."""
    cloud = _first_cloud(episode)
    along, _ = _axes(cloud)
    sides = [float(np.ptp(np.quantile(values, [_EDGE, 1 - _EDGE]))) for values in (cloud @ along, cloud[:, 2])]
    return max(sides), min(sides)


def prepared(episode: Episode) -> tuple[Episode, str]:
    """Prepare the recording of a hanging cloth for fits. A prepared recording is returned unchanged.

    Late stamps are corrected, time to come to rest is added before the first cloud, and priors of the pose are stated.

    Returns:
        The episode, and a sentence about corrected stamps, which is empty if none were corrected.
    """
    if _PREPARED in episode.meta:
        return episode, ""
    found, lags = corrected_stamps(episode)
    sigmas = {**_SIGMAS, "lag": _LAG_S[lags is not None], **episode.pose_sigmas}
    found = replace(found, times=found.times + _REST_S, meta={**found.meta, "pose_sigmas": sigmas, _PREPARED: _REST_S})
    return found, "" if lags is None else lags.sentence


def find_hanging(episode: Episode, cloth: Mapping[str, Any]) -> Layout:
    """Determine how the cloth of a recording hangs at the start.

    Args:
        episode: recording in metres, z up, with the track of one gripper.
        cloth: fields of a `hang` scenario that all recordings share, such as size and material.

    Raises:
        EpisodeError: no hypothesis is within 25 mm of the first cloud, or the gripper is too far from the held part. The
            message has all distances.
    """
    assert episode.gripper is not None
    if len(episode.grippers) > 2:
        raise EpisodeError(
            f"The recording has the grippers {', '.join(episode.grippers)}. A hanging cloth is held by one, or by two at "
            "the corners of a side. Leave the other tracks out."
        )
    cloud, grippers = _first_cloud(episode), episode.gripper[0]
    shared = _course(episode)
    base = {**cloth, **{name: one.value for name, one in shared.items()}}
    tried: list[_Hypothesis] = []
    for fields in _ways(cloud, tuple(cloth["size_m"])):
        if len(grippers) > 1 and fields["held"] != "corners":
            continue
        options = own_options({**base, **fields}, "hang", "the cloth", folder=Path())
        assert isinstance(options, HangScenario)
        try:
            tried.append(_held_by(_aligned(options, cloud), episode))
        except SceneError:  # it does not come to rest
            continue
    tried.sort(key=lambda one: one.rms_m)
    scores = "; ".join(one.words for one in tried)
    if not tried or tried[0].rms_m > WORST_M:
        raise EpisodeError(
            f"The first cloud does not match a cloth of {' x '.join(f'{x:g}' for x in cloth['size_m'])} m that hangs at "
            f"rest. RMS distances: {scores}; at most {1e3 * WORST_M:.0f} mm are allowed. Check --size, that clouds and "
            "gripper are in metres in one frame with z up, and that the cloud shows the whole cloth and nothing else."
        )
    ties = [one for one in tried if one.rms_m < _TIE * tried[0].rms_m]
    best, reason = _by_motion(ties, episode) if len(ties) > 1 else (ties[0], "nearest to the first cloud")
    chosen = best.options
    warnings = _refuse_far(np.array(chosen.rim_m), grippers.mean(axis=0))
    found = {
        "held": Found(chosen.held, f"{reason}: {scores}"),
        "side": Found(chosen.side, "the held side, along the cloth's own x or y"),
        "rim_m": Found([round(x, 4) for x in chosen.rim_m], "where the settled cloth is nearest to the first cloud"),
        "yaw_deg": Found(round(chosen.yaw_deg % 360, 2), "likewise"),
        "span": Found(round(chosen.span, 3), "distance of the held corners over the length of their side"),
        **({"grippers": Found(list(chosen.grippers), "gripper of each corner")} if len(grippers) > 1 else {}),
        **shared,
    }
    return Layout(found, tuple(warnings))


def _course(episode: Episode) -> dict[str, Found]:
    """Return the scenario fields of time and path of a recording that begins with a hanging cloth."""
    assert episode.gripper is not None
    gripper = episode.gripper[:, 0]
    interval = float(np.median(np.diff(episode.times))) if episode.frame_count > 1 else 0.1
    return {
        "rate_hz": Found(round(1 / interval, 6), f"frames are {interval:.4f} s apart"),
        "frames": Found(
            max(math.ceil(float(episode.times[-1]) / interval), 1), f"the recording ends at {episode.times[-1]:.3f} s"
        ),
        "steps_per_frame": Found(max(math.ceil(interval / _LONGEST_STEP_S), 1), "steps of at most 20 ms"),
        "path": Found(
            [[0.0, 0.0, 0.0, 0.0], [float(episode.times[-1]), *(round(float(x), 4) for x in gripper[-1] - gripper[0])]],
            "first and last position of the gripper; fits follow its recorded track",
        ),
    }


def _refuse_far(held: Floats, gripper: Floats) -> list[str]:
    """Return a warning if the held part [3] is not at the gripper [3].

    Raises:
        EpisodeError: it is more than 0.25 m away.
    """
    away = float(np.linalg.norm(held - gripper))
    if away > _FAR_M:
        raise EpisodeError(
            f"The held part of the cloth is {away:.2f} m from the gripper; at most {_FAR_M:g} m are allowed. Clouds and "
            "gripper must be in one frame, in metres, z up."
        )
    if away <= _NEAR_M:
        return []
    return [f"the held part of the cloth is {1e3 * away:.0f} mm from the gripper; it follows the gripper without turning"]


def _first_cloud(episode: Episode) -> Floats:
    """Return points [N, 3] of the frames before the gripper moves [m]."""
    assert episode.gripper is not None
    way = np.linalg.norm(episode.gripper - episode.gripper[0], axis=2).max(axis=1)
    still = int(np.argmax(way > _STILL_M)) if (way > _STILL_M).any() else episode.frame_count
    points = np.concatenate([episode.frame(frame) for frame in range(min(max(still, 1), _FIRST_FRAMES))])
    return points[:: max(len(points) // _FIRST_POINTS, 1)].astype(np.float64)


def _axes(cloud: Floats) -> tuple[Floats, Floats]:
    """Return the horizontal direction [3] of the longest extent of a cloud, and the one perpendicular to it."""
    level = cloud[:, :2] - cloud[:, :2].mean(axis=0)
    x, y = np.linalg.eigh(level.T @ level)[1][:, -1]
    return np.array([x, y, 0.0]), np.array([-y, x, 0.0])


def _ways(cloud: Floats, size: tuple[float, float]) -> list[dict[str, Any]]:
    """Return the scenario fields of each hypothesis."""
    along, normal = _axes(cloud)
    yaw = math.degrees(math.atan2(along[1], along[0]))
    low, top = np.quantile(cloud[:, 2], [_EDGE, 1 - _EDGE])
    rim = cloud[cloud[:, 2] > top - _RIM * (top - low)]
    left, right = np.quantile(rim @ along, [_EDGE, 1 - _EDGE])
    middle = 0.5 * (left + right) * along + float(np.median(rim @ normal)) * normal + [0.0, 0.0, top]
    highest = cloud[cloud[:, 2].argsort()[-max(len(cloud) // 100, 1) :]].mean(axis=0)
    ways: list[dict[str, Any]] = []
    for side, length in zip("xy", size, strict=True):
        if side == "y" and math.isclose(*size, rel_tol=0.02):
            break  # a square looks the same from both sides
        straight = {"side": side, "rim_m": middle.tolist(), "yaw_deg": yaw}
        ways += [{"held": held, **straight} for held in ("edge", "corners")]
        for span in {round(s, 3) for s in (0.8, 0.9, (right - left) / length) if 0.35 < s < _TAUT}:
            ways += [{"held": "corners", **straight, "span": span, "yaw_deg": (yaw + turn) % 360} for turn in (0.0, 180.0)]
    # a cloth at a corner folds to one of several equilibria, which lie at different turns
    turns = np.arange(0.0, 360.0, 45.0)
    return [*ways, *({"held": "corner", "rim_m": highest.tolist(), "yaw_deg": (yaw + turn) % 360} for turn in turns)]


def _held_by(one: _Hypothesis, episode: Episode) -> _Hypothesis:
    """Assign each of two held corners to the gripper at its place."""
    assert episode.gripper is not None
    names = episode.grippers
    if len(names) == 1:
        return one
    options, yaw = one.options, math.radians(one.options.yaw_deg)
    along = options.span * options.size_m["xy".index(options.side)] * np.array([math.cos(yaw), math.sin(yaw), 0.0])
    apart = episode.gripper[0, 1] - episode.gripper[0, 0]
    ordered = names if float(apart @ along) > 0 else names[::-1]
    return replace(one, options=options.model_copy(update={"grippers": ordered}))


def _aligned(options: HangScenario, cloud: Floats) -> _Hypothesis:
    """Align a settled cloth with the cloud by translation and rotation about the vertical (ICP)."""
    mesh = hang_scenario(options).scene.mesh
    nodes, faces, rim, turned = mesh.nodes, mesh.faces, np.array(options.rim_m), 0.0
    for _ in range(_ALIGNING):
        place = on_surface(cloud, nodes, faces)
        near = np.linalg.norm(cloud - place, axis=1) < CAP_M
        if near.sum() < 3:
            break
        a, b = place[near], cloud[near]
        level_a, level_b = (part[:, :2] - part[:, :2].mean(axis=0) for part in (a, b))
        angle = math.atan2(
            float((level_a[:, 0] * level_b[:, 1] - level_a[:, 1] * level_b[:, 0]).sum()), float((level_a * level_b).sum())
        )
        cosine, sine = math.cos(angle), math.sin(angle)
        turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])  # for row vectors
        shift = b.mean(axis=0) - a.mean(axis=0) @ turn
        nodes, rim, turned = nodes @ turn + shift, rim @ turn + shift, turned + angle
    x, y, z = rim.tolist()
    placed = {"rim_m": (x, y, z), "yaw_deg": (options.yaw_deg + math.degrees(turned)) % 360}
    return _Hypothesis(options.model_copy(update=placed), both_ways(cloud, nodes, faces))


def both_ways(cloud: Floats, nodes: Floats, faces: NDArray[np.int64]) -> float:
    """Return the RMS distance between a cloud and a mesh in both directions, of distances of at most 50 mm [m]."""
    forth = np.linalg.norm(cloud - on_surface(cloud, nodes, faces), axis=1)
    back = cKDTree(cloud).query(nodes[faces].mean(axis=1))[0]
    return math.sqrt(0.5 * sum(float((np.minimum(one, CAP_M) ** 2).mean()) for one in (forth, back)))


def on_surface(points: Floats, nodes: Floats, faces: NDArray[np.int64]) -> Floats:
    """Return the nearest point [N, 3] on a mesh to each of N points."""
    found, weights = find_on_surface(points[None], NO_GUESS, np.ascontiguousarray(nodes)[None], faces)
    return np.asarray((nodes[faces[found[0]]] * weights[0][..., None]).sum(axis=1))


def _by_motion(ties: list[_Hypothesis], episode: Episode) -> tuple[_Hypothesis, str]:
    """Return the hypothesis with the motion nearest to the recording, and the reason in words.

    Among hypotheses that move alike, the one with the most held nodes is chosen.
    """
    first = float(episode.times[0])
    frames = [int(f) for f in np.flatnonzero(episode.times <= first + _MOTION_S)]
    frames = frames[:: max(len(frames) // _MOTION_FRAMES, 1)]
    scores = []
    for one in ties:
        scenario = hang_scenario(one.options)
        system, _ = scenario.scene.build()
        steps = math.ceil(float(episode.times[frames[-1]]) / system.time_step)
        track = torch.as_tensor(track_displacement(episode, system.handles.grippers, steps, system.time_step))[None]
        try:
            with torch.no_grad():
                run = rollout(system, steps, track=track).at(torch.as_tensor(episode.times[frames]))[0].numpy()
        except DivergedError:
            scores.append(math.inf)
            continue
        squares = []
        for nodes, frame in zip(run, frames, strict=True):
            points = episode.frame(frame).astype(np.float64)
            squares.append(float(((points - on_surface(points, nodes, system.mesh.faces)) ** 2).sum(axis=1).mean()))
        scores.append(math.sqrt(float(np.mean(squares))))
    alike = [one for one, score in zip(ties, scores, strict=True) if score <= _SAME * min(scores)]
    order = {"edge": 0, "corners": 1, "corner": 2}
    chosen = min(alike, key=lambda one: (order[one.options.held], one.rms_m))
    return chosen, "nearest to the first cloud" if len(alike) > 1 else "nearest to the motion"
