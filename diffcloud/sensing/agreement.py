"""Correction of the second camera against the first (pose, depth scale and clock), from recordings of one moving cloth.

Points of one camera lie on the surface that the other sees, where both see the same part of the cloth. A point q of the
second camera is corrected to

    q' = m + R(w) (e + exp(s) (q - e) - m) + t

with a rotation vector w and a shift t about the centre m of the clouds, and a scale s about the second camera e. A
frame of the second camera with time stamp T shows the motion at T + lag on the first camera's clock. Gauss–Newton
minimises point-to-plane distances in both directions, from points of one camera to the other's surface at that time.
The surface is interpolated quadratically between three frames. Outliers get Tukey weights.

Noise of the normals and velocities would look like information. For example, a flat cloth would seem to determine a
shift in its own plane. So both are measured twice: on the surface that a point is compared with (J), and on the point's
own surface (Z). They have the same mean and independent noise. Z'J therefore estimates the information without bias,
and Z'r = 0 is solved for the correction (instrumental variables, Wooldridge 2010, chapter 5). Directions in which Z'J
is as small as its noise are treated as not identifiable.

Surface errors are correlated between neighbouring points and frames. Sums over neighbouring frames estimate the
effective number of comparisons. The result is the posterior mean with the priors below. Directions with little
information stay near zero and keep the prior's standard deviation. A flat cloth does not determine an in-plane shift or
rotation, and a cloth at rest does not determine the lag.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Clock, Episode, Pinhole
from diffcloud.sensing.robust import deviation, tukey

Floats = NDArray[np.float64]

_PRIORS = np.array([np.radians(5.0)] * 3 + [0.05] * 3 + [0.03, 0.1])
"""Prior standard deviations of w [rad], t [m], s [1] and lag [s]."""
_SHOWN = 0.5
"""A direction is identifiable if its information exceeds this multiple of its noise. The noise assumes that all points
of a frame share their error. Noise alone reaches 0.2."""
_VOXEL_M = 0.006
"""Side of the voxels in which points are averaged [m], so that both cameras' surfaces are equally smooth."""
_NEIGHBOURS = 40
_SPREAD_M = 0.025
"""Maximum radius of the neighbours for a normal [m]. Points in sparser regions are dropped."""
_BORDER = 0.25
"""A point is at a border if its distance from the mean of its neighbours exceeds this fraction of their radius. Such
points are dropped, since the errors of their height and normal are correlated."""
_EDGE_M = 0.006
"""Maximum tangential distance from the nearest surface point [m]; beyond, a point is outside the surface."""
_ALIKE = 0.85
"""Minimum cosine between normals for two surfaces to match."""
_REACH_M = 0.06
"""Maximum distance between a point and the other surface in the adjacent frames [m]."""
_GATE_M = 0.02
"""Points farther from the surface are excluded [m]."""
_FIRST_GATES_M = (0.06, 0.06, 0.05, 0.04, 0.03, 0.03)
"""Larger limits for the first iterations [m]."""
_ITERATIONS = 30
_CONVERGED = 0.002
"""The iteration ends if the step is smaller than this, in standard deviations of the priors."""
_SHARED_FRAMES = 3
"""Number of adjacent frames with correlated errors, because they are compared with the same surfaces."""
_CLOCK_BIAS_S = 0.02
"""Additional standard deviation of a clock [s], for depth errors that this model lacks. On the published recordings,
estimates with other weights and surfaces differ by about this much."""
_UNKNOWN_CLOCK_S = 0.1
_SOURCES = 300
"""Number of points of each camera and frame that are compared."""
_LEAST_ROWS, _LEAST_FRAMES = 300, 5
"""Minimum number of compared points and frames."""


