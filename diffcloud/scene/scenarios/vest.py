"""A vest lowered by one shoulder until it hangs on a hook: the built-in `vest_hang`."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from diffcloud.errors import SceneError
from diffcloud.mesh.shapes import cylinder_surface, vest_cloth, vest_shoulder
from diffcloud.scene.scenarios.options import ScenarioOptions, assemble
from diffcloud.scene.scenarios.release import PAPER_THRESHOLD, RELEASE_UNIT_M
from diffcloud.scene.scenarios.scenario import Scenario
from diffcloud.scene.schema import Positive

_CLEARANCE = 0.015
"""Least distance between the shoulder and the hook at the start [m]: below it the straps converge on the hook."""


class VestScenario(ScenarioOptions):
    """An open vest over a horizontal hook that reaches through an arm hole: everything a YAML file may change.

    The gripper holds the shoulder at +x at its neck end; the hook comes from +x and ends under that shoulder.
    """

    contact_thickness_m: Positive = 0.004
    width_m: Positive = 0.40
    """Of a panel, flat."""
    height_m: Positive = 0.47
    """From the hem to the shoulder, flat."""
    depth_m: Positive = 0.063
    """Half the distance between front and back."""
    center_m: tuple[float, float] = (0.0, 0.0)
    """Where the vest's middle is."""
    hem_height_m: float = 0.6
    hook_radius_m: Positive = 0.0125
    hook_length_m: Positive = 0.36
    hook_sides: Annotated[int, Field(ge=3)] = 16
    hook_drop_m: Positive = 0.09
    """Of the hook's axis below the shoulder."""
    hook_reach_m: Positive = 0.047
    """How far the hook reaches under the shoulder, from its arm end."""


VEST_HANG = VestScenario(
    name="vest_hang",
    path=[(0.0, 0.0, 0.0, 0.0), (1.2, -0.036, 0.0, -0.117)],
    frames=15,
    steps_per_frame=3,
    loss_frames=(10,),
    points=3500,
    learning_rate=0.3,
    threshold_m2=PAPER_THRESHOLD * RELEASE_UNIT_M**2,
    recorder="whole_surface",
)


def vest_scenario(options: VestScenario) -> Scenario:
    """The scenario of a vest over a hook.

    Raises:
        SceneError: a hook that starts too close to the shoulder, or that reaches as far as the held node.
    """
    standing = vest_cloth(options.width_m, options.height_m, options.depth_m)
    mesh = replace(standing, nodes=np.add(standing.nodes, (*options.center_m, options.hem_height_m)))
    neck, *_, arm = vest_shoulder(1)
    shoulder = mesh.nodes[arm]
    tip = float(shoulder[0] - options.hook_reach_m)
    if tip <= mesh.nodes[neck, 0]:
        raise SceneError(
            f"Scenario {options.name}: the hook reaches {options.hook_reach_m} m under a shoulder of "
            f"{shoulder[0] - mesh.nodes[neck, 0]:.4g} m, as far as the held node; make hook_reach_m smaller."
        )
    if options.hook_drop_m < options.hook_radius_m + _CLEARANCE:
        raise SceneError(
            f"Scenario {options.name}: the hook starts {options.hook_drop_m} m below the shoulder; its radius of "
            f"{options.hook_radius_m} m needs {options.hook_radius_m + _CLEARANCE:.4g} m at least."
        )
    height = float(shoulder[2] - options.hook_drop_m)
    y = options.center_m[1]
    hook = cylinder_surface(
        [tip, y, height], [tip + options.hook_length_m, y, height], options.hook_radius_m, options.hook_sides
    )
    return assemble(options, mesh, (hook,), grasped=[neck])
