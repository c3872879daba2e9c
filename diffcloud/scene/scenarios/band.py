"""The built-in `band_stretch`: an elastic band that hangs on a level pole and is pulled away from it."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from diffcloud.errors import SceneError
from diffcloud.io.published import PAPER_THRESHOLD, RELEASE_UNIT_M
from diffcloud.io.schema import NonNegative
from diffcloud.mesh.shapes import box_surface, cylinder_surface, loop_cloth
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios.options import Coordinate, Length, ScenarioOptions, assemble
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.scene.scenarios.sheet import Sheet


class BandScenario(ScenarioOptions):
    """An elastic band without slack around a level pole and a gripper in front of the pole (at -y). The band runs like
    a belt around two level pulleys, with one strand above the other. A YAML file may set every field."""

    material: str | Sheet = "soft-foam"
    contact_thickness_m: Length = 0.008
    contact_stiffness: NonNegative = 1e6
    circumference_m: Length = 1.75
    width_m: Length = 0.12
    nodes: tuple[Annotated[int, Field(ge=4, le=500)], Annotated[int, Field(ge=2, le=500)]] = (32, 2)
    """Number of nodes along the band and across it."""
    center_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 1.0)
    """Centre of the band at the start."""
    pole: Literal["square", "round"] = "round"
    pole_width_m: Length = 0.08
    """Side of the square pole, or diameter of the round one."""
    pole_length_m: Length = 0.4
    """Length along x, with the band at its centre."""
    pole_sides: Annotated[int, Field(ge=3, le=1000)] = 24
    """Number of sides of a round pole's mesh."""
    pole_gap_m: Length = 0.012
    """Gap between band and pole at the start."""
    grasped_columns: Annotated[int, Field(ge=1, le=500)] = 3
    """Number of nodes along the band that the gripper holds, over its whole width."""


BAND_STRETCH = BandScenario(
    name="band_stretch",
    path=[(0.0, 0.0, 0.0, 0.0), (1.2, 0.0, -0.2, 0.0)],
    frames=25,
    loss_frames=(24,),
    points=5500,
    learning_rate=0.4,
    threshold_m2=PAPER_THRESHOLD * RELEASE_UNIT_M**2,
    recorder="whole_surface",
)

_ON_EDGE = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
"""Rotation of a level loop with axis z onto its edge: the axis to -x, x to +z."""


def band_scenario(options: BandScenario) -> Scenario:
    """Return the scenario of a band around a pole.

    Raises:
        SceneError: the pole is too thick for the band, or there are more grasped columns than the band has.
    """
    along, across = options.nodes
    if options.grasped_columns >= along:
        raise SceneError(
            f"Scenario {options.name}: {options.grasped_columns} grasped columns, but the band has {along} nodes along it."
        )
    radius = options.pole_gap_m + options.pole_width_m * (0.5 if options.pole == "round" else 0.5**0.5)
    if 2 * np.pi * radius > options.circumference_m:
        raise SceneError(
            f"Scenario {options.name}: a band of {options.circumference_m} m does not go around a {options.pole} pole "
            f"{options.pole_width_m} m wide with gaps of {options.pole_gap_m} m; make it longer than "
            f"{2 * np.pi * radius:.3g} m, or the pole thinner."
        )
    loop = loop_cloth(across, along, options.width_m, options.circumference_m, radius)
    pole = _pole(options, float(loop.nodes[:, 1].max()) - radius)
    mesh = replace(loop, nodes=loop.nodes @ _ON_EDGE.T + options.center_m)
    front = -(options.grasped_columns // 2)
    columns = (front + np.arange(options.grasped_columns)) % along
    return assemble(
        options,
        mesh,
        (replace(pole, nodes=pole.nodes @ _ON_EDGE.T + options.center_m),),
        grippers={"gripper": [int(row * along + column) for row in range(across) for column in columns]},
    )


def _pole(options: BandScenario, offset: float) -> SurfaceMesh:
    """Return the upright pole at y = offset."""
    half, end = options.pole_width_m / 2, options.pole_length_m / 2
    if options.pole == "square":
        return box_surface([-half, offset - half, -end], [half, offset + half, end])
    return cylinder_surface([0.0, offset, -end], [0.0, offset, end], half, options.pole_sides)
