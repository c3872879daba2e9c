"""A rectangular cloth over a table: the built-in `lift`, `fold` and `shake`, and users' own cloths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from diffcloud.errors import ConfigError, SceneError, unknown_name
from diffcloud.io.schema import Checked, NonNegative
from diffcloud.mesh.shapes import lined_cloth, rectangle_surface
from diffcloud.mesh.topology import ClothMesh
from diffcloud.scene.scenarios.initial_state import parse_initial_state
from diffcloud.scene.scenarios.options import Coordinate, Keyframes, Length, Regrip, ScenarioOptions, assemble, sunk
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.sim.grasp import GRIP_M, Grasp, Grip, inside, turned_up, window

Names = tuple[str | int, ...]
"""Grasp points: corners (left/right_bottom/top of the unrotated cloth), or node numbers of the uniform grid."""


class Gripper(Checked):
    """One of several grippers."""

    grasped: Annotated[Names, Field(min_length=1)]
    path: Keyframes | None = None
    """Displacement of this gripper. Default: the scenario's `path`."""


class GridScenario(ScenarioOptions):
    """A rectangular cloth over a table. A YAML file may set every field (SI units)."""

    size_m: tuple[Length, Length]
    """Size along the cloth's own x and y."""
    nodes: tuple[Annotated[int, Field(ge=2, le=500)], Annotated[int, Field(ge=2, le=500)]] = (7, 7)
    """Number of nodes along x and y."""
    center_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    """Position of the cloth's centre on the table."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 45.0
    """Rotation about the vertical. With 45, a square cloth is a diamond."""
    table_height_m: Coordinate = 0.0
    gap_m: NonNegative = 0.0006
    """Initial height of the cloth's mid-surface above the table. This is the rest height, unless contact holds the
    cloth higher; then it falls from there. Default: half the thickness of a usual cloth."""
    grasped: Names = ()
    """Grasp points that the gripper moves. Adjacent ones form one grasp."""
    grippers: dict[str, Gripper] = Field(default_factory=dict)
    """Several grippers instead of `grasped`: name -> settings."""
    held: Names = ()
    """Grasp points that stay fixed."""
    grip: Grip = "pad"
    """Type of each grasp: a pad with fixed orientation, level (`pad`) or upright (`upright_pad`), or a point that lets
    the cloth rotate (`pivot`)."""
    grip_m: Length = GRIP_M
    """Side of the pad, or of the square that a pivot represents."""
    grip_known_within: Annotated[float, Field(ge=1, le=3)] = 1.0
    """Standard deviation of `grip_m`, as a factor. With 1, `grip_m` is exact. Fits by `likelihood` take it into account."""
    loss_surface: Literal["all", "grasped_half"] = "all"
    initial_state: Annotated[str, Field(max_length=200)] = "turn=10deg"
    """Standard deviations of the deviations from the initial state, which fits estimate: `turn` about the cloth's
    centre, `shape` (height of each of nine waves), `size` of the cloth, and `track` (length of the gripper's path).
    Example: turn=5deg,shape=5mm,size=2%,track=2%; or none. People seldom place a cloth more exactly than within 10
    degrees."""

    @field_validator("initial_state")
    @classmethod
    def _states_deviations(cls, text: str) -> str:
        try:
            parse_initial_state(text)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return text

    @model_validator(mode="after")
    def _is_grasped_once(self) -> GridScenario:
        if bool(self.grasped) == bool(self.grippers):
            raise ValueError("give either `grasped` or `grippers` and what each grasps")
        return self

    @property
    def own_paths(self) -> Mapping[str, Keyframes]:
        return {name: one.path for name, one in self.grippers.items() if one.path is not None}


_NARROWEST = 0.1
"""Minimum distance of two grid lines, in sizes of a grasp."""
_SIDE = 0.2625
"""Side of the cloth in the paper's experiments [m] (0.75 release units)."""
LIFT = GridScenario(
    name="lift",
    size_m=(_SIDE, _SIDE),
    grasped=("right_top",),
    path=[(0.0, 0.0, 0.0, 0.0), (2.5, 0.0, -0.14, 0.40)],
)
FOLD = GridScenario(
    name="fold",
    size_m=(_SIDE, _SIDE),
    grasped=("left_bottom",),
    held=("right_top",),
    path=[(0.0, 0.0, 0.0, 0.0), (1.25, 0.0, 0.12, 0.26), (2.5, 0.0, 0.28, 0.08)],
    steps_per_frame=4,
    loss_frames=(15,),
    loss_surface="grasped_half",
)
SHAKE = GridScenario(
    name="shake",
    size_m=(_SIDE, _SIDE),
    yaw_deg=0.0,
    grippers={"left": Gripper(grasped=("left_top",)), "right": Gripper(grasped=("right_top",))},
    path=[
        (0.0, 0.0, 0.0, 0.0),
        (1.0, 0.0, 0.0, 0.36),
        (1.5, 0.0, -0.08, 0.36),
        (2.0, 0.0, 0.08, 0.36),
        (2.5, 0.0, 0.0, 0.36),
    ],
    steps_per_frame=16,
    recorder="whole_surface",
)


def grid_scenario(options: GridScenario) -> Scenario:
    """Return the scenario of a rectangular cloth over a table.

    Raises:
        SceneError: a corner or node does not exist, a pad is as large as the cloth, or there are too few nodes for the
            pads.
    """
    named = {name: one.grasped for name, one in options.grippers.items()} or {"gripper": options.grasped}
    places = [_places(options, names) for names in (*named.values(), options.held)]
    lines, pads = _pads(options, places)
    columns = len(lines[0])
    verts = np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2)
    uniform = [np.linspace(0, side, count) for side, count in zip(options.size_m, options.nodes, strict=True)]
    first = np.array([uniform[0][places[0][0] % columns], uniform[1][places[0][0] // columns]])
    flat = lined_cloth(*lines, through=int(np.linalg.norm(verts - first, axis=1).argmin()))
    yaw = np.deg2rad(options.yaw_deg)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])  # for row vectors
    start = np.array([*options.center_m, options.table_height_m + options.gap_m])
    mesh = replace(flat, nodes=flat.nodes @ turn + start)
    held: list[list[list[int]]] = [[inside(verts, *pad).tolist() for pad in each] for each in pads or []]
    nodes = places if pads is None else [[*chain.from_iterable(each)] for each in held]
    numbers = {node: number for number, each in enumerate(chain.from_iterable(held), 1) for node in each}
    turned: dict[int, tuple[float, float, float]] = {}
    if options.grip == "upright_pad":
        for each in chain.from_iterable(held):
            try:
                way = turned_up(verts[each], verts[0], verts[-1]) @ turn
            except SceneError as error:
                raise SceneError(f"Scenario {options.name}: {error}") from error
            turned |= {node: (x, y, z) for node, (x, y, z) in zip(each, way.tolist(), strict=True)}
    grasped = [*chain.from_iterable(nodes[:-1])]
    extent = 2.0 * max(options.size_m) + options.reach
    scenario = assemble(
        options,
        mesh,
        (rectangle_surface(options.center_m, (extent, extent), options.table_height_m - sunk(options, options.gap_m)),),
        grippers=dict(zip(named, nodes[:-1], strict=True)),
        held=nodes[-1],
        grasp=Grasp(options.grip, options.grip_m),
        pads=numbers,
        turned=turned,
        loss_faces=_half(mesh, grasped) if options.loss_surface == "grasped_half" else None,
    )
    regrip = Regrip(grid_scenario, options) if options.grip_known_within > 1 else None
    return replace(scenario, initial_state=parse_initial_state(options.initial_state), regrip=regrip)


def _places(options: GridScenario, names: Sequence[str | int]) -> list[int]:
    columns, rows = options.nodes
    corners = {
        "left_bottom": 0,
        "right_bottom": columns - 1,
        "left_top": (rows - 1) * columns,
        "right_top": rows * columns - 1,
    }
    nodes = []
    for name in names:
        if isinstance(name, str) and name not in corners:
            raise SceneError(f"Scenario {options.name}: " + unknown_name("corner", name, corners))
        node = corners[name] if isinstance(name, str) else name
        if not 0 <= node < rows * columns:
            raise SceneError(
                f"Scenario {options.name}: node {node} does not exist. The cloth has nodes 0 to {rows * columns - 1}."
            )
        nodes.append(node)
    return nodes


_Pad = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lower and upper corner of a rectangle in material space [2] [m]."""


def _pads(
    options: GridScenario, places: Sequence[Sequence[int]]
) -> tuple[list[NDArray[np.float64]], list[list[_Pad]] | None]:
    """Return grid lines along x and y, and the pads of each gripper (uniform lines and None for pivots)."""
    uniform = [np.linspace(0, side, count) for side, count in zip(options.size_m, options.nodes, strict=True)]
    if options.grip == "pivot":
        return uniform, None
    if options.grip_m >= min(options.size_m):
        raise SceneError(
            f"Scenario {options.name}: a pad of {options.grip_m:g} m does not fit on a cloth of {options.size_m[0]:g} x "
            f"{options.size_m[1]:g} m. It must be smaller than both sides; give a smaller grip_m."
        )
    size = np.array(options.size_m)
    pads: list[list[_Pad]] = []
    for each in places:
        cells = np.array([[node % options.nodes[0], node // options.nodes[0]] for node in each]).reshape(-1, 2)
        pads.append([])
        while len(cells):
            near = np.zeros(len(cells), dtype=bool)
            near[0] = True
            while (more := (np.abs(cells[:, None] - cells[near]).max(-1) <= 1).any(1)).sum() > near.sum():
                near = more
            squares = [
                window(np.array([uniform[0][i], uniform[1][j]]), np.zeros(2), size, options.grip_m) for i, j in cells[near]
            ]
            pads[-1].append((np.min([one for one, _ in squares], axis=0), np.max([two for _, two in squares], axis=0)))
            cells = cells[~near]
    ends = [[end[axis] for each in pads for pad in each for end in pad] for axis in (0, 1)]
    return [_lines(options, axis, np.array(ends[axis])) for axis in (0, 1)], pads


def _lines(options: GridScenario, axis: int, ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the grid lines along an axis: at the cloth's edges and the pads' ends, as uniform as possible between."""
    length, count, name = options.size_m[axis], options.nodes[axis], "xy"[axis]
    breaks = np.unique(np.round([0.0, length, *ends], 9))
    gaps = np.diff(breaks)
    if count < len(breaks):
        raise SceneError(
            f"Scenario {options.name}: {count} nodes along {name} are too few for pads that end at "
            f"{', '.join(f'{end:.4g}' for end in breaks[1:-1])} m. Give at least {len(breaks)}, or `grip: pivot`."
        )
    if gaps.min() < _NARROWEST * options.grip_m:
        raise SceneError(
            f"Scenario {options.name}: along {name}, two ends of pads lie {1e3 * gaps.min():.2g} mm apart, too near "
            f"for grid lines. Ends must coincide or lie {1e3 * _NARROWEST * options.grip_m:.2g} mm apart; change grip_m or "
            "the places a little."
        )
    cells = np.ones(len(gaps), dtype=int)
    for _ in range(count - len(breaks)):
        cells[(gaps / cells).argmax()] += 1
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(breaks[:-1], breaks[1:], cells, strict=True)]
    return np.array([*np.concatenate(parts), length])


def _half(mesh: ClothMesh, grasped: list[int]) -> NDArray[np.int64]:
    """Return the faces on the grasped side of the cloth's centre, which end up on top in a fold."""
    side = mesh.nodes[grasped].mean(axis=0) - mesh.nodes.mean(axis=0)
    centre = mesh.nodes[mesh.faces].mean(axis=1) - mesh.nodes.mean(axis=0)
    return np.flatnonzero(centre @ side > 0)
