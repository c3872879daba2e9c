"""Parse what people state of uncertainty: factors such as 1.5x, and standard deviations such as x=2cm,yaw=5deg."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from diffcloud.errors import ConfigError, unknown_name

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "rad": 1.0, "deg": math.pi / 180, "s": 1.0, "ms": 1e-3, "%": 1e-2}
_QUANTITY = {"m": "m", "cm": "m", "mm": "m", "rad": "rad", "deg": "rad", "s": "s", "ms": "s", "%": "1"}
_EXAMPLES = {"m": "2cm", "rad": "5deg", "s": "50ms", "1": "2%"}


def parse_factor(text: str, told: str, example: str, *, most: float, instead: str) -> float:
    """Of "1.5x".

    Args:
        told: what it is of, with which the message begins.
        example: a right one, with its parameter.
        most: the largest that means anything; and what to do instead of a larger one.

    Raises:
        ConfigError: no factor above 1, or a larger one.
    """
    match = re.fullmatch(r"([0-9.eE+-]+)\s*x", text)
    try:
        factor = float(match[1]) if match else math.nan
    except ValueError:
        factor = math.nan
    if not (factor > 1 and math.isfinite(factor)):
        raise ConfigError(f"{told}, above 1 and with an x, such as {example}; or write none.")
    if factor > most:
        raise ConfigError(f"{told}, at most {most:g}x; {instead}.")
    return factor


def parse_deviations(text: str, option: str, units: Mapping[str, str]) -> dict[str, float]:
    """What an option says of how far each variable may well be off zero -> name -> standard deviation [m, rad, s, 1].

    Args:
        text: "none", or as in "x=10cm,y=0.1,yaw=30deg,size=2%"; a length without a unit in m, a time in s. An angle names
            its unit, since 30 may be meant in degrees and 0.5 in radians, and a share is in percent.
        option: its name, for messages.
        units: of each variable, m, rad, s or 1.

    Raises:
        ConfigError: an unknown name or unit, a unit of something else, or what is no positive number; names it.
    """
    if text.strip() == "none":
        return {}
    priors: dict[str, float] = {}
    for item in text.split(","):
        name, _, value = (part.strip() for part in item.partition("="))
        if name not in units:
            raise ConfigError(f"{option}: {unknown_name(f'{option} variable', name, units)}")
        match = re.fullmatch(r"([0-9.eE+-]+?)\s*([a-z]*|%)", value)
        number = _number(match[1]) if match else math.nan
        unit = (match[2] if match else "") or {"rad": "", "1": ""}.get(units[name], units[name])
        if not (number > 0 and math.isfinite(number)) or _QUANTITY.get(unit) != units[name]:
            allowed = ", ".join(one for one, quantity in _QUANTITY.items() if quantity == units[name])
            raise ConfigError(
                f"{option} {item.strip()!r}: {name} takes how far it may well be off, a positive number in one of "
                f"{allowed}, such as {name}={_EXAMPLES[units[name]]}."
            )
        if name in priors:
            raise ConfigError(f"{option} names {name} twice.")
        priors[name] = number * _UNITS[unit]
    return priors


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
