"""Parsing of initial-state deviations such as turn=10deg,shape=5mm. `estimation.initial_state` fits them."""

from __future__ import annotations

from typing import Literal

from diffcloud.errors import ConfigError
from diffcloud.quantities import parse_deviations

INITIAL_STATE: dict[str, Literal["m", "rad", "1"]] = {"size": "1", "turn": "rad", "shape": "m", "track": "1"}
"""Variable -> unit. `shape` is the height of each wave. Shared variables come first (`estimation.names`), so that the
order in a fit and in its record is the same."""
_LARGEST_SHARE = 0.2
"""Maximum standard deviation of `size` or `track`."""


def parse_initial_state(text: str) -> dict[str, float]:
    """Parse the text of `initial_state` to name -> standard deviation [m, rad, 1].

    Raises:
        ConfigError: a name or unit is unknown, a unit does not fit the variable, or a number is not positive or too
            large.
    """
    found = parse_deviations(text, "initial_state", INITIAL_STATE)
    for name, deviation in found.items():
        if INITIAL_STATE[name] == "1" and deviation > _LARGEST_SHARE:
            raise ConfigError(
                f"initial_state {name}={100 * deviation:g}%: at most {100 * _LARGEST_SHARE:g}%; state what is that far off."
            )
    return found
