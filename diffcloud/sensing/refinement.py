"""Refinement of the camera poses from a recording itself.

A calibration is wrong by millimetres once a camera was touched, and by centimetres once the stand was moved. In the
recording, both cameras see the arm, whose pose is known from its joints, the same table, and partly the same cloth. The
poses are refined by Gauss–Newton on point-to-plane distances, over several frames at once:

- arm: from each measured point to the arm's model surface on its ray. Three more quantities are estimated: the excess
  thickness of each link (its *skin*), the deviation of each surface patch from it, and the clock offset of the joint
  log.
- table: from the other cameras' points to the first camera's plane.
- cloth: from the other cameras' points to the first camera's nearby points.

The real arm is rounder than its model and carries cables. Such errors belong to the arm: a patch of a link has the same
error in every image of every camera. If they were treated as noise, they would bias the clock offset, because different
patches are visible during fast and slow motion. So each patch has its own offset, which is eliminated, and the clock
offset is determined by the motion of the same patches.

Only the arm determines the common pose of all cameras. Because of its model errors, this estimate is no better than a
usable calibration. A common shift is applied only if it is larger than that error (`_USABLE_M`). Otherwise the first
camera keeps its pose. The shift is estimated together with the clock offset, since an unmodelled shift of 3 mm would
change the offset by 5 ms. If the shift is within its accuracy (`_FOUND_M`), it is set to zero and the other poses are
estimated again.

Weights follow from the depth noise; outliers get Tukey weights relative to the median absolute residual. Neighbouring
points of table and cloth have correlated errors, so they have a smaller weight. The calibration is the prior, which
determines all directions without information.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from diffcloud.io.camera_models import Intrinsics
from diffcloud.io.raw_episodes import RawEpisode, RobotLog
from diffcloud.sensing.cameras import inverse, rotate, transform
from diffcloud.sensing.masking import RobotMask, View, joints_at
from diffcloud.sensing.robust import deviation, tukey

Floats = NDArray[np.float64]

_ITERATIONS = 14
_THICKENED_AT = 4
"""From this iteration on, the arm is rendered with the estimated skin. The thickness along a ray differs from that
along the normal, and on round links the difference grows with the angle between both."""
_CONVERGED = 2e-5
"""The iteration ends if the pose step is smaller than this [m, rad]."""
_COLUMNS = 212
"""Images are subsampled to about this many columns, which resolve the surfaces well enough."""
_GATE_M = 0.03
"""Measurements farther from the model surface are excluded [m]; three times the error of a usable calibration."""
_CLOTH_GATE_M = 0.02
_SHAPE_M = 0.002
"""Standard deviation of surface errors beyond the skin, and of depth errors beyond noise [m]."""
_SHARED = 36
"""Number of subsampled pixels with correlated errors: those on a patch of 4 cm at 1 m."""
_PATCH_M = 0.02
"""Size of the arm's patches [m]: cubes in the link's frame, divided by the main direction of the normal."""
_PRIOR_PATCH_M = 0.003
"""Prior standard deviation of a patch's offset from model and skin [m]: rounded edges, screws, cables."""
_CUBES = 1 << 12
"""Number of patch cubes along each axis."""
_REWEIGHTED = 3
_WINDOW = 4
"""Number of subsampled pixels with correlated noise, because they share a stereo matching window."""
_PRIOR_M, _PRIOR_RAD = 0.005, np.deg2rad(0.5)
"""Prior standard deviations of calibration errors along and about each axis."""
_USABLE_M, _USABLE_RAD = 0.005, np.deg2rad(0.5)
"""Common shifts of all cameras below these limits are not applied."""
_FOUND_M, _FOUND_RAD = 0.002, np.deg2rad(0.2)
"""Accuracy with which the common shift can be estimated."""
_PRIOR_SKIN_M, _PRIOR_LAG_S = 0.005, 0.1
_LAG_STEP_S = 0.01
_STEEPEST = 0.35
"""Minimum cosine between ray and normal; surfaces seen at a flatter angle are excluded."""
_NEIGHBOURS = 12


