"""Settings of a fit. Command options, params.yaml, records and the page of settings are made from these fields. Nothing
here imports torch, so that `--help` is fast."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_args

from pydantic import Field, field_validator, model_validator

from diffcloud.io.schema import Component, NonNegative, Positive
from diffcloud.settings import MOST_STARTS, Bounds, Count, Factor, Level, Name, Names, Section, Seed, check_bounds

if TYPE_CHECKING:
    from diffcloud.estimation.solvers import Settings
    from diffcloud.scene.scenarios import Scenario

LEVEL = 0.9
"""Default probability of the intervals."""
IDENTIFIED_FACTOR = 2.0
SMOOTHING = 0.5
"""Default `smoothing` of adam."""
_Starts = Annotated[int, Field(ge=1, le=MOST_STARTS)] | None


class LikelihoodSolver(Section):
    """Most likely parameters with intervals. Each frame has its own variance, a horizon limits the frames, and a
    refined mesh corrects the motion."""

    name: Literal["likelihood"] = "likelihood"
    max_steps: Count | None = None
    """Maximum number of steps of a start. Default: 12."""
    starts: _Starts = None
    """Number of descents, each from another start. Default: 3."""
    model_error: bool = True
    """Whether cloth and simulator may differ. False for recordings that this simulator made on this mesh."""


class AdamSolver(Section):
    """The paper's solver: gradient descent on the loss. It gives no intervals."""

    name: Literal["adam"] = "adam"
    max_steps: Count | None = None
    """Maximum number of steps. Default: 50."""
    starts: _Starts = None
    """Number of descents, each from another start. Default: 1."""
    learning_rate: Positive | None = None
    """Learning rate of Adam. Default: the scenario's."""
    smoothing: NonNegative | None = None
    """Standard deviation, before the sigmoid, of perturbed copies of the first start, whose gradients are averaged.
    Default: 0.5; 0: the plain gradient, as in the paper."""
    resample: bool | None = None
    """Sample new points in each step, as in the published scripts. Default: the same points."""
    threshold: NonNegative | None = None
    """Loss below which the descent stops. Default: never; with `loss: paper`, the scenario's."""


class SearchSolver(Section):
    """A search without derivatives: CMA-ES, or uniform random samples. It gives no intervals."""

    name: Literal["cma_es", "random_search"] = "cma_es"
    max_simulations: Count | None = None
    """Maximum number of simulations. Default: 200."""
    threshold: NonNegative | None = None
    """Loss below which the search stops. Default: never; with `loss: paper`, the scenario's."""


_Block = LikelihoodSolver | AdamSolver | SearchSolver
Solver = Annotated[_Block, Field(discriminator="name")]
SOLVER_KINDS: dict[str, type[Section]] = {
    name: kind for kind in get_args(_Block) for name in get_args(kind.model_fields["name"].annotation)
}
"""Solver name -> settings class."""


