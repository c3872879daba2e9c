"""One episode prepared for the loss: compared frames, weighted points, camera views and the gripper track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from diffcloud.clouds.neighbours import NeighbourIndex
from diffcloud.errors import EpisodeError
from diffcloud.estimation.pose import ONE_CLOCK, PoseSpace, clocks_of
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.simulate import rollout
from diffcloud.sim.system import System

_CUT_M = 0.002
"""The recording counts as cropped if its lowest points are this far [m] above the lowest initial cloth node."""
_LOWEST = 0.005
"""Fraction of the recorded points that noise may move below the crop height."""
_USABLE = 0.05
"""A frame is usable if this fraction of the cloth is above the crop height."""
_MOST = 30
"""Maximum number of frames that are compared by default. More frames of a fast recording add little information."""
_OUT_OF_REACH = 1e9
_UNSURE_M = 0.005
"""A recorded point with this standard deviation of its depth [m] gets half the weight."""


@dataclass(frozen=True)
class LostPixels:
    """Invalid-pixel masks of one camera. Neighbours of invalid pixels are masked too, since they may see the cloth only
    partly. (In a lift with the true parameters, the few points beside invalid pixels caused half of the loss.)"""

    T_camera_scene: Tensor
    """[3, 4] transform from the scene to the camera."""
    lens: Tensor
    """[2, 2] focal lengths (fx, fy) and principal point (cx, cy) [px]."""
    pixels: Tensor
    """bool [L, H, W], True if a pixel is invalid or beside an invalid one."""

    def blind(self, points: Tensor) -> Tensor:
        """Return which points [B, L, N, 3] of the recording's frame the camera cannot record, bool [B, L, N]: behind
        the camera, outside the image, or at a masked pixel."""
        frames, height, width = self.pixels.shape
        x, y, z = (points @ self.T_camera_scene[:, :3].T + self.T_camera_scene[:, 3]).unbind(-1)
        (fx, fy), (cx, cy) = self.lens.tolist()
        depth = z.clamp(min=1e-9)
        column, row = (fx * x / depth + cx).round(), (fy * y / depth + cy).round()
        inside = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)  # False for NaN
        place = torch.where(inside, row * width + column, 0.0).long() + torch.arange(frames)[:, None] * height * width
        return ~inside | self.pixels.flatten()[place]


@dataclass(frozen=True)
class Crop:
    """Height below which points were removed from a recording."""

    height: float
    noise: Tensor
    """[L] mean squared distance of recorded points from the surface in each frame."""

    def weights(self, heights: Tensor) -> Tensor:
        """Return weights of points [..., L, N] by their heights: 0 below the crop height, 1 beyond the range of the noise.

        Noise lifts a few of the many points on the table above the crop height. Near it, they can outnumber those of the
        cloth. NaN gets 0.
        """
        above = heights - self.height
        scale = (2 * self.noise).clamp(min=torch.finfo(self.noise.dtype).tiny)[:, None]
        return torch.where(above > 0, -torch.expm1(-above.square() / scale), 0.0)

    def at(self, chosen: list[int]) -> Crop:
        """Return the crop for the frames with these indices."""
        return Crop(self.height, self.noise[chosen])


@dataclass(frozen=True)
class Target:
    """One episode prepared for the loss, with L frames."""

    frames: tuple[int, ...]
    """[L] frame numbers in the episode."""
    times: Tensor
    """[L] times [s]."""
    clouds: tuple[NeighbourIndex, ...]
    """[L] points of all cameras."""
    views: tuple[tuple[NeighbourIndex, ...], ...]
    """[C][L] points of each clock of `space`. A single distant point stands for an empty cloud."""
    sure: tuple[tuple[Tensor, ...], ...]
    """[C][L] weights of these points; zero for an empty cloud."""
    crop: Crop | None
    """None: the recording was not cropped."""
    viewpoints: Tensor | None
    """[cameras, 3] positions of the cameras in the recording's frame; None if unknown."""
    lost: tuple[LostPixels, ...]
    """Invalid-pixel mask of each camera; empty if unknown."""
    planes: Tensor | None
    """[cameras, 4] crop planes (a, b, c, d) in the recording's frame, or None without crop. Each camera's points with a
    x + b y + c z < d were removed."""
    watching: tuple[list[int], ...]
    """[C] indices of the cameras that use each clock."""
    space: PoseSpace
    track: Tensor | None
    """[1, S, G, 3] gripper displacements."""

    def blind(self, cameras: Sequence[int], points: Tensor) -> Tensor | None:
        """Return which of these cameras cannot record points [B, L, N, 3] of the recording's frame, bool [B, L, N, C].
        Occlusion is not considered. The result is None if masks and crop planes are unknown."""
        if not self.lost and self.planes is None:
            return None
        found = torch.zeros(*points.shape[:-1], len(cameras), dtype=torch.bool)
        if self.lost:
            found |= torch.stack([self.lost[camera].blind(points) for camera in cameras], dim=-1)
        if self.planes is not None:
            planes = self.planes[list(cameras)]
            found |= points @ planes[:, :3].T < planes[:, 3]
        return found

    def at(self, chosen: Sequence[int]) -> Target:
        """Return this target with a subset of its frames, chosen by their indices 0..L-1."""
        chosen = list(chosen)
        first = chosen == list(range(len(chosen)))
        index = slice(len(chosen)) if first else chosen  # a slice is a view, which avoids a copy of the large masks
        return replace(
            self,
            frames=tuple(self.frames[one] for one in chosen),
            times=self.times[index],
            crop=None if self.crop is None else self.crop.at(chosen),
            clouds=tuple(self.clouds[one] for one in chosen),
            views=tuple(tuple(view[one] for one in chosen) for view in self.views),
            sure=tuple(tuple(sure[one] for one in chosen) for sure in self.sure),
            lost=tuple(replace(one, pixels=one.pixels[index]) for one in self.lost),
        )