@dataclass(frozen=True)
class Sight:
    """Points of a few frames, each camera's in its own frame."""

    frames: Mapping[str, Sequence[int]]
    """Indices of the images of each camera. Images at the same list position belong to the same time."""
    cloth: Mapping[str, Sequence[Floats]]
    """[P, 3] cloth points in each of these images, in the camera's frame [m]."""
    table: Mapping[str, Floats]
    """[P, 3] table points in the camera's frame [m]; empty without a table."""


@dataclass(frozen=True)
class Refinement:
    """Camera poses and clock offset found from a recording."""

    T_world_camera: Mapping[str, Floats]
    """Refined poses. The first camera's is unchanged unless a common shift of all cameras was applied."""
    skin_m: float
    """Excess thickness of the arm, the median over the visible links; 0 without an arm."""
    clock_offset_s: float
    """Offset of the joint log's times: logged time minus true time."""
    lag_sigma_s: float
    """Standard deviation of the clock offset; 0 without an arm."""
    shift_m: Mapping[str, float]
    """Displacement of the scene's centre by the change of each camera's pose."""


@dataclass(frozen=True)
class _Rows:
    """Linearised residuals with their standard deviations."""

    J: Floats
    """[N, 6] derivatives with respect to a camera's rotation and translation. [N, 7 + L] has those of the clock offset
    and each link's skin too, and [N, U] those of all unknowns."""
    r: Floats
    """[N] residuals [m]."""
    sigma: Floats
    """[N] standard deviations [m]."""
    patch: NDArray[np.int64] | None = None
    """[N] patch numbers of the arm; None for table and cloth."""

    def among(self, unknowns: int, columns: NDArray[np.int64]) -> _Rows:
        """Expand the derivatives to all unknowns; those in J belong to the given columns."""
        J = np.zeros((len(self.r), unknowns))
        J[:, columns] = self.J
        return replace(self, J=J)


