"""The built-in `vest_hang`: a vest that is lowered at one shoulder until it hangs on a hook."""

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
"""Minimum initial distance between shoulder and hook [m]; closer, the straps start in contact with the hook."""


class VestScenario(ScenarioOptions):
    """A shaped vest, held level at one shoulder, over a level hook that reaches through an arm hole. The front faces
    down, and the shoulders point to -y. The gripper holds the shoulder at +x. The hook comes from +x inside the vest,
    and ends below the neck end of that shoulder. A YAML file may set every field."""

    material: str | Sheet = "foam"
    shaped: bool = True
    contact_thickness_m: Length = 0.008
    contact_stiffness: NonNegative = 3e6
    width_m: Length = 0.40
    """Width of a flat panel."""
    height_m: Length = 0.47
    """Height of a flat panel from the hem to the shoulder."""
    depth_m: Length = 0.063
    """Half the distance between front and back."""
    center_m: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 1.0)
    """Centre of the hem."""
    hook_radius_m: Length = 0.0125
    hook_length_m: Length = 0.36
    hook_sides: Annotated[int, Field(ge=3, le=1000)] = 16
    hook_inset_m: Length = 0.09
    """Distance from the shoulder to the hook's axis, towards the hem."""
    hook_reach_m: Length = 0.047
    """Length of the hook below the shoulder, from its arm end."""


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
"""Rotation from a standing to a lying vest: -y becomes down, up becomes -y."""


def vest_scenario(options: VestScenario) -> Scenario:
    """Return the scenario of a vest over a hook.

    Raises:
        SceneError: the hook starts too close to the shoulder, or reaches as far as the held node.
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