@dataclass(frozen=True)
class Agreement:
    """Correction of the second camera, to be applied to its points."""

    cameras: tuple[str, str]
    """Names of the first camera, which is unchanged, and of the second."""
    middle: Floats
    """[3] centre of the rotation [m]."""
    eye: Floats
    """[3] centre of the scaling [m], i.e. the second camera's position."""
    values: Floats
    """[8] w [rad], t [m], s, lag [s]; zero in directions that are not identifiable."""
    covariance: Floats
    """[8, 8] covariance of the values. Directions that are not identifiable keep that of the prior."""
    before_m: float
    after_m: float
    """RMS distances from points to the other camera's surface, before and after the correction [m]; NaN without
    points."""

    @property
    def sigmas(self) -> Floats:
        """[8] standard deviations of the values."""
        return np.sqrt(np.diag(self.covariance))

    def moved(self, points: Floats) -> Floats:
        """Apply the correction to points [N, 3] of the second camera [m]."""
        return self._matrix(points - self.eye) + self._shift()

    def pinhole(self, seen: Pinhole) -> Pinhole:
        """Return the second camera's model with corrected pose. The depth scale does not affect pixels."""
        T = seen.T_camera_scene
        R = T[:, :3] @ self._rotation().T
        return replace(seen, T_camera_scene=np.column_stack([R, -R @ self.moved(seen.position[None])[0]]))

    def plane(self, plane: Sequence[float]) -> list[float]:
        """Apply the correction to a half space a x + b y + c z >= d of the second camera's points."""
        normal, offset = np.array(plane[:3]), plane[3]
        on = self.moved((offset * normal / (normal @ normal))[None])[0]
        turned = self._rotation() @ normal
        return [*turned.tolist(), float(turned @ on)]

    def described(self) -> dict[str, Any]:
        """Return the correction as metadata in SI units."""
        names = ("rotation_rad", "translation_m", "log_scale", "clock_offset_s")
        parts: tuple[slice | int, ...] = (slice(0, 3), slice(3, 6), 6, 7)
        return {
            "method": "point to surface between two cameras, instrumental variables with Tukey weights",
            "about_m": self.middle.tolist(),
            "scale_about_m": self.eye.tolist(),
            **{name: self.values[part].tolist() for name, part in zip(names, parts, strict=True)},
            "sigmas": {name: self.sigmas[part].tolist() for name, part in zip(names, parts, strict=True)},
            "rms_before_m": self.before_m if np.isfinite(self.before_m) else None,
            "rms_after_m": self.after_m if np.isfinite(self.after_m) else None,
        }

    def _rotation(self) -> Floats:
        return np.asarray(Rotation.from_rotvec(self.values[:3]).as_matrix())

    def _matrix(self, vectors: Floats) -> Floats:
        return np.asarray(np.exp(self.values[6]) * vectors @ self._rotation().T)

    def _shift(self) -> Floats:
        """Return the corrected position [3] of the second camera."""
        return np.asarray(self.middle + self._rotation() @ (self.eye - self.middle) + self.values[3:6])

    def back(self, points: Floats) -> Floats:
        """Apply the inverse of `moved`."""
        return np.asarray(self.eye + np.exp(-self.values[6]) * (points - self._shift()) @ self._rotation())


@dataclass(frozen=True)
class _Surface:
    """Surface that one camera saw in one frame."""

    points: Floats
    """[N, 3] points, projected onto the planes through their neighbours."""
    normals: Floats
    tree: cKDTree | None

    @staticmethod
    def of(points: Floats, eye: Floats) -> _Surface:
        """Return the surface of points [N, 3] seen from a camera position [3], with normals towards the camera."""
        points = _thinned(points)
        if len(points) < 2 * _NEIGHBOURS:
            return _Surface(np.empty((0, 3)), np.empty((0, 3)), None)
        distance, index = cKDTree(points).query(points, _NEIGHBOURS)
        centre = points[index].mean(axis=1)
        inner = np.linalg.norm(points - centre, axis=1) < _BORDER * distance[:, -1]
        kept = inner & (distance[:, -1] < _SPREAD_M)
        own, centre = points[kept], centre[kept]
        away = points[index[kept]] - centre[:, None]
        normal = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))[1][..., 0]
        own = own - ((own - centre) * normal).sum(-1, keepdims=True) * normal
        normal *= np.sign(((eye - own) * normal).sum(-1, keepdims=True))
        return _Surface(own, normal, cKDTree(own) if len(own) else None)

    def height(self, points: Floats, facing: Floats) -> tuple[Floats, Floats]:
        """Return signed distances [N] of points above the surface, and the surface normals [N, 3]. A distance is NaN if
        no nearby surface has about the normal `facing` [N, 3]. This separates the two sides of the cloth and the layers
        of a fold."""
        height, normal = np.full(len(points), np.nan), np.zeros((len(points), 3))
        if self.tree is None or not len(points):
            return height, normal
        distance, index = self.tree.query(points, distance_upper_bound=_REACH_M)
        near = np.flatnonzero(np.isfinite(distance))
        away, n = points[near] - self.points[index[near]], self.normals[index[near]]
        above = (away * n).sum(-1)
        beside = np.sqrt(np.maximum((away**2).sum(-1) - above**2, 0.0)) < _EDGE_M
        beside &= (facing[near] * n).sum(-1) > _ALIKE
        height[near[beside]], normal[near[beside]] = above[beside], n[beside]
        return height, normal