def read_target(
    scenario: Scenario,
    system: System,
    episode: Episode,
    named: Sequence[int] | None,
    *,
    whole: bool,
    nuisance: Mapping[str, float],
) -> Target:
    """Prepare an episode for the loss.

    Args:
        named: frames to compare, negative numbers count from the end; None for all usable frames.
        whole: use all simulated points, without crop height, camera positions and clocks (loss of the paper).
        nuisance: pose variables -> standard deviation of the prior [m, rad, s].

    Raises:
        EpisodeError: a frame is missing, after the end of the simulation, or without points above the crop height, no
            frame is usable, the grippers differ from the scene's, or viewpoints, crop planes or clocks are invalid.
        ConfigError: a pose variable is unknown.
    """
    unit = scenario.length_unit_m
    clocks = ONE_CLOCK if whole else clocks_of(episode)
    track = None
    if episode.gripper is not None:
        moved = track_displacement(episode, system.handles.grippers, scenario.steps, system.time_step)
        track = torch.as_tensor(moved, dtype=torch.float64)[None]
    height = None if whole else _found_cut(system, episode, unit)
    frames = (
        _spread(_usable(scenario, system, episode, track, height, max(clocks.values())))
        if named is None
        else list(dict.fromkeys(_checked(scenario, episode, frame) for frame in named))
    )
    clouds = tuple(NeighbourIndex(torch.as_tensor(episode.frame(frame), dtype=torch.float64)) for frame in frames)
    crop, every = None, [_sure(episode, frame) for frame in frames]
    if height is not None:
        crop = Crop(height, torch.tensor([cloud.from_surface[1] for cloud in clouds], dtype=torch.float64))
        every = [
            known * crop.at([index]).weights(cloud.points[None, :, 2])[0]
            for index, (known, cloud) in enumerate(zip(every, clouds, strict=True))
        ]
        hidden = [str(frame) for frame, weights in zip(frames, every, strict=True) if not weights.any()]
        if hidden:  # named frames; others have points above
            raise EpisodeError(
                f"Frames {', '.join(hidden)} have no point above the crop height, {height * unit:.3f} m. Omit them from "
                "--frames or the scene's loss_frames."
            )
    views, sure = [clouds], [tuple(every)]
    watching = [[] if whole else list(range(len(episode.viewpoints)))]
    if clocks is not ONE_CLOCK:
        cameras = (_of_camera(episode, frames, every, camera) for camera in range(len(clocks)))
        views, sure = map(list, zip(*cameras, strict=True))
        watching = _watching(episode)
    centre = torch.as_tensor(episode.points.mean(0, dtype=np.float64))  # independent of the chosen frames
    return Target(
        tuple(frames),
        torch.as_tensor(episode.times[frames], dtype=torch.float64),
        clouds,
        tuple(views),
        tuple(sure),
        crop,
        None if whole or not episode.viewpoints else torch.from_numpy(np.stack(list(episode.viewpoints.values()))),
        () if whole else _lost(episode, frames),
        None if whole else _planes(episode),
        tuple(watching),
        PoseSpace.build(nuisance, centre, length_unit_m=unit, clocks=clocks),
        track,
    )


