"""Sample parameters of simulated runs: uniform, log-uniform, Sobol sequence, or the published mixture.

For each run, the published code selects a mode (soft, medium, stiff, random), and then samples stretching and density
uniformly in the ranges of this mode. Samples out of bounds are rejected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.io.simulated import SPLITS, Split
from diffcloud.sim.properties import PARAMETERS

Draws = Literal["uniform", "sobol", "logarithmic", "modes"]

_MIXED = ("stretching", "density")
_TRIES = 64
"""Number of candidate samples per run. The first one inside the bounds is used; more than half are inside."""

Range = tuple[float, float]
Mode = tuple[tuple[Range, ...], tuple[Range, ...]]
"""Ranges of stretching and of density. If there are two ranges, both are equally likely."""

_SOFT, _MEDIUM, _STIFF = (0.1, 1.0), (1.0, 10.0), (1.0, 10.0)
_STANDARD: tuple[Mode, ...] = (
    ((_SOFT,), ((5.0, 10.0),)),
    ((_MEDIUM,), ((1.0, 5.0),)),
    ((_STIFF,), ((0.1, 1.0),)),
    ((_STIFF,), ((0.1, 1.0),)),
)
_FOLD: tuple[Mode, ...] = (
    (((0.05, 1.0),), ((5.0, 10.0),)),
    ((_MEDIUM,), ((1.0, 5.0),)),
    ((_STIFF,), ((0.1, 1.0),)),
    (((0.05, 1.0), (0.5, 10.0)), ((0.1, 1.0), (1.0, 10.0))),
)
_LIFT: tuple[Mode, ...] = (
    ((_SOFT,), ((0.1, 1.9),)),
    (((0.75, 1.25),), ((1.0, 20.0),)),
    (((1.0, 20.0),), ((0.1, 1.0),)),
    (((0.5, 1.0), (0.5, 10.0)), ((0.1, 1.0), (1.0, 20.0))),
)
MODES: dict[str, tuple[Mode, ...]] = {
    "lift": _LIFT,
    "release_lift": _LIFT,
    "fold": _FOLD,
    "release_fold": _FOLD,
    "band_stretch": _STANDARD,
    "release_band": _STANDARD,
    "vest_hang": _STANDARD,
    "release_hang": _STANDARD,
}
"""Scenario -> modes: soft, medium, stiff, random."""


@dataclass(frozen=True)
class ParameterBox:
    """Names of parameters and their bounds."""

    names: tuple[str, ...]
    bounds: NDArray[np.float64]
    """[k, 2] lower and upper bound of each parameter."""

    @staticmethod
    def build(names: Sequence[str], bounds: Mapping[str, Range] | None = None) -> ParameterBox:
        """Build the box from parameter names.

        Args:
            bounds: bounds of the scenario, which replace the default bounds of parameters.

        Raises:
            ConfigError: there is no parameter, or one is unknown or listed twice.
        """
        for name in names:
            if name not in PARAMETERS:
                raise ConfigError(unknown_name("parameter", name, PARAMETERS))
        if not names or len(set(names)) < len(names):
            raise ConfigError(
                f"Parameters to draw must be at least one, none listed twice, got {', '.join(names) or 'none'}."
            )
        own = {name: PARAMETERS[name].bounds for name in names}
        return ParameterBox(tuple(names), np.array([{**own, **(bounds or {})}[name] for name in names]))

    def uniform(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Sample [count, k] uniformly. A larger count gives the same first rows."""
        low, high = self.bounds.T
        return rng.uniform(low, high, (count, len(self.names)))

    def sobol(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Return [count, k] points of a scrambled Sobol sequence."""
        from scipy.stats import qmc  # slow to import

        low, high = self.bounds.T
        points = qmc.Sobol(len(self.names), rng=rng).random_base2(math.ceil(math.log2(max(count, 1))))[:count]
        return np.asarray(low + (high - low) * points)

    def logarithmic(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Sample [count, k] uniformly in the logarithms. A larger count gives the same first rows.

        There are then as many samples from 0.1 to 0.2 as from 5 to 10, as needed for regressors with relative errors.
        Parameters whose lower bound is zero are sampled uniformly, as for starts of fits.
        """
        low, high = self.bounds.T
        fraction = rng.random((count, len(self.names)))
        safe = np.where(low > 0, low, 1.0)
        drawn = np.where(low > 0, safe * (high / safe) ** fraction, low + (high - low) * fraction)
        return np.clip(drawn, low, high)  # rounding may have exceeded the bounds

    def mixture(self, modes: Sequence[Mode], rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Sample [count, 2] from a mixture of modes, within the bounds. A larger count gives the same first rows.

        Raises:
            ConfigError: the modes hardly overlap with the bounds.
        """
        ranges = np.array([[(of[0], of[-1]) for of in mode] for mode in modes])  # [M, 2, 2, low and high]
        drawn = rng.random((count, _TRIES, 5))  # for the mode, the range of each parameter, and the value in each range
        mode = (drawn[..., 0] * len(modes)).astype(int)
        which = (drawn[..., 1:3] * ranges.shape[2]).astype(int)
        low, high = np.moveaxis(ranges[mode[..., None], np.arange(2), which], -1, 0)  # each [count, tries, 2]
        values = (low + (high - low) * drawn[..., 3:])[..., [_MIXED.index(name) for name in self.names]]
        inside = ((values >= self.bounds[:, 0]) & (values <= self.bounds[:, 1])).all(-1)
        if not inside.any(axis=1).all():
            raise ConfigError(f"The published modes hardly reach into the bounds {self.bounds.tolist()}; draw uniformly.")
        return np.asarray(values[np.arange(count), inside.argmax(axis=1)])


@dataclass(frozen=True)
class ParameterDraws:
    """Sampling of the parameters of a set's runs.

    Raises:
        ConfigError: there are no published modes for the scenario or parameters, or a nuisance parameter is also sampled.
    """

    box: ParameterBox
    kind: Draws
    scenario: str
    seed: int
    uncertain: Mapping[str, float] = field(default_factory=dict)
    """Nuisance material parameters that vary between runs -> factor of one standard deviation (`estimation.uncertain`)."""

    def __post_init__(self) -> None:
        if self.kind == "modes" and self.scenario not in MODES:
            raise ConfigError(
                f"The published modes are for {', '.join(MODES)}, not for {self.scenario!r}; "
                "use --distribution uniform, sobol or logarithmic."
            )
        if self.kind == "modes" and set(self.box.names) != set(_MIXED):
            raise ConfigError(f"The published modes draw {' and '.join(_MIXED)}, not {', '.join(self.box.names)}.")
        if twice := [name for name in self.uncertain if name in self.box.names]:
            raise ConfigError(
                f"`uncertain` takes other material than the sampled parameters; leave out {', '.join(twice)}."
            )

    def first(self, split: Split, count: int) -> NDArray[np.float64]:
        """Return initial parameters [count, k] of a split's runs."""
        return self._draw(np.random.default_rng([self.seed, SPLITS.index(split)]), count, self.kind)

    def again(self, split: Split, run: int, attempt: int) -> NDArray[np.float64]:
        """Return new parameters [k] for a run that diverged `attempt` times. Sobol points become uniform samples."""
        kind: Draws = "uniform" if self.kind == "sobol" else self.kind
        return self._draw(np.random.default_rng([self.seed, SPLITS.index(split), run, attempt]), 1, kind)[0]

    def uncertain_factors(self, split: Split, run: int, attempt: int) -> dict[str, float]:
        """Sample factors of a run's nuisance material parameters, log-normal with median 1: name -> factor."""
        rng = np.random.default_rng([self.seed, SPLITS.index(split), run, attempt, 1])
        return {name: rng.lognormal(0.0, math.log(factor)) for name, factor in self.uncertain.items()}

    def _draw(self, rng: np.random.Generator, count: int, kind: Draws) -> NDArray[np.float64]:
        match kind:
            case "uniform":
                return self.box.uniform(rng, count)
            case "sobol":
                return self.box.sobol(rng, count)
            case "logarithmic":
                return self.box.logarithmic(rng, count)
            case "modes":
                return self.box.mixture(MODES[self.scenario], rng, count)