def refine_extrinsics(
    raw: RawEpisode,
    views: Mapping[str, View],
    arm: RobotMask | None,
    sight: Sight,
    *,
    sigma_per_m: float,
    clock_offset_s: float,
) -> Refinement:
    """Refine the cameras' poses.

    Args:
        views: cameras with the poses of the calibration.
        arm: model surface without inflation; None without an arm.
        sigma_per_m: standard deviation of the inverse depth [1/m].
        clock_offset_s: initial clock offset of the joint log.
    """
    names, log = list(views), raw.robot
    first = names[0]
    poses = {name: view.T_world_camera for name, view in views.items()}
    seen = [
        transform(poses[name], points)
        for name in names
        for points in [*sight.cloth[name], sight.table[name]]
        if len(points)
    ]
    if not seen:
        return Refinement(poses, 0.0, clock_offset_s, 0.0, dict.fromkeys(names, 0.0))
    centre = np.concatenate(seen).mean(axis=0)
    plane, surfaces = _plane(sight.table[first]), [_with_normals(points) for points in sight.cloth[first]]
    images = {} if arm is None else {name: _thinned(raw, name, views[name], sight.frames[name]) for name in names}
    poses_end, links = 6 * len(names), 0 if arm is None else len(arm.robot.links)
    prior = np.concatenate(
        [
            np.tile([1 / _PRIOR_RAD**2] * 3 + [1 / _PRIOR_M**2] * 3, len(names)),
            [1 / _PRIOR_LAG_S**2],
            np.full(links, 1 / _PRIOR_SKIN_M**2),
        ]
    )
    found = np.zeros(len(prior))
    """Corrections of the poses, the clock offset and the skins. That of the first camera also moves all others."""
    free, together, lag_variance = np.arange(len(prior)), np.eye(4), 0.0
    surface, thickened = arm, np.zeros(links)
    for iteration in range(_ITERATIONS):
        if arm is not None and iteration == _THICKENED_AT:
            thickened = found[poses_end + 1 :].copy()
            surface = RobotMask(arm.robot, robot_margin_m=dict(zip(arm.robot.links, thickened.tolist(), strict=True)))
        information, right = np.diag(prior), -prior * found
        groups, of_arm = [], []
        for index, name in enumerate(names):
            own = 6 * index + np.arange(6)
            if surface is not None and log is not None:
                view = replace(images[name].view, T_world_camera=poses[name])
                lag, skin = clock_offset_s + float(found[poses_end]), found[poses_end + 1 :] - thickened
                rows = _arm_rows(log, surface, images[name], view, centre, skin, lag, sigma_per_m)
                rows = rows.among(len(prior), np.concatenate([own, np.arange(poses_end, len(prior))]))
                rows.J[:, :6] = rows.J[:, own]  # the first camera's correction moves all cameras
                of_arm.append(rows)
            if index:
                if plane is not None and len(sight.table[name]):
                    rows = _table_rows(sight.table[name], poses[name], _placed(*plane, poses[first]), centre, sigma_per_m)
                    groups.append(rows.among(len(prior), own))
                placed = [_placed(normals, points, poses[first]) for points, normals in surfaces]
                rows = _cloth_rows(sight.cloth[name], poses[name], placed, centre, sigma_per_m)
                groups.append(rows.among(len(prior), own))
        if of_arm:
            groups.append(_joined(of_arm))  # the cameras see the same patches
        for rows in groups:
            added, pulled = _normal_equations(rows)
            information += added
            right += pulled
        if len(free) == len(prior):
            lag_variance = float(np.linalg.inv(information)[poses_end, poses_end])
        step = np.zeros(len(prior))
        step[free] = np.linalg.solve(information[np.ix_(free, free)], right[free])
        found += step
        together = _moved(together, step[:6], centre)
        for index, name in enumerate(names):
            poses[name] = _moved(poses[name], step[:6], centre)
            if index:
                poses[name] = _moved(poses[name], step[6 * index : 6 * index + 6], centre)
        arrived = iteration >= _THICKENED_AT and np.abs(step[:poses_end]).max() < _CONVERGED
        decided = len(free) < len(prior) or not _within(found, _FOUND_M, _FOUND_RAD)
        if arrived and decided:
            break
        if not decided and (arrived or iteration == _ITERATIONS // 2):
            poses = {name: inverse(together) @ pose for name, pose in poses.items()}
            free, found[:6], together = np.delete(np.arange(6, len(prior)), poses_end - 6), 0.0, np.eye(4)
    if _within(found, _USABLE_M, _USABLE_RAD):
        poses = {name: inverse(together) @ pose for name, pose in poses.items()}
    skins = found[poses_end + 1 :]
    skin_m = float(np.median(skins[skins != 0])) if skins.any() else 0.0
    shift = {
        name: float(np.linalg.norm(transform(poses[name] @ inverse(views[name].T_world_camera), centre[None])[0] - centre))
        for name in names
    }
    sigma = 0.0 if arm is None or log is None else float(np.sqrt(lag_variance))
    return Refinement(poses, skin_m, clock_offset_s + float(found[poses_end]), sigma, shift)


def _within(found: Floats, metres: float, radians: float) -> bool:
    """Return whether a motion (rotation vector, translation) is below the given limits."""
    return bool(np.linalg.norm(found[:3]) < radians and np.linalg.norm(found[3:6]) < metres)


@dataclass(frozen=True)
class _Images:
    """Subsampled depth images of one camera."""

    view: View
    depth_m: Floats
    """[F, h, w] z-depth [m]."""
    times: Floats
    """[F] times of the images [s]."""


def _thinned(raw: RawEpisode, name: str, view: View, frames: Sequence[int]) -> _Images:
    camera, full = raw.cameras[name], view.intrinsics
    step = max(1, full.width // _COLUMNS)
    depth: Floats = np.stack([camera.depth(index)[::step, ::step] for index in frames]).astype(np.float64)
    depth *= camera.info.depth_scale_m
    height, width = depth.shape[1:]
    thin = Intrinsics(
        width, height, full.fx / step, full.fy / step, full.cx / step, full.cy / step, full.distortion, full.coefficients
    )
    return _Images(View(thin, view.T_world_camera), depth, camera.times[list(frames)])


def _arm_rows(
    log: RobotLog, arm: RobotMask, images: _Images, view: View, centre: Floats, skin: Floats, lag: float, sigma_per_m: float
) -> _Rows:
    """Return the residuals from measurements near the arm to its surface on the same ray.

    Args:
        arm: surface to render.
        skin: [L] excess thickness of the links beyond that surface [m].
        lag: clock offset of the joint log [s].
    """
    robot = arm.robot
    earlier, now, later = (
        robot.forward_kinematics(robot.configuration(*joints_at(log, images.times, clock_offset_s=lag + value)))
        for value in (-_LAG_STEP_S, 0.0, _LAG_STEP_S)
    )
    rates = (later - earlier) / (2 * _LAG_STEP_S)
    rotation = view.T_world_camera[:3, :3]
    parts = []
    for poses, rate, depth_m in zip(now, rates, images.depth_m, strict=True):  # a handful of images, each vectorised
        surface, link = arm.first_hits(view, poses)
        solid = np.isfinite(surface)
        described = view.directions * np.where(solid, surface, 0.0)[..., None]
        normal, facing = _image_normals(described, solid, view.directions)
        off = depth_m - np.where(solid, surface, 0.0)
        use = solid & (depth_m > 0) & (np.abs(off) < _GATE_M) & (facing > _STEEPEST)
        along = (view.directions[use] * normal[use]).sum(axis=-1)  # negative: normals look at the camera
        world = transform(view.T_world_camera, view.directions[use] * depth_m[use][:, None])
        n, which = normal[use] @ rotation.T, link[use]
        from_link = transform(view.T_world_camera, described[use]) - poses[which, :3, 3]
        place, facet = (np.einsum("nji,nj->ni", poses[which, :3, :3], vector) for vector in (from_link, n))
        motion = np.einsum("nij,nj->ni", rate[which, :3, :3], place) + rate[which, :3, 3]
        J = np.zeros((len(n), 7 + len(skin)))
        J[:, :3], J[:, 3:6], J[:, 6] = np.cross(world - centre, n), n, -(motion * n).sum(axis=-1)
        J[np.arange(len(n)), 7 + which] = -1.0
        sigma = np.hypot(sigma_per_m * depth_m[use] ** 2 * np.abs(along), _SHAPE_M)
        parts.append(_Rows(J, off[use] * along - skin[which], sigma, _patches(which, place, facet)))
    return _joined(parts)


def _patches(link: NDArray[np.int64], place: Floats, normal: Floats) -> NDArray[np.int64]:
    """Return patch numbers [N] of points `place` [N, 3] on links [N] with normals [N, 3], both in the links' frames."""
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
    cube = np.floor(place / _PATCH_M).astype(np.int64) + _CUBES // 2
    number: NDArray[np.int64] = np.ravel_multi_index((link, side, *cube.T), (1 << 20, 6, _CUBES, _CUBES, _CUBES))
    return number


def _joined(parts: Sequence[_Rows]) -> _Rows:
    """Concatenate rows of the arm."""
    return _Rows(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("J", "r", "sigma", "patch")))


def _normal_equations(rows: _Rows) -> tuple[Floats, Floats]:
    """Return JᵀWJ [U, U] and -JᵀWr [U]. For rows of the arm, the patches' offsets are eliminated."""
    if rows.patch is None:
        weighted = rows.J * (_tukey(rows.r / rows.sigma) / rows.sigma**2 / _SHARED)[:, None]
        return weighted.T @ rows.J, -weighted.T @ rows.r
    numbers, patch = np.unique(rows.patch, return_inverse=True)
    belongs = csr_array((np.ones(len(patch)), (patch, np.arange(len(patch)))), shape=(len(numbers), len(patch)))
    offset = np.zeros(len(numbers))
    for _ in range(_REWEIGHTED):  # outliers are relative to their own patch
        weight = _tukey((rows.r - offset[patch]) / rows.sigma) / rows.sigma**2 / _WINDOW
        total = belongs @ weight + 1 / _PRIOR_PATCH_M**2
        offset = belongs @ (weight * rows.r) / total
    weighted = rows.J * weight[:, None]
    sums = belongs @ weighted
    return weighted.T @ rows.J - (sums / total[:, None]).T @ sums, -weighted.T @ rows.r + sums.T @ offset


def _table_rows(points: Floats, pose: Floats, plane: tuple[Floats, Floats], centre: Floats, sigma_per_m: float) -> _Rows:
    """Return the residuals from points to the plane (a point on it, its normal)."""
    world, (place, normal) = transform(pose, points), plane
    off = (world - place) @ normal[0]
    return _plane_rows(world, np.broadcast_to(normal, world.shape), off, points, centre, sigma_per_m)


def _placed(normals: Floats, points: Floats, pose: Floats) -> tuple[Floats, Floats]:
    """Transform points [..., 3] and normals [..., 3] from the camera to the world."""
    return transform(pose, points), rotate(pose, normals)


def _cloth_rows(
    clouds: Sequence[Floats], pose: Floats, surfaces: Sequence[tuple[Floats, Floats]], centre: Floats, sigma_per_m: float
) -> _Rows:
    """Return the residuals from points to the tangent planes of the first camera's nearby points."""
    worlds, normals, offsets, own = [], [], [], []
    for cloud, (points, normal) in zip(clouds, surfaces, strict=True):
        if not len(cloud) or not len(points):
            continue
        world = transform(pose, cloud)
        distance, nearest = cKDTree(points).query(world, distance_upper_bound=_CLOTH_GATE_M)
        near = np.isfinite(distance)
        worlds.append(world[near])
        normals.append(normal[nearest[near]])
        offsets.append(((world[near] - points[nearest[near]]) * normal[nearest[near]]).sum(axis=1))
        own.append(cloud[near])
    if not worlds:
        return _Rows(np.zeros((0, 6)), np.zeros(0), np.ones(0))
    world, normal, off, points = (np.concatenate(part) for part in (worlds, normals, offsets, own))
    return _plane_rows(world, normal, off, points, centre, sigma_per_m)


def _plane_rows(world: Floats, normal: Floats, r: Floats, points: Floats, centre: Floats, sigma_per_m: float) -> _Rows:
    """Return rows for distances `r` of points along fixed normals."""
    return _Rows(
        np.hstack([np.cross(world - centre, normal), normal]), r, np.hypot(sigma_per_m * points[:, 2] ** 2, _SHAPE_M)
    )


def _tukey(u: Floats) -> Floats:
    """Return weights [N], 0 to 1, of residuals divided by their standard deviations."""
    if not len(u):
        return np.zeros(0)
    return tukey(u, deviation(u) + 1e-9)


def _image_normals(points: Floats, solid: NDArray[np.bool_], directions: Floats) -> tuple[Floats, Floats]:
    """Return normals [H, W, 3] of an image of points, and cosines [H, W] to the rays; 0 at borders."""
    across = np.zeros_like(points)
    down = np.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    whole = np.zeros_like(solid)
    whole[1:-1, 1:-1] = solid[1:-1, 1:-1] & solid[1:-1, 2:] & solid[1:-1, :-2] & solid[2:, 1:-1] & solid[:-2, 1:-1]
    normal = np.cross(across, down)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    cosine = (normal * directions).sum(axis=-1) / np.linalg.norm(directions, axis=-1)
    normal *= -np.sign(cosine)[..., None]
    return normal, np.where(whole, np.abs(cosine), 0.0)


def _with_normals(points: Floats) -> tuple[Floats, Floats]:
    """Return points [P, 3] and normals [P, 3] of planes through their neighbours; empty for too few points."""
    if len(points) <= _NEIGHBOURS:
        return np.zeros((0, 3)), np.zeros((0, 3))
    _, nearest = cKDTree(points).query(points, k=_NEIGHBOURS)
    around = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    return points, vectors[..., 0]


def _plane(points: Floats) -> tuple[Floats, Floats] | None:
    """Return the normal [1, 3] of the plane through points [P, 3], and a point on it [1, 3]."""
    if len(points) < 3:
        return None
    centre = points.mean(axis=0, keepdims=True)
    return np.linalg.svd(points - centre, full_matrices=False)[2][2:], centre


def _moved(pose: Floats, step: Floats, centre: Floats) -> Floats:
    """Rotate a pose about `centre` by a rotation vector step[:3], then shift it by step[3:]."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    moved = pose.copy()
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] = turn @ (pose[:3, 3] - centre) + centre + step[3:]
    return moved