def _of_camera(
    episode: Episode, frames: Sequence[int], every: Sequence[Tensor], camera: int
) -> tuple[tuple[NeighbourIndex, ...], tuple[Tensor, ...]]:
    """Return the points of one camera in each frame, and their weights.

    Args:
        every: weights of all points of each frame.
    """
    assert episode.camera is not None
    views, sure = [], []
    for frame, known in zip(frames, every, strict=True):
        own = episode.camera[episode.offsets[frame] : episode.offsets[frame + 1]] == camera
        points = torch.as_tensor(episode.frame(frame)[own], dtype=torch.float64)
        views.append(NeighbourIndex(points if len(points) else torch.full((1, 3), _OUT_OF_REACH, dtype=torch.float64)))
        sure.append(known[own] if len(points) else torch.zeros(1, dtype=torch.float64))
    return tuple(views), tuple(sure)


def _watching(episode: Episode) -> list[list[int]]:
    """Return the indices of the cameras that use each clock.

    Raises:
        EpisodeError: a camera has a position but no clock, or the reverse.
    """
    standing = list(episode.viewpoints)
    if standing and set(standing) != set(episode.clocks):
        raise EpisodeError(
            f"The episode's meta has viewpoints of {', '.join(standing)} and, with `clocks`, the cameras "
            f"{', '.join(episode.clocks)}; both must name the same cameras."
        )
    return [[standing.index(camera)] if standing else [] for camera in episode.clocks]


def _lost(episode: Episode, frames: Sequence[int]) -> tuple[LostPixels, ...]:
    """Return the invalid-pixel mask of each camera.

    Raises:
        EpisodeError: the cameras with masks differ from those with known positions.
    """
    if episode.lost is None:
        return ()
    if list(episode.meta["pinholes"]) != list(episode.viewpoints):
        raise EpisodeError(
            f"The episode's meta has pinholes of {', '.join(episode.meta['pinholes'])} and viewpoints of "
            f"{', '.join(episode.viewpoints) or 'no camera'}; both must name the same cameras, in the same order."
        )
    found = enumerate(episode.pinholes)
    return tuple(
        LostPixels(
            torch.from_numpy(pinhole.T_camera_scene),
            torch.tensor([pinhole.focal, pinhole.centre], dtype=torch.float64),
            _widened(torch.from_numpy(episode.lost_pixels(camera)[list(frames)])),
        )
        for camera, pinhole in found
    )


def _planes(episode: Episode) -> Tensor | None:
    """Return the crop planes of the cameras with known positions. A plane of zeros stands for no crop."""
    planes = episode.cut_planes
    found = [planes.get(name, np.zeros(4)) for name in episode.viewpoints]
    return torch.from_numpy(np.stack(found)) if planes and found else None


def _widened(pixels: Tensor) -> Tensor:
    """Dilate masks, bool [L, H, W], by one pixel to all sides."""
    return torch.nn.functional.max_pool2d(pixels[:, None].float(), 3, stride=1, padding=1)[:, 0] > 0


def _spread(frames: list[int]) -> list[int]:
    """Choose at most `_MOST` frames, evenly spread, including the last."""
    if len(frames) <= _MOST:
        return frames
    return [frames[index] for index in np.unique(np.linspace(0, len(frames) - 1, _MOST).round().astype(int))]


def _end(scenario: Scenario) -> float:
    """Return the latest time that can be compared [s]."""
    return scenario.steps * scenario.scene.time_step + 0.5 * scenario.scene.frame_time


def _checked(scenario: Scenario, episode: Episode, frame: int) -> int:
    episode.frame(frame)  # raises
    if episode.times[frame] > _end(scenario):
        raise EpisodeError(
            f"A loss frame lies at {episode.times[frame]:.3f} s, but scenario {scenario.name} simulates only "
            f"{scenario.steps * scenario.scene.time_step:.3f} s. Use a scenario with more frames, or another loss frame."
        )
    return frame % episode.frame_count