class FitSettings(Section):
    """Settings of a fit."""

    parameters: Names = ["stretching", "density"]
    """Parameters to estimate, such as stretching,bending,density."""
    bounds: dict[str, Bounds] = Field(default={}, json_schema_extra={"flag": "--bound"})
    """Range of a parameter, NAME=LOW:HIGH; repeatable."""
    fixed: dict[str, Component] = Field(default={}, json_schema_extra={"flag": "--fix"})
    """Known value of a parameter; repeatable."""
    solver: Solver = LikelihoodSolver()
    """likelihood (with intervals), adam (the paper's), cma_es or random_search."""
    points: Count | None = None
    """Number of points sampled on the cloth in each frame. Default: the scene's."""
    frames: Annotated[list[Annotated[int, Field(ge=-100_000, le=100_000)]], Field(min_length=1)] | None = None
    """Frames to compare, such as 0,5,10. Default: all usable ones."""
    seed: Seed = 0
    """Seed of all random numbers."""
    loss: Literal["surface", "paper"] = "surface"
    """surface: both directions, all frames. paper: one-sided, as in the paper."""
    alignment: Name | None = None
    """Pose variables and their standard deviations, such as x=2cm,yaw=5deg,lag=50ms; or none. Default: all but scale."""
    initial_state: Name | None = None
    """Its standard deviations: turn=5deg,shape=5mm,size=2%,track=2%; or none."""
    prior: Name | None = None
    """Standard deviations of parameters, such as bending=3x; or none. Default: 10x."""
    uncertain: Name | None = None
    """Nuisance material and its standard deviations, such as bending=1.5x; or none."""
    joint: bool = False
    """Fit one parameter set to all recordings, of one cloth."""
    level: Level = LEVEL
    """Probability of the intervals."""
    identified_factor: Factor = IDENTIFIED_FACTOR
    """A parameter counts as identified if its interval ends within this factor to each side."""

    @field_validator("solver", mode="before")
    @classmethod
    def _named(cls, solver: Any) -> Any:
        """Replace a solver's name by its default settings."""
        if isinstance(solver, str):
            solver = {"name": solver}
        if not isinstance(solver, dict):
            return solver
        solver = {"name": "likelihood", **solver}
        if solver["name"] not in SOLVER_KINDS:
            raise ValueError(f"unknown solver {solver['name']!r}; allowed are {', '.join(SOLVER_KINDS)}")
        return solver

    @field_validator("bounds", "fixed", mode="before")
    @classmethod
    def _given(cls, values: Any) -> Any:
        """Drop entries that are null, so that the default applies."""
        return {name: value for name, value in values.items() if value is not None} if isinstance(values, dict) else values

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name, pair in self.bounds.items():
            check_bounds(f"bounds.{name}", pair)
        initial_state, uncertain = self._parsed()
        if self.loss != "paper":
            return self
        if initial_state:
            raise ValueError("initial_state: with the paper's loss, the initial state is the scene's; leave it out")
        if uncertain:
            raise ValueError("uncertain: with the paper's loss, the rest of the material is known; leave it out")
        if self.solver.name == "likelihood":
            raise ValueError("loss: the paper's loss has no likelihood; choose another solver, such as adam")
        return self

    def _parsed(self) -> tuple[Mapping[str, float], Mapping[str, float]]:
        """Parse `alignment`, `initial_state` and `uncertain`, and return the last two.

        If none of them is stated, the configuration is read without torch.
        """
        if {self.alignment, self.initial_state, self.uncertain} <= {None, "none"}:
            return {}, {}
        from diffcloud.estimation.pose import parse_priors
        from diffcloud.scene.scenarios.initial_state import parse_initial_state
        from diffcloud.scene.scenarios.uncertain import parse_uncertain

        parse_priors(self.alignment or "none")
        return parse_initial_state(self.initial_state or "none"), parse_uncertain(self.uncertain or "none")

    @property
    def paper(self) -> bool:
        """Whether the loss is the paper's."""
        return self.loss == "paper"

    def measure(self) -> dict[str, Any]:
        """Return the keyword arguments of `Objective`."""
        from diffcloud.estimation.pose import parse_priors

        priors = None if self.alignment is None else parse_priors(self.alignment)
        return {"paper": self.paper, "nuisance": priors, "frames": self.frames, "points": self.points, "seed": self.seed}

    def known_within(self, scenarios: Sequence[Scenario]) -> dict[str, float]:
        """Return the uncertain material of a fit in these scenarios -> standard deviation as a factor."""
        from diffcloud.estimation.uncertain import MATERIAL_UNCERTAINTY
        from diffcloud.scene.scenarios.uncertain import parse_uncertain

        if self.uncertain is not None:
            return parse_uncertain(self.uncertain)
        if not self._fits_more(scenarios):
            return {}
        own: dict[str, float] = {}
        for one in scenarios:
            own |= {name: max(factor, own.get(name, 1.0)) for name, factor in one.uncertain.items()}
        return {
            name: factor
            for name, factor in {**MATERIAL_UNCERTAINTY, **own}.items()
            if name not in {*self.parameters, *self.fixed}
        }

    def initial_state_within(self, scenarios: Sequence[Scenario]) -> list[dict[str, float]]:
        """Return the initial-state variables of each recording in one fit: name -> standard deviation [rad, m, 1].
        `estimation.initial_state` explains the names."""

        from diffcloud.scene.scenarios.initial_state import parse_initial_state

        if self.initial_state is not None:
            return [parse_initial_state(self.initial_state)] * len(scenarios)
        return [dict(one.initial_state) if self._fits_more(scenarios) else {} for one in scenarios]

    def _fits_more(self, scenarios: Sequence[Scenario]) -> bool:
        """Return whether nuisance variables are fitted by default, i.e. whether derivatives make them cheap."""
        from diffcloud.sim.integrators import load_integrator

        smooth = all(load_integrator(one.scene.integrator).smooth for one in scenarios)
        return self.solver.name == "likelihood" and smooth

    def solver_settings(self, scenario: Scenario) -> Settings:
        """Return the solver's settings, with the scenario's values as defaults."""
        from diffcloud.estimation.solvers import SOLVERS

        given: dict[str, Any] = {"seed": self.seed}
        if isinstance(self.solver, AdamSolver):
            given |= {"learning_rate": scenario.learning_rate, "smoothing": SMOOTHING}
        if not isinstance(self.solver, LikelihoodSolver):
            given["threshold"] = scenario.threshold if self.paper else 0.0
        return SOLVERS[self.solver.name](**given | self.solver.model_dump(exclude={"name"}, exclude_none=True))
