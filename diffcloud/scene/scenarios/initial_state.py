"""How the cloth may lie otherwise than the scene has it when a motion begins, as people state it: turn=10deg,shape=5mm.

`estimation.initial_state` has what these variables do, and fits them.
"""

from __future__ import annotations

from typing import Literal

from diffcloud.errors import ConfigError
from diffcloud.quantities import parse_deviations

INITIAL_STATE: dict[str, Literal["m", "rad", "1"]] = {"size": "1", "turn": "rad", "shape": "m", "track": "1"}
"""Name -> unit. `shape` stands for the height of each wave. What recordings share comes first (`estimation.names`), so
that the variables of each are in the same order in a fit and in its record."""
_LARGEST_SHARE = 0.2
"""Largest standard deviation of `size` or `track`."""


def parse_initial_state(text: str) -> dict[str, float]:
    """What `initial_state` says -> name -> standard deviation of its prior [m, rad, 1], as of `parse_deviations`.

    Raises:
        ConfigError: an unknown name or unit, a unit of something else, what is no positive number, or a share that is too
            large; names it.
    """
    found = parse_deviations(text, "initial_state", INITIAL_STATE)
    for name, deviation in found.items():
        if INITIAL_STATE[name] == "1" and deviation > _LARGEST_SHARE:
            raise ConfigError(
                f"initial_state {name}={100 * deviation:g}%: at most {100 * _LARGEST_SHARE:g}%; state what is that far off."
            )
    return found
