"""Parse uncertainties on the command line: factors such as 1.5x, and standard deviations such as x=2cm,yaw=5deg."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from diffcloud.errors import ConfigError, unknown_name

_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "rad": 1.0, "deg": math.pi / 180, "s": 1.0, "ms": 1e-3, "%": 1e-2}
_QUANTITY = {"m": "m", "cm": "m", "mm": "m", "rad": "rad", "deg": "rad", "s": "s", "ms": "s", "%": "1"}
_EXAMPLES = {"m": "2cm", "rad": "5deg", "s": "50ms", "1": "2%"}


def parse_factor(text: str, told: str, example: str, *, most: float, instead: str) -> float:
    """Parse a factor such as "1.5x".

    Args:
        told: start of the error message, with the name of the quantity.
        example: a valid example for the message.
        most: largest allowed factor.
        instead: what to do instead of a larger factor, for the message.

    Raises:
        ConfigError: the text is not a factor above 1, or the factor is too large.
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
    """Parse standard deviations of variables: name -> standard deviation [m, rad, s, 1].

    Args:
        text: "none", or for example "x=10cm,y=0.1,yaw=30deg,size=2%". The default unit of lengths is m, of times s.
            Angles need a unit, because 30 could be degrees and 0.5 radians. Fractions need a percent sign.
        option: name of the option, for messages.
        units: unit of each variable: m, rad, s or 1.

    Raises:
        ConfigError: a name or unit is unknown, a unit does not fit its variable, or a value is not a positive number.
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
