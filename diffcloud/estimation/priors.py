"""Weight of the priors relative to the data, and the priors of parameters.

A multiplier has a log-normal prior about the nominal material, so one standard deviation is a factor. The noise and
model error of a recording are not known beforehand. With N independent residuals of one unknown variance, the posterior
is maximal where N log L + Σ d² is minimal. Here L is the loss, and d is the distance of each variable from the centre
of its prior, in standard deviations.

So priors multiply the loss by exp(Σ d² / N). One standard deviation raises the loss by only one percent. Priors
therefore matter only where the data are uninformative.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.quantities import parse_factor
from diffcloud.sim.properties import PARAMETERS

DEFAULT_FACTOR = 10.0
"""Default standard deviation of a multiplier, as a factor."""
_MOST_FACTOR = 1e6
"""Largest allowed factor; a wider prior has no effect."""
INDEPENDENT = 100
"""Assumed number N of independent residuals in a recording."""


def parameter_priors(text: str | None, names: Sequence[str], bounds: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """Parse the text of `--prior` to fitted parameter -> standard deviation as a factor.

    Args:
        text: "none", or parameters with factors such as "bending=3x,density=1.5x". Parameters that are not named, or
            all if None, get the default if their bounds contain the nominal value 1.
        names: fitted parameters.

    Raises:
        ConfigError: a parameter is not fitted or has no multiplier, a factor is invalid, or bounds exclude the nominal
            value.
    """
    if text is not None and text.strip() == "none":
        return {}
    inside = {name: bounds[name][0] <= 1.0 <= bounds[name][1] for name in names}
    found = {name: DEFAULT_FACTOR for name in names if PARAMETERS[name].quantity is not None and inside[name]}
    for item in () if text is None else text.split(","):
        name, _, value = (part.strip() for part in item.partition("="))
        if name not in names:
            raise ConfigError(f"prior: {unknown_name('fitted parameter', name, names)}")
        if PARAMETERS[name].quantity is None:
            raise ConfigError(f"prior: {name} is no multiplier; what is known of it are its bounds, {list(bounds[name])}.")
        told = f"prior {item.strip()!r}: {name} takes the factor within which it probably lies"
        factor = parse_factor(value, told, f"{name}=3x", most=_MOST_FACTOR, instead="where nothing is known, write none")
        if not inside[name]:
            raise ConfigError(
                f"prior {item.strip()!r}: it is about 1, the nominal material, and the bounds of {name} are "
                f"{list(bounds[name])}. Widen them with --bound, or change the scenario's material."
            )
        found[name] = factor
    return found
