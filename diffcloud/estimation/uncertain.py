"""Material that nobody asked for, and that is known only within a factor.

A fit of stretch and mass takes shear, compression, bending, drag, damping and friction from the scenario. None of them
is known exactly, and a hinge twice as stiff as stated moves the cloth by more than the cameras' noise: the fitted
numbers are bent until they make up for it. So such material is fitted too, each part under a prior about what is known
of it. It is not a result: a fit reports only the parameters asked for, with such material allowed for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.estimation.parameters import FitSpace, Variable
from diffcloud.estimation.priors import parse_factor
from diffcloud.scene.scenarios import Scenario
from diffcloud.scene.scenarios.options import MOST_UNCERTAINTY
from diffcloud.sim.properties import PARAMETERS

MATERIAL_UNCERTAINTY = {
    "compression": 3.0,
    "bending": 1.5,
    "drag": 1.3,
    "added_mass": 2.0,
    "linear_drag": 3.0,
    "damping": 1.5,
    "friction_obstacle": 1.3,
    "friction_cloth": 1.3,
}
"""One standard deviation of each material, as a factor."""
_FARTHEST = 4.0
"""Bounds, in standard deviations."""


def parse_uncertain(text: str) -> dict[str, float]:
    """What `--uncertain` says -> parameter -> factor of one deviation.

    Args:
        text: "none", or parameters with the factor within which each is known, as in "bending=1.5x,drag=1.3x".

    Raises:
        ConfigError: an unknown or repeated parameter, or not a factor above 1.
    """
    found: dict[str, float] = {}
    for item in [] if text.strip() == "none" else text.split(","):
        name, _, value = (part.strip() for part in item.partition("="))
        if name not in PARAMETERS:
            raise ConfigError(f"uncertain: {unknown_name('parameter', name, PARAMETERS)}")
        if name in found:
            raise ConfigError(f"uncertain name {name} twice.")
        told = f"uncertain {item.strip()!r}: {name} takes the factor within which it is known"
        found[name] = parse_factor(
            value,
            told,
            f"{name}=1.5x",
            most=MOST_UNCERTAINTY,
            instead=f"where less is known, fit it: name {name} in --parameters",
        )
    return found


def with_uncertain(space: FitSpace, uncertain: Mapping[str, float], scenarios: Sequence[Scenario]) -> FitSpace:
    """The space with uncertain material appended. Left as it is: what no scenario has, or what several
    scenarios of a joint fit state differently.

    Args:
        uncertain: parameter -> factor of one deviation about its given value, or else the scenario's.

    Raises:
        ConfigError: one is asked for.
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
