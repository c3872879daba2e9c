"""What is fitted: bounded variables behind a sigmoid (paper, section III-C).

    linear (the paper):  w = lo + (hi - lo) σ(s)
    logarithmic:         w = lo (hi / lo)^σ(s)

On the published clouds the better minima often lie at multipliers of 0.1 to 0.5, which a start at the middle of the linear
scale hardly reaches; extra starts therefore use the logarithmic scale where the lower bound is positive.
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
"""Of a variable; the last two are of `estimation.uncertain` and `estimation.initial_state`."""


@dataclass(frozen=True)
class Variable:
    """One fitted number."""

    name: str
    low: float
    high: float
    prior: float | None = None
    """Factor of one deviation of its log-normal prior; None: none."""
    centre: float = 1.0
    """Of the prior; by default the nominal material."""
    role: Role = "requested"
    """`material` and `initial_state` are nuisance variables: fitted because they are not known exactly, and no results."""
    deviation: float | None = None
    """One standard deviation of a normal prior about zero, instead of the log-normal one, of what may be negative."""

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
        """[n] values that parts [n] of 1, evenly spread, stand for: as the prior of uncertain material has them, of another
        variable log-uniform over its range, or uniform where that begins at zero."""
        if self.role == "material" and self.prior is not None:
            from scipy.special import ndtri  # slow to import, and needed by few

            return np.clip(self.centre * self.prior ** ndtri(parts), self.low, self.high)
        if self.low > 0:
            return self.low * (self.high / self.low) ** parts
        return self.low + (self.high - self.low) * parts


@dataclass(frozen=True)
class FitSpace:
    """The fitted variables, and parameters known beforehand."""

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
        """
        Args:
            names: parameters to fit.
            bounds: overrides of each parameter's own bounds.
            fixed: parameters with a known value (a weighed cloth: mass).
            priors: factors of one deviation (`estimation.priors`); none where not given.

        Raises:
            ConfigError: an unknown, repeated or doubly given parameter, or bounds out of order.
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
        """The requested variables; nuisance variables are at the centres of their priors."""
        known = {variable.name: variable.centre for variable in self.variables if variable.nuisance}
        return FitSpace(tuple(v for v in self.variables if not v.nuisance), {**self.fixed, **known})

    def of_recording(self, recording: int) -> tuple[FitSpace, Tensor]:
        """Of one recording of a joint fit (`estimation.names`), and where its k variables are among all."""
        chosen = of_recording(dict(zip(self.names, range(len(self.names)), strict=True)), recording)
        variables = tuple(replace(self.variables[place], name=name) for name, place in chosen.items())
        return FitSpace(variables, of_recording(self.fixed, recording)), torch.tensor([*chosen.values()])

    def without_recording(self, recording: int) -> FitSpace:
        """Of the others of a joint fit."""
        left = without_recording(dict(zip(self.names, self.variables, strict=True)), recording)
        variables = tuple(replace(variable, name=name) for name, variable in left.items())
        return FitSpace(variables, without_recording(self.fixed, recording))

    def check_start(self, first: Mapping[str, float], nominal: Callable[[str], float] = lambda name: 1.0) -> None:
        """
        Args:
            first: values of a first start.
            nominal: parameter -> value that a multiplier of 1 stands for, for messages.

        Raises:
            ConfigError: one of what is not fitted, or outside of its bounds; names the nearest that is allowed.
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
        """Of values that a prediction gave, those that are fitted, within their bounds."""
        return {v.name: min(max(first[v.name], v.low), v.high) for v in self.variables if v.name in first}

    def values(self, unbounded: Tensor, logarithmic: Tensor) -> Tensor:
        """[B, k] unbounded variables -> [B, k] values; `logarithmic` bool [B] picks the scale of each start."""
        low, high = self._bounds(unbounded)
        fraction = torch.sigmoid(unbounded)
        safe = torch.where(low > 0, low, 1.0)
        ratio = torch.where(low > 0, high / safe, 1.0)
        return torch.where(logarithmic[:, None] & (low > 0), safe * ratio**fraction, low + (high - low) * fraction)

    def unbounded(self, values: Tensor, logarithmic: Tensor) -> Tensor:
        """The inverse of `values`; values on or beyond a bound are brought just inside."""
        low, high = self._bounds(values)
        linear = (values - low) / (high - low)
        safe = torch.where(low > 0, low, 1.0)
        logs = (values.clamp(min=_EDGE) / safe).log() / torch.where(low > 0, high / safe, math.e).log()
        fraction = torch.where(logarithmic[:, None] & (low > 0), logs, linear)
        return torch.logit(fraction.clamp(_EDGE, 1 - _EDGE))

    def starts(self, count: int, *, seed: int, first: Mapping[str, float] | None = None) -> tuple[Tensor, Tensor]:
        """Initial values [count, k] and which scale each start uses, bool [count].

        The first start is the middle of the range on the paper's linear scale, for nuisance variables the centre of the
        prior, or `first` where given. The others are spread by a scrambled Sobol sequence: over the box log-uniformly,
        uncertain material as its prior says. How a cloth lies begins as in the first one.
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
        """[B, k] -> parameters of the simulator, the fixed ones too, name -> [B]."""
        columns = dict(zip(self.names, values.unbind(-1), strict=True))
        return columns | {name: torch.full_like(values[:, 0], value) for name, value in self.fixed.items()}

    def prior_weights(self, recordings: int) -> Tensor:
        """[k] what the logarithm of the loss gains by the square of each variable's `off_centre` (`estimation.priors`).

        Args:
            recordings: over which the loss is a mean; they say the more, the more there are.
        """
        count = INDEPENDENT * recordings
        steps = self.prior_steps()
        return torch.where(steps > 0, 1 / (count * steps.square()), 0.0)

    def prior_steps(self) -> Tensor:
        """[k] one standard deviation of each prior, as `off_centre` measures; zero where there is none."""
        logs = [0.0 if v.prior is None else math.log(v.prior) for v in self.variables]
        steps = [log if v.deviation is None else 1.0 for log, v in zip(logs, self.variables, strict=True)]
        return torch.tensor(steps, dtype=torch.float64)

    def prior_factor(self, values: Tensor, recordings: int) -> Tensor:
        """[B] by which the priors multiply the loss of values [B, k]."""
        return (self.prior_weights(recordings) * self.off_centre(values).square()).sum(-1).exp()

    def off_centre(self, values: Tensor) -> Tensor:
        """[..., k] logarithms of values over the centres of their priors, of normal ones the values in deviations; zero for
        those without one."""
        normal = torch.tensor([variable.deviation is not None for variable in self.variables])
        scales = values.new_tensor([v.centre if v.deviation is None else v.deviation for v in self.variables])
        known = torch.tensor([variable.prior is not None for variable in self.variables])
        return torch.where(normal, values / scales, torch.where(known, values / scales, 1.0).log())

    def _bounds(self, like: Tensor) -> tuple[Tensor, Tensor]:
        low = [variable.low for variable in self.variables]
        high = [variable.high for variable in self.variables]
        return like.new_tensor(low), like.new_tensor(high)
