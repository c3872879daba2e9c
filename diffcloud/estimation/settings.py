"""Settings of a fit: one field for each, from which options, params.yaml, records and the page of settings are made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from diffcloud.estimation.doubts import MATERIAL_DOUBTS, parse_doubts
from diffcloud.estimation.laid import parse_laid
from diffcloud.estimation.pose import parse_priors
from diffcloud.estimation.solvers import SOLVERS, Settings
from diffcloud.io.schema import Component, NonNegative, Positive
from diffcloud.scene.scenarios import Scenario
from diffcloud.settings import MOST_STARTS, Bounds, Count, Name, Names, Section, Seed, check_bounds

SMOOTHING = 0.5
"""Default of adam's."""
_OF_SOLVERS = ("iterations", "starts", "learning_rate", "smoothing", "resample", "simulations")
"""Options that not every solver has: one does if its settings have a field of that name."""


class FitSettings(Section):
    """Of a fit."""

    parameters: Names = ["stretch", "mass"]
    bounds: dict[str, Bounds] = {}
    fixed: dict[str, Component] = {}
    solver: Literal["likelihood", "adam", "cma_es", "random_search"] = "likelihood"
    """`likelihood` gives each frame a variance, and knows what the model cannot predict; `adam` is the paper's; `cma_es`
    and `random_search` need no derivatives. Only the first gives intervals."""
    iterations: Count | None = None
    """Of likelihood and adam: steps of a start at most; by default 12 and 50."""
    starts: Annotated[int, Field(ge=1, le=MOST_STARTS)] | None = None
    """Of likelihood and adam: number of descents, from different places; by default 3 and 1."""
    learning_rate: Positive | None = None
    """Of adam; the scenario's own if not given."""
    smoothing: NonNegative | None = None
    """Of adam: standard deviation, on the sigmoid's axis, of the first start's perturbed copies, whose gradients are
    averaged; 0: the plain gradient, as the paper has it; by default 0.5."""
    resample: bool | None = None
    """Of adam: new points in each iteration; by default the same ones."""
    simulations: Count | None = None
    """Of cma_es and random_search: as many at most; by default 200."""
    threshold: NonNegative | None = None
    points: Count | None = None
    frames: Annotated[list[Annotated[int, Field(ge=-100_000, le=100_000)]], Field(min_length=1)] | None = None
    seed: Seed = 0
    paper: bool = False
    """The published measure: one-sided, squared, at the scenario's loss frames, without a pose, down to its threshold."""
    nuisance: Name | None = None
    """Which parts of the pose are fitted too, and how far off each may well be: "x=0.1m,y=0.1m,yaw=30deg", or "none". If
    not given, all of them, as `estimation.pose.default_priors` says."""
    laid: Name | None = None
    """How the cloth may lie other than as its scenario has it, and how far off: "turn=5deg,shape=5mm,size=2%", or "none"
    (`estimation.laid`). Default: what the scenario says, of likelihood with the implicit integrator; else none."""
    prior: Name | None = None
    """Within which factor of the basis each multiplier probably lies: "bending=3x", others 10x; or "none"."""
    doubts: Name | None = None
    """The factor within which material that is not asked for is known: "bending=1.5x,drag=1.3x", or "none". It is fitted
    too, and is not a result (`estimation.doubts`). Default: `MATERIAL_DOUBTS` and what the scenario says, of likelihood
    with the implicit integrator; else none."""
    model_error: bool = True
    """Of likelihood: whether cloth and simulator may differ. False for recordings that this simulator made on this mesh."""
    joint: bool = False
    """One parameter set for all episodes, whatever their scenario: they must be of one cloth."""

    @model_validator(mode="before")
    @classmethod
    def _is_of_now(cls, data: Any) -> Any:
        if isinstance(data, dict) and "optimizer" in data:
            raise ValueError(f"optimizer: now `solver`, one of {', '.join(SOLVERS)}")
        if isinstance(data, dict) and "offset" in data:
            raise ValueError("offset: now `nuisance`, such as x=0.1m,y=0.1m,yaw=30deg, or none")
        return data

    @field_validator("bounds", "fixed", mode="before")
    @classmethod
    def _given(cls, values: Any) -> Any:
        """null stands for a parameter that has none of its own."""
        return {name: value for name, value in values.items() if value is not None} if isinstance(values, dict) else values

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name, pair in self.bounds.items():
            check_bounds(f"bounds.{name}", pair)
        parse_priors(self.nuisance or "none")
        if parse_laid(self.laid or "none") and self.paper:
            raise ValueError("laid: the published measure takes the cloth to lie as the scene has it; leave it out")
        if self.paper and parse_doubts(self.doubts or "none"):
            raise ValueError("doubts: the published measure takes the rest of the material for known; leave them out")
        if self.paper and self.solver == "likelihood":
            raise ValueError("paper: the published measure has no likelihood; choose another solver, such as adam")
        if foreign := [name for name in self._solver_options() if self.solver not in _solvers_with(name)]:
            told = "; ".join(f"{name}: of solver {' or '.join(_solvers_with(name))}" for name in foreign)
            raise ValueError(f"{told}; not of {self.solver}: leave out, or choose that solver")
        return self

    def measure(self) -> dict[str, Any]:
        """Keyword arguments of `Objective`."""
        priors = None if self.nuisance is None else parse_priors(self.nuisance)
        return {"paper": self.paper, "nuisance": priors, "frames": self.frames, "points": self.points, "seed": self.seed}

    def known_within(self, scenarios: Sequence[Scenario]) -> dict[str, float]:
        """Material that is not known exactly in a fit of recordings in these scenarios -> factor of one deviation."""
        if self.doubts is not None:
            return parse_doubts(self.doubts)
        if not self._fits_more(scenarios):
            return {}
        own: dict[str, float] = {}
        for one in scenarios:
            own |= {name: max(factor, own.get(name, 1.0)) for name, factor in one.doubts.items()}
        return {
            name: factor
            for name, factor in {**MATERIAL_DOUBTS, **own}.items()
            if name not in {*self.parameters, *self.fixed}
        }

    def laid_within(self, scenarios: Sequence[Scenario]) -> list[dict[str, float]]:
        """How the cloth may lie otherwise at the start of each recording, in one fit of recordings in these scenarios: name
        of `estimation.laid` -> standard deviation [rad, m, 1]."""
        if self.laid is not None:
            return [parse_laid(self.laid)] * len(scenarios)
        return [dict(one.laid) if self._fits_more(scenarios) else {} for one in scenarios]

    def _fits_more(self, scenarios: Sequence[Scenario]) -> bool:
        """Whether more than what is asked for is fitted by default: where derivatives make that cheap."""
        implicit = all(one.scene.integrator == "implicit" for one in scenarios)
        return not self.paper and self.solver == "likelihood" and implicit

    def solver_settings(self, scenario: Scenario) -> Settings:
        """Of the solver, with what the scenario says where nothing is given."""
        given: dict[str, Any] = {}
        if self.solver == "adam":
            given |= {"learning_rate": scenario.learning_rate, "smoothing": SMOOTHING}
        own = scenario.threshold if self.paper else 0.0
        given["seed"] = self.seed
        if self.solver == "likelihood":
            given["model_error"] = self.model_error
        else:
            given["threshold"] = own if self.threshold is None else self.threshold
        return SOLVERS[self.solver](**given | self._solver_options())

    def _solver_options(self) -> dict[str, Any]:
        """Those that were given."""
        return {name: value for name in _OF_SOLVERS if (value := getattr(self, name)) is not None}


def _solvers_with(option: str) -> list[str]:
    return [name for name, kind in SOLVERS.items() if option in {field.name for field in fields(kind)}]
