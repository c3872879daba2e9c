"""Where the cameras stand, found again from the recording itself.

A calibration is off by millimetres once a camera has been touched, and by centimetres once the cameras' stand has been
moved. The recording knows better: both cameras saw the arm, whose place its joints tell, the same table, and in part the
same cloth. The poses are refined by Gauss–Newton on distances along normals, over several frames at once:

- arm: from each measured point to the described surface on its ray. How much thicker each link is than its description
  (its *skin*), by how much each patch of it differs from that, and how late the joint log is are unknown too.
- table: from the other camera's points to the first camera's plane.
- cloth: from the other camera's points to the first camera's points nearby.

An arm is rounder than its description, and cables lie on it. Such errors are the arm's own: the same place of a link is
off by the same amount in every image of every camera. Taken for noise they become lag, because an arm that goes one way
shows other places when it is fast than when it is slow. So each patch of a link has an offset of its own, which is
eliminated, and the lag is read off how the same patches move.

Only the arm tells where all cameras together are. It is rounder and thicker than described, so its answer is no better than
a usable calibration: a shift larger than that error (`_USABLE_M`) is applied; otherwise the first camera stays where it is.
The shift is nevertheless estimated until the lag is found: cameras that are 3 mm off would make the log seem 5 ms late. If
it is then within the accuracy with which it can be found (`_FOUND_M`), it is set to zero and the others' places are
estimated again.

Weights come from the depth's own noise, and fall off for outliers by Tukey's function of the residuals' median deviation.
Neighbouring points of table and cloth share their surface's errors, so they count as few. The calibration is the prior:
what nothing in the recording constrains stays as it was.
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
"""Before this iteration the arm is cast as described, from it on as thick as it was found to be. A skin is not as thick
along a ray as along the normal, and on round links the difference grows with the angle between them."""
_CONVERGED = 2e-5
"""Metres and radians of a step."""
_COLUMNS = 212
"""Images are thinned to about this many columns: there are more points than the surface has shape."""
_GATE_M = 0.03
"""Farther from the described surface a measurement is of something else: three times what a usable calibration is off."""
_CLOTH_GATE_M = 0.02
_SHAPE_M = 0.002
"""By which surfaces differ from their descriptions beyond a common skin, and depth is off beyond its noise."""
_SHARED = 36
"""So many thinned pixels lie on one patch of 4 cm at a metre, over which the errors of a surface are alike."""
_PATCH_M = 0.02
"""Patches of the arm: cubes of this side in a link's frame, and in each the sides that face along one of its axes."""
_PRIOR_PATCH_M = 0.003
"""By which a patch differs from its link's description and skin: rounded edges, screws, cables."""
_CUBES = 1 << 12
"""Patches are numbered within this many cubes along each axis."""
_REWEIGHTED = 3
_WINDOW = 4
"""So many thinned pixels share a window of stereo matching, and with it their noise."""
_PRIOR_M, _PRIOR_RAD = 0.005, np.deg2rad(0.5)
"""How far calibrations tend to be off, along and about each axis."""
_USABLE_M, _USABLE_RAD = 0.005, np.deg2rad(0.5)
"""A common shift of all cameras is left uncorrected if it is smaller than these limits."""
_FOUND_M, _FOUND_RAD = 0.002, np.deg2rad(0.2)
"""It is found as closely as this."""
_PRIOR_SKIN_M, _PRIOR_LAG_S = 0.005, 0.1
_LAG_STEP_S = 0.01
_STEEPEST = 0.35
"""Cosine between ray and normal below which a surface is seen too flatly."""
_NEIGHBOURS = 12


@dataclass(frozen=True)
class Sight:
    """What the frames that are looked at show, each camera's points in its own frame."""

    frames: Mapping[str, Sequence[int]]
    """Indices of the images of each camera; those at one place in the lists belong together."""
    cloth: Mapping[str, Sequence[Floats]]
    """[P, 3] of the cloth in each of these images, in the camera's frame [m]."""
    table: Mapping[str, Floats]
    """[P, 3] on the table, in the camera's frame [m]; empty without a table."""


@dataclass(frozen=True)
class Refinement:
    """The recording's own calibration."""

    T_world_camera: Mapping[str, Floats]
    """The first camera's is as it was, unless all cameras were found to be elsewhere."""
    skin_m: float
    """By which the arm is thicker than described, as the median over the links that were seen; 0 without an arm."""
    clock_offset_s: float
    """By which the joint log's times are late."""
    lag_sigma_s: float
    """Standard deviation that it is known with; 0 without an arm."""
    shift_m: Mapping[str, float]
    """How far each camera's picture of the middle of what was seen has moved."""


@dataclass(frozen=True)
class _Rows:
    """Linearised residuals."""

    J: Floats
    """[N, 6] by a camera's rotation and translation, [N, 7 + L] also by the lag and the skin of each link, or [N, U] by
    all unknowns."""
    r: Floats
    """[N] [m]."""
    sigma: Floats
    """[N] their deviation [m]."""
    patch: NDArray[np.int64] | None = None
    """[N] numbers of the arm's patches; None for what is not of the arm."""

    def among(self, unknowns: int, columns: NDArray[np.int64]) -> _Rows:
        """The same by all unknowns, of which J's are at these places."""
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
        views: by camera, at the calibration's poses.
        arm: the described surface, without inflation; None without an arm.
        sigma_per_m: standard deviation of the inverse depth [1/m].
        clock_offset_s: of the joint log, to start from.
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
    """Corrections of the poses (the first camera's also moves all others) and of the lag, then the skins."""
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
                rows.J[:, :6] = rows.J[:, own]  # the first camera takes the others along
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
    """Whether the first six numbers are a smaller motion than this."""
    return bool(np.linalg.norm(found[:3]) < radians and np.linalg.norm(found[3:6]) < metres)


