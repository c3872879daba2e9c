"""Built-in scenario `hang`: a rectangular cloth that hangs at rest from a gripper, which then moves it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from diffcloud.errors import DivergedError, SceneError
from diffcloud.io.episodes import ONLY_GRIPPER
from diffcloud.mesh.shapes import grid_cloth
from diffcloud.scene.description import Scene
from diffcloud.scene.scenarios.options import Coordinate, Length, ScenarioOptions, assemble
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.sim.grasp import GRIP_M, Grasp
from diffcloud.sim.simulate import rollout
from diffcloud.sim.system import State

HeldPart = Literal["edge", "corners", "corner"]

_STEP_S, _CHUNK, _LONGEST_S = 0.05, 20, 12.0
"""Settling uses backward Euler, which damps: time step [s], steps per chunk, and longest time [s]."""
_AT_REST = 1e-3
"""Largest speed [m/s] of a node at which the cloth counts as at rest."""
_UNEVEN_M = 1e-3
"""Standard deviation [m] of noise on a cloth held at a corner. Without noise, it would stay in an unstable plane."""


class HangScenario(ScenarioOptions):
    """A rectangular cloth that hangs at rest from a gripper. A YAML file may set every field."""

    size_m: tuple[Length, Length]
    """Extent along the cloth's own x and y."""
    nodes: tuple[Annotated[int, Field(ge=2, le=500)], Annotated[int, Field(ge=2, le=500)]] = (7, 7)
    """Node counts along x and y."""
    held: HeldPart = "edge"
    """Held part: a whole side (as by a bar), both corners of that side, or one corner."""
    side: Literal["x", "y"] = "x"
    """Direction of the held side in the cloth's own axes."""
    rim_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.6)
    """Midpoint of the held side, or the held corner."""
    yaw_deg: Annotated[float, Field(ge=-360, le=360)] = 0.0
    """Direction of the held side: rotation about the vertical from the world's x axis."""
    span: Annotated[float, Field(gt=0.3, le=1)] = 1.0
    """Ratio of the distance of the held corners to the length of their side. Below 1, the cloth bows to the left."""
    grippers: Annotated[tuple[str, ...], Field(min_length=1, max_length=2)] = (ONLY_GRIPPER[0],)
    """Names of the grippers. Of two, the first holds the corner at the start of the side's direction."""
    grip_m: Length = GRIP_M
    """Size of the grasp at a corner, which lets the cloth rotate."""
    air: Literal["none", "drag", "still"] = "still"
    self_contact: bool = False


HANG = HangScenario(
    name="hang",
    size_m=(0.3, 0.3),
    path=[(0.0, 0.0, 0.0, 0.0), (0.4, 0.0, 0.1, 0.0), (1.0, 0.0, -0.1, 0.0), (1.4, 0.0, 0.0, 0.0), (2.5, 0.0, 0.0, 0.0)],
    recorder="whole_surface",
)


def hang_scenario(options: HangScenario) -> Scenario:
    """Build the scenario. It starts in the equilibrium of the scenario's material.

    Raises:
        SceneError: a held edge has a span below 1, two grippers do not hold corners, or the simulation of the settling
            cloth diverges.
    """
    if options.held == "edge" and options.span < 1:
        raise SceneError(f"Scenario {options.name}: a held edge is straight, so its span is 1; got {options.span:g}.")
    if len(options.grippers) > 1 and options.held != "corners":
        raise SceneError(f"Scenario {options.name}: two grippers hold `corners`, not {options.held}.")
    flat = grid_cloth(*reversed(options.nodes), *reversed(options.size_m))
    held = _held(options)
    scenario = assemble(
        options,
        replace(flat, nodes=_unfolded(options, flat.verts)),
        (),
        grippers={name: [*held[number :: len(options.grippers)]] for number, name in enumerate(options.grippers)},
        grasp=None if options.held == "edge" else Grasp("pivot", options.grip_m),
    )
    try:
        nodes = settled(scenario.scene)
    except DivergedError as error:
        raise SceneError(f"Scenario {options.name}: the hanging cloth does not come to rest: {error}") from error
    scene = scenario.scene
    return replace(scenario, scene=replace(scene, mesh=replace(scene.mesh, nodes=nodes)))


def _held(options: HangScenario) -> Sequence[int]:
    """Return the nodes that the gripper holds."""
    columns, rows = options.nodes
    edge = (
        range((rows - 1) * columns, rows * columns) if options.side == "x" else range(columns - 1, rows * columns, columns)
    )
    match options.held:
        case "edge":
            return list(edge)
        case "corners":
            return [edge[0], edge[-1]]
        case "corner":
            return [rows * columns - 1]


def _unfolded(options: HangScenario, verts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nodes [V, 3] before settling, for verts [V, 2] in material space."""
    yaw = np.deg2rad(options.yaw_deg)
    along, normal = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    size = np.array(options.size_m)
    left = size - verts  # [V, 2] distance from the sides that meet in the held corner
    if options.held == "corner":
        diagonal = size / np.linalg.norm(size)
        down, across = left @ diagonal, left @ [-diagonal[1], diagonal[0]]
        bow = np.random.default_rng(0).normal(0.0, _UNEVEN_M, len(verts)) * (down > 0)
    else:
        own = 0 if options.side == "x" else 1
        length, down = size[own], left[:, 1 - own]
        across = options.span * (length / 2 - left[:, own])
        height = 2 / np.pi * options.span * length * np.sqrt(1 / options.span - 1)  # a sine of about the side's length
        bow = height * np.sin(np.pi * left[:, own] / length)
    return np.array(options.rim_m) + across[:, None] * along + bow[:, None] * normal - down[:, None] * [0.0, 0.0, 1.0]


def settled(scene: Scene) -> NDArray[np.float64]:
    """Return the positions [V, 3] of the cloth at rest [m], with its grippers fixed.

    Raises:
        DivergedError: the simulation diverged.
    """
    handles = replace(scene.handles, handles=tuple(replace(one, motion=None) for one in scene.handles.handles))
    system, state = replace(scene, handles=handles, frame_time=_STEP_S, frame_steps=1, order=1).build()
    for _ in range(round(_LONGEST_S / (_CHUNK * _STEP_S))):
        run = rollout(system, _CHUNK, state=state)
        state = State(run.positions[:, -1], run.velocities[:, -1], None)
        if float(state.velocities.norm(dim=-1).max()) < _AT_REST:
            break
    return np.asarray(state.positions[0].numpy())
