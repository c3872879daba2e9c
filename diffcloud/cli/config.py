"""Settings of each stage: one frozen block per section of params.yaml. Unknown keys and bad values are errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from diffcloud.errors import ConfigError
from diffcloud.evaluation import RIVALS, ComparisonSettings, Rival
from diffcloud.evaluation.intervals import LEVEL, WITHIN
from diffcloud.fit.doubts import MATERIAL_DOUBTS, parse_doubts
from diffcloud.fit.laid import parse_laid
from diffcloud.fit.pose import parse_priors
from diffcloud.fit.solvers import SOLVERS, Settings
from diffcloud.io.files import read_yaml
from diffcloud.io.raw_episodes import ScenePlacement
from diffcloud.io.schema import Checked, Component, NonNegative, Positive, Vector, explain
from diffcloud.regressors.settings import Loss, Profile, Target
from diffcloud.scene.scenarios import Scenario
from diffcloud.sensing.depth_camera import DepthNoise
from diffcloud.sensing.filters import Thinning
from diffcloud.sensing.fusion import FusionSettings
from diffcloud.sensing.recorder import RecorderSettings

_MOST, _FACTOR = 10_000_000, 1e6
MOST_STARTS = 100
"""Of a fit. A start takes minutes, a candidate about a second."""
Count = Annotated[int, Field(ge=1, le=_MOST)]
CountOrNone = Annotated[int, Field(ge=0, le=_MOST)]
"""Zero: there is none, or it is left out."""
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Factor = Annotated[float, Field(gt=1, le=_FACTOR)]
"""Within which something is known."""
Name = Annotated[str, Field(max_length=1000)]
"""Of a thing, a file or a folder."""
Pixels = Annotated[int, Field(ge=1, le=10_000)]
Names = Annotated[list[Name], Field(min_length=1, max_length=10_000)]
Bounds = tuple[Component, Component]
Point = Vector


def _check_bounds(name: str, bounds: Bounds) -> None:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"{name} must be in order (low < high), got {list(bounds)}")


class Section(Checked, BaseModel):  # named again, for ruff to know that defaults are copied
    """One section of params.yaml."""

    @model_validator(mode="before")
    @classmethod
    def _decides_results(cls, data: Any) -> Any:
        for name in ("workers", "loaders"):
            if isinstance(data, dict) and name in data:
                raise ValueError(f"{name}: now only the option --{name}, since it does not change results; remove the key")
        return data


class EpisodesConfig(Section):
    """Synthetic recordings. A person's own lie in raw/, where `diffcloud preprocess` finds them."""

    per_scenario: CountOrNone = 2
    """Of each scenario; 0: none, only a person's own are used."""
    seed: Seed = 0
    hidden_range: Bounds = (0.3, 3.0)
    """Hidden multipliers of camera recordings are drawn log-uniformly from it; fully observed scenarios (`recorder:
    whole_surface`) draw uniformly over the bounds of a fit, as the paper does."""
    image_size: tuple[Pixels, Pixels] = (424, 240)
    """Columns and rows of camera recordings; a D435 offers 424 x 240, 640 x 480, 848 x 480 and more."""
    subpixel_px: NonNegative = DepthNoise.subpixel_px
    """Deviation of the cameras' disparity [px of their imagers]."""
    lag_s: NonNegative = RecorderSettings.lag_s
    """How late the joint log is."""
    extrinsic_error: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """(millimetres, degrees) by which the stated place of each camera but the first is off."""
    cameras_moved: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """The same of all cameras together."""
    beside: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """(millimetres, degrees) by which cloth and gripper are not where the recording says."""

    def recorder(self) -> RecorderSettings:
        return RecorderSettings(
            lag_s=self.lag_s,
            extrinsic_error=self.extrinsic_error,
            cameras_moved=self.cameras_moved,
            beside=self.beside,
        )

    @model_validator(mode="before")
    @classmethod
    def _is_of_now(cls, data: Any) -> Any:
        if isinstance(data, dict) and "source" in data:
            raise ValueError(
                "source: recordings in raw/ are always used; remove the key, and set per_scenario: 0 for no others"
            )
        return data

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        _check_bounds("hidden_range", self.hidden_range)
        if self.hidden_range[0] <= 0:
            raise ValueError(f"hidden_range must be positive, got {self.hidden_range}")
        return self


