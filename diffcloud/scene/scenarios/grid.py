"""A rectangular cloth over a table: the built-ins `lift` and `fold`, and a person's own cloth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from diffcloud.errors import SceneError, unknown_name
from diffcloud.io.schema import Checked, NonNegative
from diffcloud.mesh.shapes import grid_cloth, rectangle_surface
from diffcloud.mesh.topology import ClothMesh
from diffcloud.scene.scenarios.options import Coordinate, Keyframes, Length, ScenarioOptions, assemble
from diffcloud.scene.scenarios.scenario import Scenario

Names = tuple[str | int, ...]
"""Nodes: corners (left/right_bottom/top of the unrotated cloth) or indices."""


class Gripper(Checked):
    """One of several."""

    grasped: Annotated[Names, Field(min_length=1)]
    path: Keyframes | None = None
    """Its displacement; without, the scenario's `path`."""


class GridScenario(ScenarioOptions):
    """A rectangular cloth over a table: everything a person may change in a YAML file (SI units)."""

    size_m: tuple[Length, Length]
    """Extent along the cloth's own x and y."""
    nodes: tuple[Annotated[int, Field(ge=2, le=500)], Annotated[int, Field(ge=2, le=500)]] = (7, 7)
    """Node counts along x and y."""
    center_m: tuple[Coordinate, Coordinate] = (0.0, 0.0)
    """Where the cloth's centre lies on the table."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 45.0
    """Rotation about the vertical; 45 lays a square cloth as a diamond."""
    table_height_m: Coordinate = 0.0
    gap_m: NonNegative = 0.002
    """Height of the cloth over the table at the start."""
    grasped: Names = ()
    """Nodes that the gripper moves."""
    grippers: dict[str, Gripper] = Field(default_factory=dict)
    """Instead of `grasped`, where several grippers move the cloth: name -> what it does."""
    held: Names = ()
    """Nodes that stay where they are."""
    loss_surface: Literal["all", "grasped_half"] = "all"
    laid_turn_deg: Annotated[float, Field(ge=0, le=45)] = 10.0
    """How far askew the cloth may lie at the start, one standard deviation; 0: not at all. Fits find it. A hand seldom lays
    a cloth down more exactly, and one that lies askew under a gripper moves in another way."""
    laid_shape_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    """How uneven: one standard deviation of the height of each of nine waves."""
    laid_size: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """By what fraction the cloth may be larger or smaller than `size_m`, one standard deviation."""
    laid_track: Annotated[float, Field(ge=0, le=0.2)] = 0.0
    """By what fraction the gripper's path may be longer or shorter than recorded, one standard deviation."""

    @model_validator(mode="after")
    def _is_grasped_once(self) -> GridScenario:
        if bool(self.grasped) == bool(self.grippers):
            raise ValueError("give either `grasped` or `grippers` and what each grasps")
        return self

    @property
    def own_paths(self) -> Mapping[str, Keyframes]:
        return {name: one.path for name, one in self.grippers.items() if one.path is not None}


_SIDE = 0.2625
"""Side of the cloth of the paper's experiments [m] (0.75 release units)."""
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
    """The scenario of a rectangular cloth over a table.

    Raises:
        SceneError: a corner or node that does not exist.
    """
    columns, rows = options.nodes
    flat = grid_cloth(rows, columns, options.size_m[1], options.size_m[0])
    yaw = np.deg2rad(options.yaw_deg)
    turn = np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])  # for row vectors
    start = np.array([*options.center_m, options.table_height_m + options.gap_m])
    mesh = replace(flat, nodes=flat.nodes @ turn + start)
    named = {name: one.grasped for name, one in options.grippers.items()} or {"gripper": options.grasped}
    grippers = {name: _named_nodes(options, nodes) for name, nodes in named.items()}
    grasped = [*chain.from_iterable(grippers.values())]
    extent = 2.0 * max(options.size_m) + options.reach
    scenario = assemble(
        options,
        mesh,
        (rectangle_surface(options.center_m, (extent, extent), options.table_height_m),),
        grippers=grippers,
        held=_named_nodes(options, options.held),
        loss_faces=_half(mesh, grasped) if options.loss_surface == "grasped_half" else None,
    )
    laid = {
        "turn": math.radians(options.laid_turn_deg),
        "shape": options.laid_shape_m,
        "size": options.laid_size,
        "track": options.laid_track,
    }
    return replace(scenario, laid={name: deviation for name, deviation in laid.items() if deviation})


def _named_nodes(options: GridScenario, names: Sequence[str | int]) -> list[int]:
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
            raise SceneError(f"Scenario {options.name}: node {node} does not exist, the cloth has 0..{rows * columns - 1}.")
        nodes.append(node)
    return nodes


def _half(mesh: ClothMesh, grasped: list[int]) -> NDArray[np.int64]:
    """Faces on the grasped side of the cloth's middle: the part that comes to lie on top."""
    side = mesh.nodes[grasped].mean(axis=0) - mesh.nodes.mean(axis=0)
    centre = mesh.nodes[mesh.faces].mean(axis=1) - mesh.nodes.mean(axis=0)
    return np.flatnonzero(centre @ side > 0)
