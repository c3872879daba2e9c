"""Material that is known only within a factor, as people state it: bending=1.5x,friction=2x."""

from __future__ import annotations

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.quantities import parse_factor
from diffcloud.scene.scenarios.options import MOST_UNCERTAINTY
from diffcloud.sim.properties import PARAMETERS


def parse_uncertain(text: str) -> dict[str, float]:
    """What `--uncertain` says -> parameter -> factor of one deviation.

    Args:
        text: "none", or parameters with the factor within which each is known, as in "bending=1.5x,air_density=1.3x".

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