def _usable(
    scenario: Scenario, system: System, episode: Episode, track: Tensor | None, cut: float | None, late: float
) -> list[int]:
    """Return the frames within the simulated time in which enough of the cloth, and a recorded point, are above the crop
    height.

    The fraction of the cloth is computed from a simulation with the nominal material.

    Args:
        late: largest clock offset [s].
    """
    end = _end(scenario) - max(late, 0.0)
    frames = [index for index, time in enumerate(episode.times) if 0 < time <= end]
    if cut is not None and frames:
        with torch.no_grad():
            run = rollout(system, scenario.steps, track=track, drop_diverged=True)
        heights = run.at(torch.as_tensor(episode.times[frames]))[0, ..., 2]
        above = ((heights >= cut) | heights.isnan()).double().mean(-1)  # NaN after divergence counts as above
        frames = [
            frame
            for frame, part in zip(frames, above.tolist(), strict=True)
            if part >= _USABLE and (episode.frame(frame)[:, 2] > cut).any()
        ]
    if not frames:
        unit, simulated = scenario.length_unit_m, scenario.steps * scenario.scene.time_step
        told = "" if cut is None else f", less than {_USABLE:.0%} of the cloth lies above the cut, {cut * unit:.3f} m"
        raise EpisodeError(
            f"No frame of the episode can be compared: they lie at {episode.times[0]:.3f} to {episode.times[-1]:.3f} s, "
            f"scenario {scenario.name} simulates {simulated:.3f} s{told}. Name some with --frames, or check "
            "times and crops."
        )
    return frames


def _found_cut(system: System, episode: Episode, unit: float) -> float | None:
    """Return the height below which the recording was cropped, or None. If each camera has a crop plane, this is the
    lowest height of the planes at the centre of the cloth. Otherwise the height is estimated from the points."""
    planes = episode.cut_planes
    if planes and planes.keys() >= episode.viewpoints.keys() and all(plane[2] > 0 for plane in planes.values()):
        x, y, _ = system.mesh.nodes.mean(axis=0)
        return min(float(d - a * x - b * y) / float(c) for a, b, c, d in planes.values())
    if not system.setup.surrounding.obstacles:  # points are cut off above a table, and there is none
        return None
    low = float(np.quantile(episode.points[:, 2], _LOWEST))
    return low if low > system.mesh.nodes[:, 2].min() + _CUT_M / unit else None


def _sure(episode: Episode, frame: int) -> Tensor:
    """Return the weight of each point of a frame, from its depth uncertainty `sigma`."""
    begin, end = episode.offsets[frame], episode.offsets[frame + 1]
    if episode.sigma is None:
        return torch.ones(int(end - begin), dtype=torch.float64)
    sigma = torch.as_tensor(episode.sigma[begin:end], dtype=torch.float64)
    return 1 / (1 + (sigma / _UNSURE_M) ** 2)


def track_displacement(episode: Episode, grippers: Sequence[str], steps: int, time_step: float) -> np.ndarray:
    """Return displacements [S, G, 3] of the scene's grippers since time zero at the end of each step, in the episode's
    unit.

    They follow a cubic spline through the recorded positions, and are constant after the last one. If the first frame
    is later than time zero, the gripper stays at its first position until then.

    Raises:
        EpisodeError: the recorded grippers differ from the scene's. (A single gripper needs no name.)
    """
    assert episode.gripper is not None
    if len(grippers) == len(episode.grippers) == 1:
        recorded = [0]
    elif set(grippers) == set(episode.grippers):
        recorded = [episode.grippers.index(name) for name in grippers]
    else:
        raise EpisodeError(
            f"The scene's grippers are {', '.join(grippers) or 'none'}, the episode's {', '.join(episode.grippers)}; give "
            "both the same names, in the scenario's `grippers` or in the tracks that are imported."
        )
    if len(episode.times) < 2:
        return np.zeros((steps, len(grippers), 3))
    times, positions = episode.times, episode.gripper[:, recorded]
    at = np.clip(np.cumsum(np.full(steps, time_step)), times[0], times[-1])
    from scipy.interpolate import CubicSpline  # slow to import

    return np.asarray(CubicSpline(times, positions)(at) - positions[0])
