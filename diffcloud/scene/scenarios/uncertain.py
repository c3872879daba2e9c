"""Parsing of uncertain material such as bending=1.5x,friction=2x."""

from __future__ import annotations

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.quantities import parse_factor
from diffcloud.scene.scenarios.options import MOST_UNCERTAINTY
from diffcloud.sim.properties import PARAMETERS


def parse_uncertain(text: str) -> dict[str, float]:
    """Parse the text of `--uncertain` to parameter -> standard deviation as a factor.

    Args:
        text: "none", or parameters with factors such as "bending=1.5x,air_density=1.3x".

    Raises:
        ConfigError: a parameter is unknown or repeated, or a factor is not above 1.
    """
    found: dict[str, float] = {}
    for item in [] if text.strip() == "none" else text.split(","):
        name, _, value = (part.strip() for part in item.partition("="))
        if name not in PARAMETERS:
            raise ConfigError(f"uncertain: {unknown_name('parameter', name, PARAMETERS)}")
        if name in found:
            raise ConfigError(f"uncertain names {name} twice. State it once.")
        told = f"uncertain {item.strip()!r}: {name} takes the factor within which it is known"
        found[name] = parse_factor(
            value,
            told,
            f"{name}=1.5x",
            most=MOST_UNCERTAINTY,
            instead=f"where less is known, fit it: name {name} in --parameters",
        )
    return found
