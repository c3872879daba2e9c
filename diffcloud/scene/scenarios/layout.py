"""Estimation of a cloth's layout (pose, size, grasp) from the first frame of a recording without a scenario.

The first frame shows the cloth flat on the table. Its height gives the table height. The rectangle of least area around
it gives centre, yaw and size. The grasped node is the one below the gripper's first position. Every value has a reason.
Implausible inputs are rejected before anything is simulated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
_STAYS = 0.5
"""Minimum fraction of the expected lifted area that has really left the table, if the cloud is a cloth."""
_AT_CORNER_M = 0.03
_TRAVEL_M = 0.03
_NODES = (5, 13)
_GAP_M: float = GridScenario.model_fields["gap_m"].default
"""Initial height of the cloth above the table."""
_FEW_POINTS = 100
FIELDS = ("center_m", "yaw_deg", "initial_state", "table_height_m", "grasped", "rate_hz", "frames", "path")
"""Scenario fields that `find_layout` estimates."""


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
    sides = _rectangle(_flat_cloud(episode))[1]
    return max(sides), min(sides)


def node_counts(size: tuple[float, float]) -> tuple[int, int]:
    """Return the numbers of nodes along both sides, 13 along the longer one. Coarser meshes fold differently."""
    columns, rows = (max(round((_NODES[1] - 1) * side / max(size)) + 1, _NODES[0]) for side in size)
    return columns, rows


def find_layout(episode: Episode, size: tuple[float, float], pad: float = GRIP_M) -> Layout:
    """Estimate the fields of a grid scenario from a recording.

    Args:
        episode: recording in metres, z up, with the track of one gripper.
        size: sides of the cloth [m].
        pad: side of the gripper's pad [m]; 0: a point.

    Raises:
        EpisodeError: there is no gripper track, the unit is wrong, the first cloud is not flat and level or contains
            the table, the stated size does not fit the cloud, or the gripper is not at the cloth. Says what to try.
    """
    if episode.gripper is None:
        raise EpisodeError("The recording has no track of its gripper: put a gripper.csv (t_s, x, y, z) beside the clouds.")
    if len(episode.grippers) > 1:
        raise EpisodeError(
            f"The recording has the grippers {', '.join(episode.grippers)}; this takes one. Write a scenario with "
            "`grippers` and use `diffcloud fit`."
        )
    warnings = _few_points(episode)
    cloud = _flat_cloud(episode)
    yaw, sides, centre = _rectangle(cloud)
    _refuse_table(episode, cloud, sides)
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
    gripper = episode.gripper[:, 0]
    turn = _turned(yaw)
    local = (gripper[0, :2] - centre) @ turn
    half = np.array(size) / 2
    beyond = float(np.linalg.norm(np.maximum(np.abs(local) - half, 0.0)))
    if beyond > 0.5 * max(size):
        raise EpisodeError(
            f"The gripper's first position lies {beyond:.2f} m beside the cloth. Clouds and gripper must be in one frame "
            "(the robot's base, metres, z up), and the track must begin where the cloth is grasped."
        )
    columns, rows = node_counts(size)
    across, along = np.meshgrid(np.linspace(-half[0], half[0], columns), np.linspace(-half[1], half[1], rows))
    nodes = np.stack([across.ravel(), along.ravel()], axis=-1)
    # a rectangle is symmetric under half a turn, so choose the yaw with the grasped corner at the top right
    if local[0] < 0 and local[1] < 0:
        yaw, local = yaw + math.pi, -local
    inner = np.maximum(half - pad / 2, 0.0)  # a pad at an edge is inside the cloth
    distances = np.linalg.norm(np.clip(nodes, -inner, inner) - local, axis=1)
    node = int(distances.argmin())
    if distances[node] > 0.5 * max(size) / (_NODES[1] - 1) + _AT_CORNER_M:
        warnings.append(f"the gripper begins {1e3 * distances[node]:.0f} mm beside the nearest place of a grasp")
    corners = {
        0: "left_bottom",
        columns - 1: "right_bottom",
        rows * columns - columns: "left_top",
        len(nodes) - 1: "right_top",
    }
    travel = float(np.ptp(gripper, axis=0).max())
    if travel < _TRAVEL_M:
        warnings.append(f"the gripper moves by {1e3 * travel:.0f} mm: such a motion shows little")
    table = float(np.median(cloud[:, 2])) - _GAP_M
    interval = float(np.median(np.diff(episode.times))) if len(episode.times) > 1 else 0.1
    frames = max(round(float(episode.times[-1]) / interval), 1)
    found = {
        "center_m": Found([round(float(part), 4) for part in centre], "middle of the rectangle around the first frame"),
        "yaw_deg": Found(round(math.degrees(yaw) % 360, 2), "turn at which that rectangle is smallest"),
        "initial_state": Found("none", "the first frame shows the turn; with turn=5deg, a fit finds how far it is off"),
        "table_height_m": Found(round(table, 5), f"{1e3 * _GAP_M:.1g} mm below the middle height of the first frame"),
        "grasped": Found(
            [corners.get(node, node)],
            f"where a grasp is nearest the gripper's first position, {1e3 * distances[node]:.0f} mm away",
        ),
        "rate_hz": Found(round(1 / interval, 6), f"frames are {interval:.4f} s apart"),
        "frames": Found(frames, f"the recording ends at {episode.times[-1]:.3f} s"),
        "path": Found(
            [
                [0.0, 0.0, 0.0, 0.0],
                [float(episode.times[-1]) or 1.0, *(round(float(x), 4) for x in gripper[-1] - gripper[0])],
            ],
            "first and last position of the gripper; fits follow its recorded track",
        ),
    }
    return Layout(found, tuple(warnings))


def _refuse_table(episode: Episode, cloud: NDArray[np.float64], sides: tuple[float, float]) -> None:
    """Check that the cloud does not contain the table, by the points that remain low when the gripper is highest.

    A cloth is lifted around the grasped point about as far as the gripper rises; otherwise it would be stretched. Table
    points remain.

    Raises:
        EpisodeError: more points remain than a cloth could leave.
    """
    assert episode.gripper is not None
    rise = episode.gripper[:, 0, 2] - episode.gripper[0, 0, 2]
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


def _few_points(episode: Episode) -> list[str]:
    counts = np.diff(episode.offsets)
    thin = np.flatnonzero(counts < _FEW_POINTS)
    if not len(thin):
        return []
    return [f"frames {', '.join(map(str, thin[:5]))} have fewer than {_FEW_POINTS} points (as few as {counts[thin].min()})"]


def _flat_cloud(episode: Episode) -> NDArray[np.float64]:
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
