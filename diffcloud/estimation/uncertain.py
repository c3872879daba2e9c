"""Nuisance material: parameters that are no results, and that are known only within a factor.

A fit of stretching and density takes shear, compression, bending, drag, damping and friction from the scene. None of them
is known exactly, and a hinge twice as stiff as stated moves the cloth by more than the cameras' noise: the fitted
numbers are bent until they make up for it. So such material is fitted too, each part under a prior about what is known
of it. It is not a result: a fit reports only the requested parameters, with such material allowed for.
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
"""One standard deviation of each material, as a factor."""
_FARTHEST = 4.0
"""Bounds, in standard deviations."""


def with_uncertain(space: FitSpace, uncertain: Mapping[str, float], scenarios: Sequence[Scenario]) -> FitSpace:
    """The space with uncertain material appended. Left as it is: what no scenario has, or what several
    scenarios of a joint fit state differently.

    Args:
        uncertain: parameter -> factor of one deviation about its given value, or else the scenario's.

    Raises:
        ConfigError: one is requested.
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
    """Of one parameter; zero where the scene has nothing that it acts on."""
    value = scenario.value(name)
    return fixed.get(name, value) if value else 0.0
