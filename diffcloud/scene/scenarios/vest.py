"""A vest lowered by one shoulder until it hangs on a hook inside it: the built-in `vest_hang`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from diffcloud.errors import SceneError
from diffcloud.io.published import PAPER_THRESHOLD, RELEASE_UNIT_M
from diffcloud.io.schema import NonNegative
from diffcloud.mesh.shapes import cylinder_surface, vest_cloth, vest_shoulder
from diffcloud.scene.scenarios.options import Coordinate, Length, ScenarioOptions, assemble
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.scene.scenarios.sheet import Sheet

_CLEARANCE = 0.015
"""Least distance between the shoulder and the hook at the start [m]: below it the straps converge on the hook."""


class VestScenario(ScenarioOptions):
    """A vest that keeps its shape, held out level by one shoulder, over a level hook that reaches through an arm hole.

    The front looks down, the shoulders to -y. The gripper holds the shoulder at +x; the hook comes from +x, inside the
    vest, and ends under that shoulder's neck end. Everything here may change in a YAML file.
    """

    material: str | Sheet = "foam"
    shaped: bool = True
    contact_thickness_m: Length = 0.008
    contact_stiffness: NonNegative = 3e6
    width_m: Length = 0.40
    """Of a panel, flat."""
    height_m: Length = 0.47
    """From the hem to the shoulder, flat."""
    depth_m: Length = 0.063
    """Half the distance between front and back."""
    center_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 1.0)
    """The middle of the hem."""
    hook_radius_m: Length = 0.0125
    hook_length_m: Length = 0.36
    hook_sides: Annotated[int, Field(ge=3, le=1000)] = 16
    hook_inset_m: Length = 0.09
    """From the shoulder to the hook's axis, towards the hem."""
    hook_reach_m: Length = 0.047
    """How far the hook reaches under the shoulder, from its arm end."""


VEST_HANG = VestScenario(
    name="vest_hang",
    path=[(0.0, 0.0, 0.0, 0.0), (1.2, 0.0, 0.0, -0.117)],
    frames=15,
    loss_frames=(10,),
    points=3500,
    learning_rate=0.3,
    threshold_m2=PAPER_THRESHOLD * RELEASE_UNIT_M**2,
    recorder="whole_surface",
)

_LEVEL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Lays a standing vest down: what looked to -y looks down, what was up points to -y."""


def vest_scenario(options: VestScenario) -> Scenario:
    """The scenario of a vest over a hook.

    Raises:
        SceneError: a hook that starts too close to the shoulder, or that reaches as far as the held node.
    """
    vest = vest_cloth(options.width_m, options.height_m, options.depth_m)
    held = vest_shoulder(1)
    neck, arm = vest.nodes[held[0]], vest.nodes[held[-1]]
    tip = float(arm[0] - options.hook_reach_m)
    if tip <= neck[0]:
        raise SceneError(
            f"Scenario {options.name}: the hook reaches {options.hook_reach_m} m under a shoulder of "
            f"{arm[0] - neck[0]:.4g} m, past its neck end; make hook_reach_m smaller."
        )
    if options.hook_inset_m < options.hook_radius_m + _CLEARANCE:
        raise SceneError(
            f"Scenario {options.name}: the hook starts {options.hook_inset_m} m from the shoulder; its radius of "
            f"{options.hook_radius_m} m needs {options.hook_radius_m + _CLEARANCE:.4g} m at least."
        )
    height = float(arm[2] - options.hook_inset_m)
    hook = cylinder_surface(
        [tip, 0.0, height], [tip + options.hook_length_m, 0.0, height], options.hook_radius_m, options.hook_sides
    )
    return assemble(
        options,
        replace(vest, nodes=vest.nodes @ _LEVEL.T + options.center_m),
        (replace(hook, nodes=hook.nodes @ _LEVEL.T + options.center_m),),
        grippers={"gripper": held},
    )