def _thinned(points: Floats) -> Floats:
    """Return the mean [V, 3] of the points [N, 3] in each voxel."""
    cell = np.floor(points / _VOXEL_M).astype(np.int64)
    _, voxel, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    total = np.zeros((len(count), 3))
    np.add.at(total, voxel.reshape(-1), points)
    return np.asarray(total / count[:, None])


@dataclass(frozen=True)
class _Rows:
    J: Floats
    """[N, 8] derivatives, with normals and velocities of the surface that a point is compared with."""
    Z: Floats
    """[N, 8] derivatives, with normals and velocities of the point's own surface."""
    r: Floats
    """[N] residuals [m]."""
    frame: NDArray[np.int64]
    """[N] frame numbers."""


@dataclass(frozen=True)
class _Pair:
    """One recording by two cameras."""

    times: Floats
    surfaces: tuple[list[_Surface], list[_Surface]]
    sources: tuple[list[NDArray[np.int64]], list[NDArray[np.int64]]]
    """Indices of the points of these surfaces that are compared with the other camera's surface."""
    rates: tuple[list[Floats], list[Floats]]
    """[N] rate of the distance to the moving own surface, for each compared point [m/s]; NaN if unknown."""

    @staticmethod
    def of(episode: Episode, numbers: tuple[int, int], rng: np.random.Generator) -> _Pair:
        assert episode.camera is not None
        clouds: tuple[list[Floats], list[Floats]] = ([], [])
        for frame in range(episode.frame_count):
            begin, end = episode.offsets[frame], episode.offsets[frame + 1]
            for number, into in zip(numbers, clouds, strict=True):
                into.append(episode.points[begin:end][episode.camera[begin:end] == number].astype(np.float64))
        eyes = [episode.viewpoints[episode.meta["cameras"][number]] for number in numbers]
        surfaces = tuple([_Surface.of(c, eye) for c in side] for side, eye in zip(clouds, eyes, strict=True))
        sources = tuple([rng.permutation(len(s.points))[:_SOURCES] for s in side] for side in surfaces)
        rates = tuple(
            [
                _against(side, episode.times, time, seen.points[own], seen.normals[own])[1]
                for time, seen, own in zip(episode.times, side, chosen, strict=True)
            ]
            for side, chosen in zip(surfaces, sources, strict=True)
        )
        return _Pair(episode.times, (surfaces[0], surfaces[1]), (sources[0], sources[1]), (rates[0], rates[1]))

    def rows(self, now: Agreement, gate: float, first: int) -> list[_Rows]:
        """Return the residuals of all frames in both directions. Frames are numbered from `first`."""
        found, lag, back = list[_Rows](), float(now.values[7]), now._rotation()
        for frame, time in enumerate(self.times):
            for to in (0, 1):  # from the second camera's points to the first one's surface, and the other way
                sign = 1.0 if to == 0 else -1.0
                own, chosen = self.surfaces[1 - to][frame], self.sources[1 - to][frame]
                world, facing, own_rate = own.points[chosen], own.normals[chosen], self.rates[1 - to][frame]
                if to == 0:
                    world, facing = now.moved(world), facing @ back.T
                local, local_facing = (world, facing) if to == 0 else (now.back(world), facing @ back)
                at = time + sign * lag
                height, rate, normal = _against(self.surfaces[to], self.times, at, local, local_facing)
                if to == 1:
                    normal = normal @ back.T
                good = (np.abs(height) < gate) & np.isfinite(rate) & np.isfinite(own_rate)
                world, r = world[good], height[good]
                columns = []
                for n, speed in ((normal[good], rate[good]), (facing[good], own_rate[good])):
                    # the correction moves the second camera's surface, or its points, so the sign depends on the direction
                    turned, scaled = np.cross(world - now.middle - now.values[3:6], n), world - now._shift()
                    columns.append(sign * np.column_stack([turned, n, (scaled * n).sum(-1), speed]))
                found.append(_Rows(columns[0], columns[1], r, np.full(len(r), first + frame)))
        return found


