"""Estimation of a cloth's layout (pose, size, grasp) from the first frame of a recording without a scenario.

The first frame shows the cloth flat on the table. Its height gives the table height. The rectangle of least area around
it gives centre, yaw and size. The grasped node is the one below the gripper's first position. Every value has a reason.
Implausible inputs are rejected before anything is simulated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.episodes import Episode
from diffcloud.scene.scenarios.grid import GridScenario
from diffcloud.sim.grasp import GRIP_M

_LARGEST_M = 5.0
"""Maximum size of a cloth; a larger cloud is in another unit."""
_SMALLEST_M = 0.02
_LEVEL_DEG = 25.0
"""Maximum tilt of the first cloud."""
_FLAT_M = 0.05
"""Maximum thickness of the first cloud, for most of its points."""
_RIM = 0.005
"""Fraction of the points that may be outside each side of the rectangle: noise and stray points."""
_SIZE_OFF = 0.1
"""Maximum relative difference between estimated and stated size. In lifts that MuJoCo moved, seen by one or two cameras or
cut above the table, sizes were estimated within 1.2 %. With a side stated 9 % too long, the interval of the stiffness still
held the truth; with 23 % it did not."""
_LEVEL_M = 0.015
"""Height range around the first frame in which points may still be on the table."""
_STRETCHED = 1.2
"""Maximum extension ratio of a lifted cloth."""
_A_CELL = 8
"""Number of points per grid cell in the first frame, so that a covered cell has points in later frames too."""
_FEW_CELLS = 20
"""Minimum number of cells that must leave the table to separate cloth from table. Fewer may change by chance."""
_RECTANGLE = 0.85
"""Minimum fraction of the rectangle around a cloth that its cloud covers. Towels have 0.95 to 1, also under a hand, shirts
and vests 0.74 to 0.82."""
_COVERED = 0.4
"""Number of points of a covered cell, as a fraction of the median."""
HAND_M = 0.12
"""Distance from a gripper within which a hand may hide the cloth."""
_STAYS = 0.5
"""Minimum fraction of the expected lifted area that has really left the table, if the cloud is a cloth."""
_AT_CORNER_M = 0.03
_TRAVEL_M = 0.03
_NODES = (5, 13)
GAP_M: float = GridScenario.model_fields["gap_m"].default
"""Initial height of the cloth above the table."""
_FEW_POINTS = 100
FIELDS = ("center_m", "yaw_deg", "initial_state", "table_height_m", "rate_hz", "frames", "path")
"""Scenario fields that `find_layout` estimates, beside `grasped` or `grippers`."""


@dataclass(frozen=True)
class Found:
    """A value and the reason for it."""

    value: object
    reason: str


@dataclass(frozen=True)
class Layout:
    """Estimated fields of a grid scenario: name -> value and reason."""

    fields: dict[str, Found]
    warnings: tuple[str, ...]


def found_size(episode: Episode) -> tuple[float, float]:
    """Return the sides of the cloth in the first frame, the longer one first [m]."""
    sides = _rectangle(flat_cloud(episode))[1]
    return max(sides), min(sides)


def node_counts(size: tuple[float, float]) -> tuple[int, int]:
    """Return the numbers of nodes along both sides, 13 along the longer one. Coarser meshes fold differently."""
    columns, rows = (max(round((_NODES[1] - 1) * side / max(size)) + 1, _NODES[0]) for side in size)
    return columns, rows


def find_layout(episode: Episode, size: tuple[float, float], pad: float = GRIP_M) -> Layout:
    """Estimate the fields of a grid scenario from a recording.

    Args:
        episode: recording in metres, z up, with the tracks of its grippers.
        size: sides of the cloth [m].
        pad: side of the gripper's pad [m]; 0: a point.

    Raises:
        EpisodeError: there is no gripper track, the unit is wrong, the first cloud is not flat and level or contains
            the table, the stated size does not fit the cloud, or the gripper is not at the cloth. Says what to try.
    """
    refuse_no_track(episode)
    assert episode.gripper is not None
    warnings = few_points(episode)
    cloud = flat_cloud(episode)
    yaw, sides, centre = _rectangle(cloud)
    refuse_table(episode, cloud, sides)
    if (sides[0] < sides[1]) != (size[0] < size[1]):  # match the longer sides
        yaw, sides = yaw + math.pi / 2, (sides[1], sides[0])
    off = max(abs(side / stated - 1) for side, stated in zip(sides, size, strict=True))
    if off > _SIZE_OFF:
        raise EpisodeError(
            f"The first frame shows a cloth of {sides[0]:.3f} x {sides[1]:.3f} m, and {size[0]:.3f} x {size[1]:.3f} m was "
            "stated. Check --size and the unit of the clouds (metres), and that the first frame shows the whole cloth, "
            "flat on the table, and nothing of the table; it does not if all points near the table were cut off."
        )
    if off > _SIZE_OFF / 2:
        warnings.append(f"the first frame shows {sides[0]:.3f} x {sides[1]:.3f} m, {off:.0%} off the stated size")
    _refuse_other_outline(episode, cloud, yaw, sides, centre)
    turn = _turned(yaw)
    local = (episode.gripper[0, :, :2] - centre) @ turn
    half = np.array(size) / 2
    for name, beyond in zip(episode.grippers, np.linalg.norm(np.maximum(np.abs(local) - half, 0.0), axis=1), strict=True):
        refuse_beside(float(beyond), max(size), called(name, episode))
    columns, rows = node_counts(size)
    across, along = np.meshgrid(np.linspace(-half[0], half[0], columns), np.linspace(-half[1], half[1], rows))
    nodes = np.stack([across.ravel(), along.ravel()], axis=-1)
    # a rectangle is symmetric under half a turn, so choose the yaw with the grasped corner at the top right
    if local[0, 0] < 0 and local[0, 1] < 0:
        yaw, local = yaw + math.pi, -local
    inner = np.maximum(half - pad / 2, 0.0)  # a pad at an edge is inside the cloth
    distances = np.linalg.norm(np.clip(nodes, -inner, inner) - local[:, None], axis=2)
    held, away = distances.argmin(axis=1).tolist(), distances.min(axis=1)
    for name, distance in zip(episode.grippers, away, strict=True):
        if distance > 0.5 * max(size) / (_NODES[1] - 1) + _AT_CORNER_M:
            warnings.append(f"{called(name, episode)} begins {1e3 * distance:.0f} mm beside the nearest place of a grasp")
    corners = {
        0: "left_bottom",
        columns - 1: "right_bottom",
        rows * columns - columns: "left_top",
        len(nodes) - 1: "right_top",
    }
    course, told = flat_course(episode)
    table = float(np.median(cloud[:, 2])) - GAP_M
    reason = f"where a grasp is nearest the gripper's first position, {1e3 * away[0]:.0f} mm away"
    grasped: dict[str, Any] = {"grasped": Found([corners.get(held[0], held[0])], reason)}
    if len(held) > 1:
        if len(set(held)) < len(held):
            raise EpisodeError(
                f"Two of the grippers {', '.join(episode.grippers)} begin at the same place of the cloth. Each gripper "
                "holds a part of its own. Check the tracks, or leave one out."
            )
        paths = own_paths(episode)
        grippers = {
            name: {"grasped": [corners.get(node, node)], "path": paths[name]}
            for name, node in zip(episode.grippers, held, strict=True)
        }
        told_away = ", ".join(f"{1e3 * one:.0f}" for one in away)
        grasped = {"grippers": Found(grippers, f"where a grasp is nearest each first position, {told_away} mm away")}
    found = {
        "center_m": Found([round(float(part), 4) for part in centre], "middle of the rectangle around the first frame"),
        "yaw_deg": Found(round(math.degrees(yaw) % 360, 2), "turn at which that rectangle is smallest"),
        "initial_state": Found("none", "the first frame shows the turn; with turn=5deg, a fit finds how far it is off"),
        "table_height_m": Found(round(table, 5), f"{1e3 * GAP_M:.1g} mm below the middle height of the first frame"),
        **grasped,
        **course,
    }
    return Layout(found, (*warnings, *told))


def flat_course(episode: Episode) -> tuple[dict[str, Found], list[str]]:
    """Return the scenario fields of time and path of a recording that begins on a table, and warnings."""
    assert episode.gripper is not None
    warnings = list[str]()
    for number, name in enumerate(episode.grippers):
        travel = float(np.ptp(episode.gripper[:, number], axis=0).max())
        if travel < _TRAVEL_M:
            warnings.append(f"{called(name, episode)} moves by {1e3 * travel:.0f} mm: such a motion shows little")
    interval = float(np.median(np.diff(episode.times))) if len(episode.times) > 1 else 0.1
    return {
        "rate_hz": Found(round(1 / interval, 6), f"frames are {interval:.4f} s apart"),
        "frames": Found(
            max(round(float(episode.times[-1]) / interval), 1), f"the recording ends at {episode.times[-1]:.3f} s"
        ),
        "path": Found(
            next(iter(own_paths(episode).values())),
            "first and last position of the gripper; fits follow its recorded track",
        ),
    }, warnings


def own_paths(episode: Episode) -> dict[str, list[list[float]]]:
    """Return the path of each gripper from its first to its last position, as keyframes (time s, dx, dy, dz m)."""
    assert episode.gripper is not None
    return {
        name: [
            [0.0, 0.0, 0.0, 0.0],
            [float(episode.times[-1]) or 1.0, *(round(float(x), 4) for x in track[-1] - track[0])],
        ]
        for name, track in zip(episode.grippers, episode.gripper.swapaxes(0, 1), strict=True)
    }


def refuse_no_track(episode: Episode) -> None:
    """Refuse a recording without the track of a gripper."""
    if episode.gripper is None:
        raise EpisodeError("The recording has no track of its gripper: put a gripper.csv (t_s, x, y, z) beside the clouds.")


def refuse_beside(beyond: float, extent: float, name: str) -> None:
    """Refuse a gripper that begins `beyond` [m] beside a cloth of this extent [m]."""
    if beyond > 0.5 * extent:
        raise EpisodeError(
            f"The first position of {name} lies {beyond:.2f} m beside the cloth. Clouds and gripper must be in one frame "
            "(the robot's base, metres, z up), and the track must begin where the cloth is grasped."
        )


def called(name: str, episode: Episode) -> str:
    """Return how messages call a gripper."""
    return "the gripper" if len(episode.grippers) == 1 else f"the gripper {name}"


def refuse_table(episode: Episode, cloud: NDArray[np.float64], sides: tuple[float, float]) -> None:
    """Check that the cloud does not contain the table, by the points that remain low when the gripper is highest.

    A cloth is lifted around the grasped point about as far as the gripper rises; otherwise it would be stretched. Table
    points remain.

    Raises:
        EpisodeError: more points remain than a cloth could leave.
    """
    assert episode.gripper is not None
    rise = (episode.gripper[:, :, 2] - episode.gripper[0, :, 2]).max(axis=1)
    top = int(rise.argmax())
    area = sides[0] * sides[1]
    cell = math.sqrt(area * _A_CELL / len(cloud))
    frame = episode.frame(top)
    lying = frame[np.abs(frame[:, 2] - np.median(cloud[:, 2])) < _LEVEL_M]
    first, stays = (len(np.unique(np.floor(points[:, :2] / cell), axis=0)) for points in (cloud, lying))
    # a quarter of a disc, as around a corner; other grasp points lift more
    reach = min(max(float(rise[top]) - _LEVEL_M, 0.0) / _STRETCHED, *sides)
    lifted = math.pi / 4 * reach**2 / area * first
    if lifted >= _FEW_CELLS and first - stays < _STAYS * lifted:
        raise EpisodeError(
            f"The clouds seem to hold the table: the first frame covers {sides[0]:.2f} x {sides[1]:.2f} m, and with the "
            f"gripper {rise[top]:.2f} m higher, points still lie on {stays / first:.0%} of that; of a cloth, at most "
            f"{1 - lifted / first:.0%} could. Only points of the cloth are allowed. Remove the table: crop the clouds to "
            "the cloth, or record the empty table too and leave out what both show."
        )


def _refuse_other_outline(
    episode: Episode, cloud: NDArray[np.float64], yaw: float, sides: tuple[float, float], centre: NDArray[np.float64]
) -> None:
    """Check that a cloud covers the rectangle around it, except near grippers, where a hand may hide it.

    Raises:
        EpisodeError: it does not.
    """
    assert episode.gripper is not None
    count = np.maximum(np.round(np.array(sides) / math.sqrt(sides[0] * sides[1] * _A_CELL / len(cloud))), 1).astype(int)
    cell = np.clip(np.floor(((cloud[:, :2] - centre) @ _turned(yaw) / sides + 0.5) * count), 0, count - 1).astype(int)
    points = np.bincount(cell @ [count[1], 1], minlength=int(count.prod()))
    middle = (np.stack(np.divmod(np.arange(count.prod()), count[1]), axis=1) + 0.5) / count - 0.5
    local = (episode.gripper[0, :, :2] - centre) @ _turned(yaw)
    seen = (np.linalg.norm(middle * sides - local[:, None], axis=2) > HAND_M).all(axis=0)
    if seen.sum() < _FEW_CELLS:
        return
    part = float((points[seen] >= _COVERED * np.median(points[points > 0])).mean())
    if part < _RECTANGLE:
        raise EpisodeError(
            f"More than {100 * HAND_M:.0f} cm from grippers, the first frame covers {part:.0%} of the rectangle around it; "
            f"a rectangular cloth covers at least {_RECTANGLE:.0%}. State the shape of another cloth by --mesh. Of a "
            "rectangle, show the whole cloth in the first frame."
        )


def covered_area(cloud: NDArray[np.float64]) -> float:
    """Return the area [m²] of the cells that a flat cloud [N, 3] covers, seen from above."""
    low, high = np.quantile(cloud[:, :2], [_RIM, 1 - _RIM], axis=0)
    cell = math.sqrt(float(np.prod(high - low)) * _A_CELL / len(cloud))
    return cell**2 * len(np.unique(np.floor(cloud[:, :2] / cell), axis=0))


def few_points(episode: Episode) -> list[str]:
    counts = np.diff(episode.offsets)
    thin = np.flatnonzero(counts < _FEW_POINTS)
    if not len(thin):
        return []
    return [f"frames {', '.join(map(str, thin[:5]))} have fewer than {_FEW_POINTS} points (as few as {counts[thin].min()})"]


def flat_cloud(episode: Episode) -> NDArray[np.float64]:
    """Return the points [N, 3] of the first frame without stray points.

    Raises:
        EpisodeError: the cloud is too large, too small, not level, or not flat.
    """
    cloud = episode.frame(0).astype(np.float64)
    middle = np.median(cloud, axis=0)
    extent = np.quantile(np.abs(cloud - middle), 0.98, axis=0) * 2
    if extent.max() > _LARGEST_M or extent.max() < _SMALLEST_M:
        guess = "millimetres" if extent.max() > _LARGEST_M else "kilometres, or hold one point"
        raise EpisodeError(
            f"The first frame is {extent.max():.3g} across. Clouds are in metres; these look as if they were in {guess}."
        )
    inside = cloud[(np.abs(cloud - middle) <= 2 * extent.max()).all(axis=1)]
    _, axes = np.linalg.eigh(np.cov((inside - inside.mean(axis=0)).T))
    tilt = math.degrees(math.acos(min(abs(float(axes[2, 0])), 1.0)))
    if tilt > _LEVEL_DEG:
        raise EpisodeError(
            f"The first frame is tilted by {tilt:.0f} degrees against the horizontal. Clouds are expected in the robot's "
            "base frame, z up, with the cloth flat on the table; these may still be in a camera's frame."
        )
    thick = float(np.quantile(inside[:, 2], 0.95) - np.quantile(inside[:, 2], 0.05))
    if thick > _FLAT_M:
        raise EpisodeError(
            f"The first frame is {1e3 * thick:.0f} mm thick: the cloth does not lie flat in it, or something else is in "
            "the cloud. Begin the recording with the cloth at rest on the table."
        )
    height = np.median(inside[:, 2])
    return inside[np.abs(inside[:, 2] - height) < _FLAT_M]


def _rectangle(cloud: NDArray[np.float64]) -> tuple[float, tuple[float, float], NDArray[np.float64]]:
    """Return yaw in [0, 90°), sides [m] and centre [2] of the smallest rectangle around a cloud seen from above."""
    points = cloud[:, :2]

    def around(yaw: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        low, high = np.quantile(points @ _turned(yaw), [_RIM, 1 - _RIM], axis=0)
        return low, high

    def area(yaw: float) -> float:
        low, high = around(yaw)
        return float(np.prod(high - low))

    yaws = np.linspace(0, math.pi / 2, 91)[:-1]
    best = float(yaws[np.argmin([area(yaw) for yaw in yaws])])
    for width in (math.radians(1.0), math.radians(0.2)):
        near = best + np.linspace(-width, width, 11)
        best = float(near[np.argmin([area(yaw) for yaw in near])])
    low, high = around(best)
    share = 1 - 2 * _RIM  # of an evenly covered side
    sides = (high - low) / share
    return best, (float(sides[0]), float(sides[1])), (low + high) / 2 @ _turned(best).T


def _turned(yaw: float) -> NDArray[np.float64]:
    """Return the matrix [2, 2] that transforms row vectors to the axes of a cloth with this yaw."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.array([[cosine, -sine], [sine, cosine]])