class RawConfig(Section):
    """From raw episodes to clouds (`diffcloud.sensing.fusion.FusionSettings` says what each means)."""

    robot: Name | None = "gen3"
    """Whose pixels are masked: `gen3`, the package's own description, or the path of a URDF; null: nobody's."""
    inflation_m: NonNegative = 0.007
    """Margin around the robot."""
    workspace_m: tuple[Point, Point] = FusionSettings.workspace_m
    eyes_m: Annotated[tuple[Annotated[float, Field(ge=-1, le=1)], ...], Field(max_length=10)] = FusionSettings.eyes_m
    flying_m: NonNegative = FusionSettings.flying_m
    refine: bool = FusionSettings.refine
    lag_s: Annotated[float, Field(ge=-10, le=10)] = FusionSettings.lag_s
    table: bool = FusionSettings.table
    clearance_m: Positive = FusionSettings.clearance_m
    color_difference: Positive = FusionSettings.color_difference
    smoothing_px: CountOrNone = FusionSettings.smoothing_px
    cluster_gap_m: NonNegative = FusionSettings.cluster_gap_m
    least_cluster: Annotated[float, Field(ge=0, le=1)] = FusionSettings.least_cluster
    subpixel_px: Positive = FusionSettings.subpixel_px
    imager_focal_px: Positive = FusionSettings.imager_focal_px
    baseline_m: Positive = FusionSettings.baseline_m
    origin_m: Point | None = None
    """The scene's origin in the base frame; with `yaw_rad` and `length_unit_m` in place of what episode.json says."""
    yaw_rad: Component = 0.0
    length_unit_m: Positive = 1.0

    def fusion(self) -> FusionSettings:
        placement = None if self.origin_m is None else ScenePlacement(self.origin_m, self.yaw_rad, self.length_unit_m)
        own = {"robot", "inflation_m", "origin_m", "yaw_rad", "length_unit_m"}
        return FusionSettings(**self.model_dump(exclude=own), placement=placement)

    @model_validator(mode="after")
    def _placed(self) -> Self:
        if self.origin_m is None and (self.yaw_rad != 0.0 or self.length_unit_m != 1.0):
            raise ValueError("yaw_rad and length_unit_m go with origin_m: give all three, or none")
        return self


class PreprocessConfig(Section):
    """Cleaning of clouds."""

    raw: RawConfig = RawConfig()
    align_cameras: tuple[Name, Name] | None = None
    """Names of two cameras: the second one's pose, depth scale and clock are corrected against the first, as far as the
    recording shows them (`diffcloud.sensing.agreement`). The clouds must be in metres. Off by default, since `raw.refine`
    finds the cameras' places, and a single recording of a stiff or slow cloth shows little more."""
    crop_m: tuple[Point, Point] | None = None
    """Lowest and highest corner of a box in the scene's frame."""
    outlier_neighbours: CountOrNone = 20
    outlier_deviations: Positive = 5.0
    """A merged cloud is of uneven density: 2.5, the paper's, takes thin parts of the cloth."""
    radius_m: Positive | None = None
    """Points with fewer than `radius_neighbours` others within it are outliers too; in the scene's unit."""
    radius_neighbours: Count = 4
    points: Count | None = 3500
    """Kept per frame at most."""
    thinning: Thinning = "random"
    seed: Seed = 0

    @model_validator(mode="after")
    def _two_cameras(self) -> Self:
        if self.align_cameras is not None and len(set(self.align_cameras)) < 2:
            raise ValueError(f"align_cameras takes two different cameras, got {list(self.align_cameras)}")
        return self


class SimulateConfig(Section):
    """Simulated sets for the regressors."""

    scenarios: Names = ["lift", "fold"]
    """Those that the pipeline makes sets of."""
    parameters: Names = ["stretch", "mass"]
    draws: Literal["uniform", "sobol", "logarithmic", "modes"] = "uniform"
    """Over the bounds: `uniform`, `sobol`, or `logarithmic` (uniform in the logarithms where the lower bound is
    positive); or `modes`: the published code's mixture of soft, medium and stiff cloths."""
    doubts: Name | None = None
    """Material that is not drawn differs from run to run by these factors, as those of fits. Default: not at all."""
    train: CountOrNone = 1500
    test: CountOrNone = 375
    seed: Seed = 0

    def known_within(self) -> dict[str, float]:
        """Material that is not drawn -> factor of one deviation."""
        return parse_doubts(self.doubts or "none")


SMOOTHING = 0.5
"""Default of adam's."""
_OF_SOLVERS = ("iterations", "starts", "learning_rate", "smoothing", "resample", "simulations")
"""Options that not every solver has: one does if its settings have a field of that name."""


