"""How much a prior says, of the pose and of the parameters, beside a recording; and the priors of parameters.

A multiplier has a log-normal prior about the nominal material: one deviation off is a factor. Nobody knows beforehand how
noisy a recording is, or how well the simulator can explain it. With N independent residuals of one unknown variance, the
posterior is highest where N log L + Σ d² is lowest; L is the loss, and d how far each variable is from its centre, in
standard deviations of its prior. So priors multiply the loss by exp(Σ d² / N): at one deviation by one hundredth more, far
less than a recording says of what it shows. They decide where nothing is shown, and hold where the simulator explains
little.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.quantities import parse_factor
from diffcloud.sim.properties import PARAMETERS

DEFAULT_FACTOR = 10.0
"""One deviation of a multiplier."""
_MOST_FACTOR = 1e6
"""A prior as wide says nothing."""
INDEPENDENT = 100
"""Residuals of a recording that count as independent."""


def parameter_priors(text: str | None, names: Sequence[str], bounds: Mapping[str, tuple[float, float]]) -> dict[str, float]:
    """What `--prior` says -> fitted parameter -> factor of one deviation.

    Args:
        text: None for the default of every fitted multiplier whose bounds hold the nominal value, 1; "none"; or parameters
            with a factor, as in "bending=3x,density=1.5x", the default for the others.
        names: fitted parameters.
        bounds: of each.

    Raises:
        ConfigError: a parameter that is not fitted or has no multiplier, a factor that is none, or bounds without the
            nominal value.
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
