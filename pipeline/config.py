"""Settings of each stage: one frozen block per section of params.yaml. Unknown keys and bad values are errors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from diffcloud.errors import ConfigError
from diffcloud.scene.schema import NonNegative, Positive, explain

Count = Annotated[int, Field(ge=1)]
Bounds = tuple[float, float]


def _check_bounds(name: str, bounds: Bounds) -> None:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"{name} must be in order (low < high), got {list(bounds)}")


class Section(BaseModel):
    """One section of params.yaml."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class EpisodesConfig(Section):
    """Where episodes come from."""

    source: str = "synthetic"
    """`synthetic`, or a folder with <scenario>/<episode>.npz (see `diffcloud import`)."""
    per_scenario: Count = 2
    """Synthetic episodes of each scenario."""
    seed: int = 0
    hidden_range: Bounds = (0.3, 3.0)
    """Hidden multipliers of camera recordings are drawn log-uniformly from it; fully observed scenarios (`recorder:
    whole_surface`) draw uniformly over the bounds of a fit, as the paper does."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        _check_bounds("hidden_range", self.hidden_range)
        if self.hidden_range[0] <= 0:
            raise ValueError(f"hidden_range must be positive, got {self.hidden_range}")
        return self


class PreprocessConfig(Section):
    """Cleaning of clouds."""

    crop_m: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Lowest and highest corner of a box in the scene's frame."""
    outlier_neighbours: Annotated[int, Field(ge=0)] = 20
    outlier_deviations: Positive = 2.5
    points: Count | None = 3500
    """Kept per frame at most."""
    seed: int = 0


class FitConfig(Section):
    """Fits."""

    parameters: Annotated[list[str], Field(min_length=1)] = ["stretch", "mass"]
    bounds: dict[str, Bounds] = {}
    fixed: dict[str, float] = {}
    optimizer: Literal["adam"] = "adam"
    iterations: Count = 50
    learning_rate: Positive | None = None
    """The scenario's own if not given."""
    starts: Count = 1
    smoothing: NonNegative = 0.5
    """Standard deviation, on the sigmoid's axis, of the first start's perturbed copies, whose gradients are averaged; 0:
    the plain gradient, as the paper has it."""
    threshold: NonNegative | None = None
    points: Count | None = None
    frames: list[int] | None = None
    seed: int = 0
    resample: bool = False
    offset: bool = False
    joint: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name, pair in self.bounds.items():
            _check_bounds(f"bounds.{name}", pair)
        return self


class EvaluateConfig(Section):
    """Measuring fits."""

    draws: Count = 4
    """Fresh point samples that a loss is averaged over."""
    seed: int = 1000


class ReportConfig(Section):
    """The page."""

    title: str = "DiffCloud report"
    overlay_points: Count = 1200
    """Shown per cloud and frame."""


class Config(Section):
    """All of params.yaml."""

    scenarios: Annotated[list[str], Field(min_length=1)] = ["lift", "fold", "band_stretch", "vest_hang"]
    episodes: EpisodesConfig = EpisodesConfig()
    preprocess: PreprocessConfig = PreprocessConfig()
    fit: FitConfig = FitConfig()
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
    try:
        data = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(f"No such parameter file: {path}.") from error
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{path} is not readable YAML: {error}.") from error
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