class FitConfig(Section):
    """Fits."""

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
    not given, all of them, as `fit.pose.default_priors` says."""
    laid: Name | None = None
    """How the cloth may lie other than as its scenario has it, and how far off: "turn=5deg,shape=5mm,size=2%", or "none"
    (`fit.laid`). Default: what the scenario says, of likelihood with the implicit integrator; else none."""
    prior: Name | None = None
    """Within which factor of the basis each multiplier probably lies: "bending=3x", others 10x; or "none"."""
    doubts: Name | None = None
    """The factor within which material that is not asked for is known: "bending=1.5x,drag=1.3x", or "none". It is fitted
    too, and is not a result (`fit.doubts`). Default: `MATERIAL_DOUBTS` and what the scenario says, of likelihood with
    the implicit integrator; else none."""
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
            _check_bounds(f"bounds.{name}", pair)
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
        of `fit.laid` -> standard deviation [rad, m, 1]."""
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


class TrainConfig(Section):
    """Regressors. What is not given (null) is the profile's (`diffcloud.regressors.settings`)."""

    scenarios: Names = ["lift", "fold"]
    """Those that the pipeline trains for."""
    models: Names = ["mlp", "pointnet2", "meteornet"]
    profile: Profile = "reduced"
    epochs: Count | None = None
    draws: Count | None = None
    points: Count | None = None
    batch_size: Count | None = None
    learning_rate: Positive | None = None
    loss: Loss | None = None
    target: Target | None = None
    augment: bool | None = None
    viewpoints: tuple[tuple[Component, Component, Component], ...] | None = None
    """Places in the scene, in its length unit: clouds show what cameras there see."""
    subtract_background: bool | None = None
    heteroscedastic: bool | None = None
    patience: Count | None = None
    seed: Seed | None = None
    device: Literal["auto", "cpu", "gpu"] = "auto"

    def changes(self) -> dict[str, object]:
        """What differs from the profile."""
        return self.model_dump(exclude={"scenarios", "models", "profile", "device"}, exclude_none=True)


class EvaluateConfig(Section):
    """Comparing methods, and what can be known of the parameters."""

    draws: Count = 4
    """Fresh point samples that a loss is averaged over."""
    seed: Seed = 1000
    rivals: Annotated[list[Rival], Field(max_length=len(RIVALS) + 10)] = list(RIVALS)
    """Methods beside the fits and the networks; searches may simulate as often as the fit."""
    level: Annotated[float, Field(gt=0, lt=1)] | None = LEVEL
    """Of the intervals; null: none."""
    within: Factor = WITHIN
    """A parameter counts as identified if its interval ends within this factor."""
    landscapes: Annotated[list[Name], Field(max_length=10_000)] = []
    """Patterns of <scenario>/<episode> whose loss landscape is simulated."""
    landscape_size: Annotated[int, Field(ge=2, le=1000)] = 7
    """Places along each of its axes."""

    @model_validator(mode="before")
    @classmethod
    def _is_of_now(cls, data: Any) -> Any:
        if isinstance(data, dict) and "doubts" in data:
            raise ValueError('evaluate.doubts: now `fit.doubts`, such as "bending=1.5x,drag=1.3x", or none')
        return data

    def comparison(self, episode: str) -> ComparisonSettings:
        """For <scenario>/<episode>."""

        def chosen(patterns: list[str]) -> bool:
            return any(fnmatch(episode, pattern) for pattern in patterns)

        return ComparisonSettings(
            rivals=tuple(self.rivals),
            draws=self.draws,
            seed=self.seed,
            level=self.level,
            within=self.within,
            landscape_size=self.landscape_size if chosen(self.landscapes) else 0,
        )


class ReportConfig(Section):
    """The page."""

    title: Name = "DiffCloud report"
    overlay_points: Count = 1200
    """Shown per cloud and frame."""


class Config(Section):
    """All of params.yaml."""

    scenarios: Names = ["lift", "fold", "band_stretch", "vest_hang"]
    episodes: EpisodesConfig = EpisodesConfig()
    preprocess: PreprocessConfig = PreprocessConfig()
    simulate: SimulateConfig = SimulateConfig()
    fit: FitConfig = FitConfig()
    train: TrainConfig = TrainConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    report: ReportConfig = ReportConfig()


S = TypeVar("S", bound=Section)


def load_config(path: Path | None) -> Config:
    """Read params.yaml; None gives the defaults.

    Raises:
        ConfigError: an unreadable file, an unknown key, a bound out of order: names the key and what is allowed.
    """
    if path is None:
        return Config()
    data = read_yaml(path, error=ConfigError, kind="parameter file")
    try:
        return Config.model_validate({} if data is None else data)
    except ValidationError as error:
        raise explain(path, error, ConfigError) from error


def updated(section: S, **options: object) -> S:
    """The section with the options that were given (not None) in place.

    Raises:
        ConfigError: a value out of range.
    """
    given = {name: value for name, value in options.items() if value is not None}
    try:
        return type(section).model_validate({**section.model_dump(), **given})
    except ValidationError as error:
        raise explain("command line", error, ConfigError) from error