def _against(
    surfaces: Sequence[_Surface], times: Floats, time: float, points: Floats, facing: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return heights [N] of points [N, 3] above a moving surface at a time [m], their rates [m/s], and normals [N, 3].
    Heights are NaN outside the recording and where `_Surface.height` is."""
    between = _between(times, time)
    height, rate, normal = np.zeros(len(points)), np.zeros(len(points)), np.zeros((len(points), 3))
    if between is None or not len(points):
        return height * np.nan, rate * np.nan, normal
    for k, weight, slope in between:
        h, n = surfaces[k].height(points, facing)
        height += weight * h
        rate += slope * h
        normal += weight * n
    return height, rate, normal


def _between(times: Floats, time: float) -> list[tuple[int, float, float]] | None:
    """Return three frames with interpolation weights at a time and their derivatives [1/s]; None outside the
    recording."""
    middle = int(np.abs(times - time).argmin())
    if not 0 < middle < len(times) - 1:
        return None
    chosen, result = (middle, middle - 1, middle + 1), []
    for k in chosen:
        a, b = (other for other in chosen if other != k)
        scale = (times[k] - times[a]) * (times[k] - times[b])
        result.append((k, (time - times[a]) * (time - times[b]) / scale, (2 * time - times[a] - times[b]) / scale))
    return result


def _rows(pairs: Sequence[_Pair], now: Agreement, gate: float) -> _Rows:
    parts, first = list[_Rows](), 0
    for pair in pairs:
        parts += pair.rows(now, gate, first)
        first += len(pair.times)
    if not parts:
        return _Rows(np.empty((0, 8)), np.empty((0, 8)), np.empty(0), np.empty(0, dtype=np.int64))
    return _Rows(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("J", "Z", "r", "frame")))


def agreement(episodes: Sequence[Episode], cameras: tuple[str, str], *, scale: bool = True, seed: int = 0) -> Agreement:
    """Estimate the second camera's correction from all recordings of one set-up.

    Args:
        episodes: recordings in metres, each with `camera` of its points, and with `cameras` and `viewpoints` in meta.
        cameras: names of the first camera, which is unchanged, and of the second.
        scale: whether to estimate a depth scale of the second camera.
        seed: seed for the choice of the compared points.

    Raises:
        EpisodeError: points do not name their camera, a camera is unknown or was corrected before, or the surfaces do
            not overlap enough.
    """
    rng, pairs = np.random.default_rng(seed), list[_Pair]()
    for episode in episodes:
        told = episode.meta.get("cameras")
        known = list(map(str, told)) if isinstance(told, list) else []
        if episode.camera is None or not set(cameras) <= set(known) & set(episode.viewpoints):
            raise EpisodeError(
                f"The cameras {' and '.join(cameras)} cannot be compared: the recording's points name the cameras "
                f"{', '.join(known) or 'none'}. Points must name their camera, and `viewpoints` its place. Give "
                "a recording that `diffcloud data preprocess` made of raw depth images of two cameras."
            )
        done = episode.meta.get("agreement")
        if isinstance(done, Mapping) and cameras[1] in done:
            raise EpisodeError(
                f"The camera {cameras[1]} of this recording has been corrected already: its meta has `agreement`. Points "
                "are corrected once. Leave the correction off, or give the recording as it was before."
            )
        pairs.append(_Pair.of(episode, (known.index(cameras[0]), known.index(cameras[1])), rng))
    clouds = [s.points for pair in pairs for side in pair.surfaces for s in side]
    middle = np.concatenate(clouds).mean(axis=0) if sum(map(len, clouds)) else np.zeros(3)
    now = Agreement(cameras, middle, episodes[0].viewpoints[cameras[1]], np.zeros(8), np.diag(_PRIORS**2), 0.0, 0.0)
    free = np.array([0, 1, 2, 3, 4, 5, *([6] if scale else []), 7])
    before_m = _rms(_rows(pairs, now, _GATE_M))
    for iteration in range(_ITERATIONS):
        gate = _FIRST_GATES_M[iteration] if iteration < len(_FIRST_GATES_M) else _GATE_M
        rows = _rows(pairs, now, gate)
        frames = len(np.unique(rows.frame))
        if len(rows.r) < _LEAST_ROWS or frames < _LEAST_FRAMES:
            raise EpisodeError(
                f"The cameras {' and '.join(cameras)} cannot be compared: {len(rows.r)} points in {frames} frames lie "
                f"within {100 * gate:g} cm of the other camera's surface. It takes {_LEAST_ROWS} points in {_LEAST_FRAMES} "
                f"frames, and a surface has {_NEIGHBOURS} points within {100 * _SPREAD_M:g} cm. Check the cameras' poses, "
                "give denser clouds, or leave the correction off."
            )
        previous, now = now, _stepped(now, rows, free)
        if gate == _GATE_M and np.abs((now.values - previous.values) / _PRIORS).max() < _CONVERGED:
            break
    return replace(now, before_m=before_m, after_m=_rms(_rows(pairs, now, _GATE_M)))


def _stepped(now: Agreement, rows: _Rows, free: NDArray[np.int64]) -> Agreement:
    """Take one Gauss–Newton step towards the posterior mean."""
    weight = tukey(rows.r, _sigma(rows))
    J, Z = rows.J[:, free] * _PRIORS[free], rows.Z[:, free] * _PRIORS[free]  # in standard deviations of the priors
    shown = _shown(J, Z, weight, len(np.unique(rows.frame)))
    hidden = np.eye(len(free)) - shown @ shown.T
    J, Z = J @ shown, weight[:, None] * (Z @ shown)
    A, scores = Z.T @ J, Z * rows.r[:, None]
    noise = scores.T @ scores * _counted_as_one(scores, rows.frame // _SHARED_FRAMES)
    gain = np.linalg.solve(noise, A).T
    posterior = np.linalg.inv(np.eye(len(A)) + gain @ A)
    values = now.values[free] / _PRIORS[free]
    step, covariance = np.zeros(8), np.eye(8)
    step[free] = -shown @ posterior @ (gain @ scores.sum(axis=0) + shown.T @ values) - hidden @ values
    covariance[np.ix_(free, free)] = shown @ posterior @ shown.T + hidden
    # small rotation steps are added to the rotation vector
    return replace(now, values=now.values + _PRIORS * step, covariance=_PRIORS[:, None] * covariance * _PRIORS)


def _shown(J: Floats, Z: Floats, weight: Floats, frames: int) -> Floats:
    """Return the orthonormal directions [D, d] in which the common part of J [N, D] and Z [N, D] exceeds the noise."""
    information = Z.T @ (weight[:, None] * J)
    ways = np.linalg.eigh(information + information.T)[1]
    common, of_J, of_Z = (weight @ (a @ ways * (b @ ways)) for a, b in ((J, Z), (J, J), (Z, Z)))
    noise = np.sqrt(np.maximum(of_J - common, 0.0) * np.maximum(of_Z - common, 0.0) / frames)
    return np.asarray(ways[:, common > np.maximum(_SHOWN * noise, 1e-9 * common.max())])


def _counted_as_one(scores: Floats, group: NDArray[np.int64]) -> float:
    """Return the number of rows of scores [N, d] per independent one. Rows of one group [N] have correlated errors."""
    sums = np.zeros((int(group.max()) + 1, scores.shape[1]))
    np.add.at(sums, group, scores)
    sums = sums[np.unique(group)]
    sums = sums - sums.mean(axis=0)
    ratio = np.linalg.solve(scores.T @ scores, sums.T @ sums)
    return max(float(np.trace(ratio)) / max(len(ratio), 1), 1.0)


def _sigma(rows: _Rows) -> float:
    """Return a robust standard deviation of the distances [m]."""
    return max(deviation(rows.r), 1e-5)


def _rms(rows: _Rows) -> float:
    return float(np.sqrt(np.mean(rows.r**2))) if len(rows.r) else float("nan")


def corrected(episode: Episode, found: Agreement, recordings: Sequence[str]) -> Episode:
    """Apply a correction to the second camera's points, pose and crop plane in an episode.

    Args:
        recordings: names of the recordings from which the correction was estimated, for the metadata.

    Returns:
        An episode whose meta has `agreement`, the correction, and `clocks`: camera -> `offset_s` and `sigma_s` [s]. A
            point of the second camera with time stamp T shows the motion at T + offset_s on the first camera's clock.
            The first camera's offset relative to the gripper's track is unchanged. If the recording states none, it is
            zero with a large standard deviation. Times are unchanged.
    """
    assert episode.camera is not None
    meta, (first, camera) = dict(episode.meta), found.cameras
    points = episode.points.copy()
    mine = episode.camera == list(meta["cameras"]).index(camera)
    points[mine] = found.moved(points[mine].astype(np.float64))
    meta["viewpoints"] = {**meta["viewpoints"], camera: found.moved(episode.viewpoints[camera][None])[0].tolist()}
    for name, pinhole in zip(meta.get("pinholes") or {}, episode.pinholes, strict=True):
        if name == camera:
            meta["pinholes"] = {**meta["pinholes"], camera: found.pinhole(pinhole).described()}
    if camera in episode.cut_planes:
        meta["cut_planes"] = {**meta["cut_planes"], camera: found.plane(meta["cut_planes"][camera])}
    meta["agreement"] = {**(meta.get("agreement") or {}), camera: {**found.described(), "from": list(recordings)}}
    stated = Clock(0.0, _UNKNOWN_CLOCK_S if episode.lag_sigma_s is None else 0.0)
    clocks = dict.fromkeys(meta["cameras"], stated) | episode.clocks
    late = float(found.values[7]) + clocks[first].offset_s
    clocks[camera] = Clock(late, float(np.hypot(found.sigmas[7], _CLOCK_BIAS_S)))
    meta["clocks"] = {name: asdict(clock) for name, clock in clocks.items()}
    return replace(episode, points=points, meta=meta)
