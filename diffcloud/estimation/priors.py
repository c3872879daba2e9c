"""How much a prior says, of the pose and of the parameters, beside a recording; and the priors of parameters.

A multiplier has a log-normal prior about the basis material: one deviation off is a factor. Nobody knows beforehand how
noisy a recording is, or how well the simulator can explain it. With N independent residuals of one unknown variance, the
posterior is highest where N log L + Σ d² is lowest; L is the loss, and d how far each variable is from its centre, in
standard deviations of its prior. So priors multiply the loss by exp(Σ d² / N): at one deviation by one hundredth more, far
less than a recording says of what it shows. They decide where nothing is shown, and hold where the simulator explains
little.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.sim.properties import PARAMETERS

DEFAULT_FACTOR = 10.0
"""One deviation of a multiplier."""
_MOST_FACTOR = 1e6
"""A prior as wide says nothing."""
INDEPENDENT = 100
"""Residuals of a recording that count as independent."""
_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "rad": 1.0, "deg": math.pi / 180, "s": 1.0, "ms": 1e-3, "%": 1e-2}
_QUANTITY = {"m": "m", "cm": "m", "mm": "m", "rad": "rad", "deg": "rad", "s": "s", "ms": "s", "%": "1"}
_EXAMPLES = {"m": "2cm", "rad": "5deg", "s": "50ms", "1": "2%"}


def parameter_priors(text: str | None, names: Sequence[str], bounds: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """What `--prior` says -> fitted parameter -> factor of one deviation.

    Args:
        text: None for the default of every fitted multiplier whose bounds hold the basis, 1; "none"; or parameters with a
            factor, as in "bending=3x,mass=1.5x", the default for the others.
        names: fitted parameters.
        bounds: of each.

    Raises:
        ConfigError: one that is not fitted or is no multiplier, a factor that is none, or bounds that leave the basis out.
    """
    if text is not None and text.strip() == "none":
        return {}
    inside = {name: bounds[name][0] <= 1.0 <= bounds[name][1] for name in names}
    found = {name: DEFAULT_FACTOR for name in names if PARAMETERS[name].basis is not None and inside[name]}
    for item in () if text is None else text.split(","):
        name, _, value = (part.strip() for part in item.partition("="))
        if name not in names:
            raise ConfigError(f"prior: {unknown_name('fitted parameter', name, names)}")
        if PARAMETERS[name].basis is None:
            raise ConfigError(f"prior: {name} is no multiplier; what is known of it are its bounds, {list(bounds[name])}.")
        told = f"prior {item.strip()!r}: {name} takes the factor within which it probably lies"
        factor = parse_factor(value, told, f"{name}=3x", most=_MOST_FACTOR, instead="where nothing is known, write none")
        if not inside[name]:
            raise ConfigError(
                f"prior {item.strip()!r}: it is about 1, the basis material, and the bounds of {name} are "
                f"{list(bounds[name])}. Widen them with --bound, or change the scenario's material."
            )
        found[name] = factor
    return found


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
