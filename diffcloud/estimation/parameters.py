"""Fitted variables with bounds, mapped to unbounded ones by a sigmoid (paper, section III-C).

    linear (the paper):  w = lo + (hi - lo) σ(s)
    logarithmic:         w = lo (hi / lo)^σ(s)

On the published clouds the better minima often have multipliers of 0.1 to 0.5. A start at the centre of the linear
range rarely reaches them. Additional starts therefore use the logarithmic scale if the lower bound is positive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.quasirandom import SobolEngine

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.estimation.names import of_recording, without_recording
from diffcloud.estimation.priors import INDEPENDENT
from diffcloud.sim.properties import PARAMETERS, check_values

_EDGE = 1e-6


Role = Literal["requested", "material", "initial_state"]
"""Role of a variable. See `estimation.uncertain` for `material` and `estimation.initial_state` for `initial_state`."""


@dataclass(frozen=True)
class Variable:
    """One fitted scalar variable with its bounds and prior."""

    name: str
    low: float
    high: float
    prior: float | None = None
    """Standard deviation of the log-normal prior, as a factor. None: no such prior."""
    centre: float = 1.0
    """Centre of the prior; by default the nominal material."""
    role: Role = "requested"
    """`material` and `initial_state` are nuisance variables: fitted because they are uncertain, but not reported."""
    deviation: float | None = None
    """Standard deviation of a normal prior about zero, for variables that may be negative. None: no such prior."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ConfigError(
                f"Bounds of {self.name!r} must be finite and in order (low < high), got [{self.low}, {self.high}]."
            )

    @property
    def nuisance(self) -> bool:
        """Whether the variable is fitted only because it is uncertain."""
        return self.role != "requested"

    def spread(self, parts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Map fractions [n] in [0, 1] to values [n] by the inverse distribution function. Uncertain material follows
        its prior. Other variables are log-uniform over their range, or uniform if the lower bound is zero."""
        if self.role == "material" and self.prior is not None:
            from scipy.special import ndtri  # slow to import, and needed by few

            return np.clip(self.centre * self.prior ** ndtri(parts), self.low, self.high)
        if self.low > 0:
            return self.low * (self.high / self.low) ** parts
        return self.low + (self.high - self.low) * parts


@dataclass(frozen=True)
class FitSpace:
    """The fitted variables and the fixed parameters."""

    variables: tuple[Variable, ...]
    fixed: Mapping[str, float]

    @staticmethod
    def build(
        names: Sequence[str],
        *,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        fixed: Mapping[str, float] | None = None,
        priors: Mapping[str, float] | None = None,
    ) -> FitSpace:
        """Build a space from parameter names.

        Args:
            names: parameters to fit.
            bounds: overrides of each parameter's own bounds.
            fixed: parameters with a known value, such as the density of a weighed cloth.
            priors: standard deviations as factors (`estimation.priors`); parameters that are not named have no prior.

        Raises:
            ConfigError: a parameter is unknown or repeated, all parameters are fixed, or bounds are out of order.
        """
        fixed, bounds = dict(fixed or {}), dict(bounds or {})
        for name in (*names, *bounds):
            if name not in PARAMETERS:
                raise ConfigError(unknown_name("parameter", name, PARAMETERS))
        check_values(fixed, "The fixed value of")
        for name, pair in bounds.items():
            for value in pair:
                PARAMETERS[name].check(value, f"A bound of {name}, {list(pair)},")
        if len(set(names)) < len(names):
            raise ConfigError(f"A parameter is listed twice: {', '.join(names)}.")
        both = sorted(set(names) & set(fixed))
        known = priors or {}
        variables = [Variable(n, *bounds.get(n, PARAMETERS[n].bounds), known.get(n)) for n in names if n not in both]
        if not variables:
            raise ConfigError("Nothing is left to fit: every listed parameter is fixed.")
        return FitSpace(tuple(variables), fixed)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(variable.name for variable in self.variables)

    @property
    def asked(self) -> FitSpace:
        """The space of the requested variables. Nuisance variables are fixed at the centres of their priors."""
        known = {variable.name: variable.centre for variable in self.variables if variable.nuisance}
        return FitSpace(tuple(v for v in self.variables if not v.nuisance), {**self.fixed, **known})

    def of_recording(self, recording: int) -> tuple[FitSpace, Tensor]:
        """Return the space of one recording of a joint fit (`estimation.names`), and the indices of its k variables."""
        chosen = of_recording(dict(zip(self.names, range(len(self.names)), strict=True)), recording)
        variables = tuple(replace(self.variables[place], name=name) for name, place in chosen.items())
        return FitSpace(variables, of_recording(self.fixed, recording)), torch.tensor([*chosen.values()])

    def without_recording(self, recording: int) -> FitSpace:
        """Return the space of a joint fit without one recording."""
        left = without_recording(dict(zip(self.names, self.variables, strict=True)), recording)
        variables = tuple(replace(variable, name=name) for name, variable in left.items())
        return FitSpace(variables, without_recording(self.fixed, recording))

    def check_start(self, first: Mapping[str, float], nominal: Callable[[str], float] = lambda name: 1.0) -> None:
        """Check the values of the first start.

        Args:
            first: name -> value.
            nominal: function from a parameter to the value of multiplier 1, used in messages.

        Raises:
            ConfigError: a value is outside its bounds, or its variable is not fitted. Names the nearest allowed value.
        """
        bounds = {variable.name: (variable.low, variable.high) for variable in self.asked.variables}
        for name, value in first.items():
            if name not in bounds:
                raise ConfigError(f"--init: {unknown_name('fitted parameter', name, bounds)}")
            low, high = bounds[name]
            if not low <= value <= high:
                low, high, value = (one * nominal(name) for one in (low, high, value))
                nearest = high if value > high else low
                raise ConfigError(
                    f"--init {name}={value:g} is outside of its bounds [{low:g}, {high:g}]; the nearest allowed value is "
                    f"{nearest:g}. Or widen them with --bound."
                )

    def nearest(self, first: Mapping[str, float]) -> dict[str, float]:
        """Return the fitted variables among predicted values, clipped to their bounds."""
        return {v.name: min(max(first[v.name], v.low), v.high) for v in self.variables if v.name in first}

    def values(self, unbounded: Tensor, logarithmic: Tensor) -> Tensor:
        """Map unbounded variables [B, k] to values [B, k]. `logarithmic`, bool [B], chooses the scale of each start."""
        low, high = self._bounds(unbounded)
        fraction = torch.sigmoid(unbounded)
        safe = torch.where(low > 0, low, 1.0)
        ratio = torch.where(low > 0, high / safe, 1.0)
        return torch.where(logarithmic[:, None] & (low > 0), safe * ratio**fraction, low + (high - low) * fraction)

    def unbounded(self, values: Tensor, logarithmic: Tensor) -> Tensor:
        """Return the inverse of `values`. Values on or beyond a bound are moved just inside."""
        low, high = self._bounds(values)
        linear = (values - low) / (high - low)
        safe = torch.where(low > 0, low, 1.0)
        logs = (values.clamp(min=_EDGE) / safe).log() / torch.where(low > 0, high / safe, math.e).log()
        fraction = torch.where(logarithmic[:, None] & (low > 0), logs, linear)
        return torch.logit(fraction.clamp(_EDGE, 1 - _EDGE))

    def starts(self, count: int, *, seed: int, first: Mapping[str, float] | None = None) -> tuple[Tensor, Tensor]:
        """Return initial values [count, k] and whether each start uses the logarithmic scale, bool [count].

        The first start is `first` where given. Otherwise it is the centre of the linear range, or of the prior for
        nuisance variables. The other starts come from a scrambled Sobol sequence: log-uniform over the box, or by the
        prior for uncertain material. Initial-state variables are the same in all starts.
        """
        values = np.empty((count, len(self.variables)))
        for column, variable in zip(values.T, self.variables, strict=True):
            middle = variable.centre if variable.nuisance else 0.5 * (variable.low + variable.high)
            column[:] = (first or {}).get(variable.name, middle)
        spread = [index for index, variable in enumerate(self.variables) if variable.deviation is None]
        if count > 1 and spread:
            sobol = SobolEngine(len(spread), scramble=True, seed=seed).draw(count - 1, dtype=torch.float64).numpy()
            for index, part in zip(spread, sobol.T, strict=True):
                values[1:, index] = self.variables[index].spread(part)
        return torch.as_tensor(values), torch.arange(count) > 0

    def parameters(self, values: Tensor) -> dict[str, Tensor]:
        """Map values [B, k] to parameters of the simulator, including the fixed ones: name -> [B]."""
        columns = dict(zip(self.names, values.unbind(-1), strict=True))
        return columns | {name: torch.full_like(values[:, 0], value) for name, value in self.fixed.items()}

    def prior_weights(self, recordings: int) -> Tensor:
        """Return weights [k] of the squared `off_centre` values in the logarithm of the loss (`estimation.priors`).

        Args:
            recordings: number of recordings over which the loss is averaged. Priors weigh less if there are more.
        """
        count = INDEPENDENT * recordings
        steps = self.prior_steps()
        return torch.where(steps > 0, 1 / (count * steps.square()), 0.0)

    def prior_steps(self) -> Tensor:
        """Return the standard deviation of each prior [k] in the units of `off_centre`; zero without a prior."""
        logs = [0.0 if v.prior is None else math.log(v.prior) for v in self.variables]
        steps = [log if v.deviation is None else 1.0 for log, v in zip(logs, self.variables, strict=True)]
        return torch.tensor(steps, dtype=torch.float64)

    def prior_factor(self, values: Tensor, recordings: int) -> Tensor:
        """Return factors [B] by which the priors multiply the loss of values [B, k]."""
        return (self.prior_weights(recordings) * self.off_centre(values).square()).sum(-1).exp()

    def off_centre(self, values: Tensor) -> Tensor:
        """Return the deviations [..., k] of values from the centres of their priors. For log-normal priors this is the
        logarithm of the ratio, for normal priors the number of standard deviations. Variables without a prior give
        zero."""
        normal = torch.tensor([variable.deviation is not None for variable in self.variables])
        scales = values.new_tensor([v.centre if v.deviation is None else v.deviation for v in self.variables])
        known = torch.tensor([variable.prior is not None for variable in self.variables])
        return torch.where(normal, values / scales, torch.where(known, values / scales, 1.0).log())

    def _bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        low = [variable.low for variable in self.variables]
        high = [variable.high for variable in self.variables]
        return like.new_tensor(low), like.new_tensor(high)
