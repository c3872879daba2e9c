"""Uncertain material: nuisance parameters that are known only within a factor and are not reported.

A fit of stretching and density takes shear, compression, bending, drag, damping and friction from the scene. None of
them is known exactly. A bending stiffness that is wrong by a factor of two moves the cloth by more than the camera
noise, so it biases the fitted parameters. Such parameters are therefore fitted too, each under its own prior. Only the
requested parameters are results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diffcloud.errors import ConfigError
from diffcloud.estimation.parameters import FitSpace, Variable
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS

MATERIAL_UNCERTAINTY = {
    "compression": 3.0,
    "bending": 1.5,
    "air_density": 1.3,
    "added_mass": 2.0,
    "linear_drag": 3.0,
    "damping": 1.5,
    "friction": 1.3,
    "self_friction": 1.3,
}
"""Default standard deviation of each material parameter, as a factor."""
_FARTHEST = 4.0
"""Bounds of the variables, in standard deviations."""


def with_uncertain(space: FitSpace, uncertain: Mapping[str, float], scenarios: Sequence[Scenario]) -> FitSpace:
    """Append uncertain material to a space.

    Parameters that no scenario has are skipped, and so are those for which the scenarios of a joint fit have different
    values.

    Args:
        uncertain: parameter -> standard deviation as a factor, about its fixed value or else the scenario's.

    Raises:
        ConfigError: a parameter is also requested.
    """
    variables, fixed = list(space.variables), dict(space.fixed)
    for name, factor in uncertain.items():
        if name in space.names:
            raise ConfigError(f"uncertain: {name} is fitted; what is known of it is its prior, or its bounds.")
        known = {_stated(one, name, space.fixed) for one in scenarios}
        value = known.pop()
        if not known and value > 0:
            far = factor**_FARTHEST
            high = min(value * far, PARAMETERS[name].most)
            variables.append(Variable(name, value / far, high, factor, value, role="material"))
            fixed.pop(name, None)
    return FitSpace(tuple(variables), fixed)


def _stated(scenario: Scenario, name: str, fixed: Mapping[str, float]) -> float:
    """Return the fixed or nominal value of a parameter; zero if the scene has nothing that it acts on."""
    value = scenario.value(name)
    return fixed.get(name, value) if value else 0.0
