"""An elastic band around a pole on a table, pulled away and up until it is taut: the built-in `band_stretch`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from diffcloud.errors import SceneError
from diffcloud.mesh.shapes import box_surface, cylinder_surface, loop_cloth, rectangle_surface
from diffcloud.mesh.topology import SurfaceMesh
from diffcloud.scene.scenarios.options import ScenarioOptions, assemble
from diffcloud.scene.scenarios.release import PAPER_THRESHOLD, RELEASE_UNIT_M
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.scene.schema import NonNegative, Positive


class BandScenario(ScenarioOptions):
    """A band that stands upright on a table, laid around a pole and a gripper in front (at -y) without slack.

    Everything here may change in a YAML file.
    """

    contact_thickness_m: Positive = 0.004
    circumference_m: Positive = 1.2
    width_m: Positive = 0.06
    nodes: tuple[Annotated[int, Field(ge=4)], Annotated[int, Field(ge=2)]] = (32, 2)
    """Node counts along the band and across it."""
    center_m: tuple[float, float] = (0.0, 0.0)
    """Where the band's middle stands on the table."""
    table_height_m: float = 0.0
    gap_m: NonNegative = 0.005
    """Height of the band over the table at the start."""
    pole: Literal["square", "round"] = "round"
    pole_width_m: Positive = 0.1
    """Side of the square, or diameter."""
    pole_height_m: Positive = 0.4
    pole_sides: Annotated[int, Field(ge=3)] = 24
    """Of a round pole."""
    pole_gap_m: Positive = 0.008
    """Between the band and the pole at the start."""
    grasped_columns: Annotated[int, Field(ge=1)] = 3
    """Nodes along the band that the gripper holds, over its whole width."""


BAND_STRETCH = BandScenario(
    name="band_stretch",
    path=[(0.0, 0.0, 0.0, 0.0), (2.4, 0.0, -0.34, 0.25)],
    frames=25,
    steps_per_frame=3,
    loss_frames=(24,),
    points=5500,
    learning_rate=0.4,
    threshold_m2=PAPER_THRESHOLD * RELEASE_UNIT_M**2,
    recorder="whole_surface",
)


def band_scenario(options: BandScenario) -> Scenario:
    """The scenario of a band around a pole.

    Raises:
        SceneError: a pole too thick for the band, or more grasped columns than the band has.
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
    middle = options.table_height_m + options.gap_m + options.width_m / 2
    mesh = replace(loop, nodes=np.add(loop.nodes, (*options.center_m, middle)))
    front = -(options.grasped_columns // 2)
    columns = (front + np.arange(options.grasped_columns)) % along
    extent = options.circumference_m + options.reach
    return assemble(
        options,
        mesh,
        (
            _pole(options, float(loop.nodes[:, 1].max()) - radius),
            rectangle_surface(options.center_m, (extent, extent), options.table_height_m),
        ),
        grasped=[int(row * along + column) for row in range(across) for column in columns],
    )


def _pole(options: BandScenario, offset: float) -> SurfaceMesh:
    axis = np.add(options.center_m, (0.0, offset))
    half = options.pole_width_m / 2
    bottom, top = options.table_height_m, options.table_height_m + options.pole_height_m
    if options.pole == "square":
        return box_surface([*(axis - half), bottom], [*(axis + half), top])
    return cylinder_surface([*axis, bottom], [*axis, top], half, options.pole_sides)
