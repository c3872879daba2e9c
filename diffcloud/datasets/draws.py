"""Parameters of simulated runs: uniform, uniform in the logarithms, by a Sobol sequence, or as published.

The published code picks a mode for each run (soft, medium, stiff, random) and then stretching and density uniformly in
the mode's ranges. Draws outside of the bounds are rejected.
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
"""Draws from the modes of which the first inside the bounds counts; more than half of the published ones are."""

Range = tuple[float, float]
Mode = tuple[tuple[Range, ...], tuple[Range, ...]]
"""Ranges of stretching and of density; of two, each is as likely."""

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
"""Scenario -> soft, medium, stiff, random."""


@dataclass(frozen=True)
class ParameterBox:
    """Named parameters and their bounds."""

    names: tuple[str, ...]
    bounds: NDArray[np.float64]
    """[k, 2]"""

    @staticmethod
    def build(names: Sequence[str], bounds: Mapping[str, Range] | None = None) -> ParameterBox:
        """
        Args:
            bounds: a scenario's overrides of the parameters' own bounds.

        Raises:
            ConfigError: no parameter, an unknown one, or one listed twice.
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
        """[count, k]; a longer draw begins with a shorter one."""
        low, high = self.bounds.T
        return rng.uniform(low, high, (count, len(self.names)))

    def sobol(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """[count, k] of a scrambled Sobol sequence."""
        from scipy.stats import qmc  # takes as long to import as all of scipy else

        low, high = self.bounds.T
        points = qmc.Sobol(len(self.names), rng=rng).random_base2(math.ceil(math.log2(max(count, 1))))[:count]
        return np.asarray(low + (high - low) * points)

    def logarithmic(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """[count, k] uniform in the logarithms: as many from 0.1 to 0.2 as from 5 to 10, which suits regressors that are
        measured by relative errors. A parameter whose bounds begin at zero is drawn uniformly, as fits do with their
        starts. A longer draw begins with a shorter one.
        """
        low, high = self.bounds.T
        fraction = rng.random((count, len(self.names)))
        safe = np.where(low > 0, low, 1.0)
        drawn = np.where(low > 0, safe * (high / safe) ** fraction, low + (high - low) * fraction)
        return np.clip(drawn, low, high)  # which rounding may have left

    def mixture(self, modes: Sequence[Mode], rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """[count, 2] of the modes, inside the bounds; a longer draw begins with a shorter one.

        Raises:
            ConfigError: the modes hardly reach into the bounds.
        """
        ranges = np.array([[(of[0], of[-1]) for of in mode] for mode in modes])  # [M, 2, 2, low and high]
        drawn = rng.random((count, _TRIES, 5))  # a mode, a range of each parameter, a place in each range
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
    """Which parameters the runs of a set get.

    Raises:
        ConfigError: modes for what the published code has none for; uncertain material that is drawn.
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
        """[count, k] parameters of a split's runs."""
        return self._draw(np.random.default_rng([self.seed, SPLITS.index(split)]), count, self.kind)

    def again(self, split: Split, run: int, attempt: int) -> NDArray[np.float64]:
        """[k] instead of those that diverged at attempts 0 to attempt - 1. A replaced Sobol point is drawn uniformly."""
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