@dataclass(frozen=True)
class _Images:
    """Thinned depth images of one camera."""

    view: View
    depth_m: Floats
    """[F, h, w]."""
    times: Floats
    """[F] [s]."""


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
    """From each measurement near the arm to its surface on the same ray.

    Args:
        arm: the surface that is cast.
        skin: [L] by which the links are thicker than that [m].
        lag: of the joint log [s].
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
    """Numbers [N] of the patches of places [N, 3] on links [N] with normals [N, 3], both in the links' frames."""
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] > 0)
    cube = np.floor(place / _PATCH_M).astype(np.int64) + _CUBES // 2
    number: NDArray[np.int64] = np.ravel_multi_index((link, side, *cube.T), (1 << 20, 6, _CUBES, _CUBES, _CUBES))
    return number


def _joined(parts: Sequence[_Rows]) -> _Rows:
    """Rows of the arm together."""
    return _Rows(*(np.concatenate([getattr(part, name) for part in parts]) for name in ("J", "r", "sigma", "patch")))


def _normal_equations(rows: _Rows) -> tuple[Floats, Floats]:
    """JᵀWJ [U, U] and -JᵀWr [U]; for rows of the arm, of what is left when the patches' offsets are eliminated."""
    if rows.patch is None:
        weighted = rows.J * (_tukey(rows.r / rows.sigma) / rows.sigma**2 / _SHARED)[:, None]
        return weighted.T @ rows.J, -weighted.T @ rows.r
    numbers, patch = np.unique(rows.patch, return_inverse=True)
    belongs = csr_array((np.ones(len(patch)), (patch, np.arange(len(patch)))), shape=(len(numbers), len(patch)))
    offset = np.zeros(len(numbers))
    for _ in range(_REWEIGHTED):  # outliers are those from their own patch
        weight = _tukey((rows.r - offset[patch]) / rows.sigma) / rows.sigma**2 / _WINDOW
        total = belongs @ weight + 1 / _PRIOR_PATCH_M**2
        offset = belongs @ (weight * rows.r) / total
    weighted = rows.J * weight[:, None]
    sums = belongs @ weighted
    return weighted.T @ rows.J - (sums / total[:, None]).T @ sums, -weighted.T @ rows.r + sums.T @ offset


def _table_rows(points: Floats, pose: Floats, plane: tuple[Floats, Floats], centre: Floats, sigma_per_m: float) -> _Rows:
    """From points to the plane (a point of it, its normal)."""
    world, (place, normal) = transform(pose, points), plane
    off = (world - place) @ normal[0]
    return _plane_rows(world, np.broadcast_to(normal, world.shape), off, points, centre, sigma_per_m)


def _placed(normals: Floats, points: Floats, pose: Floats) -> tuple[Floats, Floats]:
    """Points [..., 3] and normals [..., 3] of a camera in the world."""
    return transform(pose, points), rotate(pose, normals)


def _cloth_rows(
    clouds: Sequence[Floats], pose: Floats, surfaces: Sequence[tuple[Floats, Floats]], centre: Floats, sigma_per_m: float
) -> _Rows:
    """From points to the tangent planes of the first camera's points nearby."""
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
    """Distances `r` of points along normals that stand still."""
    return _Rows(
        np.hstack([np.cross(world - centre, normal), normal]), r, np.hypot(sigma_per_m * points[:, 2] ** 2, _SHAPE_M)
    )


def _tukey(u: Floats) -> Floats:
    """[N] weights 0..1 of residuals over their deviations."""
    if not len(u):
        return np.zeros(0)
    return tukey(u, deviation(u) + 1e-9)


def _image_normals(points: Floats, solid: NDArray[np.bool_], directions: Floats) -> tuple[Floats, Floats]:
    """Normals [H, W, 3] of an image of points, towards the camera, and the cosine [H, W] to the rays; 0 at borders."""
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
    """Points [P, 3] and the normals [P, 3] of the planes through their neighbours; both empty for too few."""
    if len(points) <= _NEIGHBOURS:
        return np.zeros((0, 3)), np.zeros((0, 3))
    _, nearest = cKDTree(points).query(points, k=_NEIGHBOURS)
    around = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    return points, vectors[..., 0]


def _plane(points: Floats) -> tuple[Floats, Floats] | None:
    """The normal [1, 3] of the plane through points [P, 3], and a point of it [1, 3]."""
    if len(points) < 3:
        return None
    centre = points.mean(axis=0, keepdims=True)
    return np.linalg.svd(points - centre, full_matrices=False)[2][2:], centre


def _moved(pose: Floats, step: Floats, centre: Floats) -> Floats:
    """A pose turned about `centre` by a rotation vector step[:3], then moved by step[3:]."""
    turn = Rotation.from_rotvec(step[:3]).as_matrix()
    moved = pose.copy()
    moved[:3, :3] = turn @ pose[:3, :3]
    moved[:3, 3] = turn @ (pose[:3, 3] - centre) + centre + step[3:]
    return moved
