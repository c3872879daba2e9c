"""Settings of each stage: one frozen block per section of params.yaml. Unknown keys and bad values are errors."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator

from diffcloud.errors import ConfigError
from diffcloud.estimation.settings import FitSettings
from diffcloud.evaluation import BASELINES, Baseline, ComparisonSettings
from diffcloud.io.files import read_yaml
from diffcloud.io.raw_episodes import ScenePlacement
from diffcloud.io.schema import Component, NonNegative, Positive, explain
from diffcloud.jobs.network_settings import GenerateSettings, TrainSettings
from diffcloud.sensing.depth_camera import DepthNoise
from diffcloud.sensing.filters import Downsampling
from diffcloud.sensing.fusion import FusionSettings
from diffcloud.sensing.recorder import RecorderSettings
from diffcloud.settings import Bounds, Count, CountOrNone, Name, Names, Pixels, Point, Section, Seed, check_bounds


class SynthesizeConfig(Section):
    """Synthetic recordings. A person's own lie in raw/, where `diffcloud data preprocess` finds them."""

    per_scenario: CountOrNone = 2
    """Of each scenario; 0: none, only a person's own are used."""
    seed: Seed = 0
    true_range: Bounds = (0.3, 3.0)
    """Hidden multipliers of camera recordings are drawn log-uniformly from it; fully observed scenarios (`recorder:
    whole_surface`) draw uniformly over the bounds of a fit, as the paper does."""
    image_size: tuple[Pixels, Pixels] = (424, 240)
    """Columns and rows of camera recordings; a D435 offers 424 x 240, 640 x 480, 848 x 480 and more."""
    subpixel_px: NonNegative = DepthNoise.subpixel_px
    """Deviation of the cameras' disparity [px of their imagers]."""
    clock_offset_s: NonNegative = RecorderSettings.clock_offset_s
    """How late the joint log is."""
    extrinsic_error: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """(millimetres, degrees) by which the stated place of each camera but the first is off."""
    rig_error: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """The same of all cameras together."""
    placement_error: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """(millimetres, degrees) by which cloth and gripper are not where the recording says."""

    def recorder(self) -> RecorderSettings:
        return RecorderSettings(
            clock_offset_s=self.clock_offset_s,
            extrinsic_error=self.extrinsic_error,
            rig_error=self.rig_error,
            placement_error=self.placement_error,
        )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        check_bounds("true_range", self.true_range)
        if self.true_range[0] <= 0:
            raise ValueError(f"true_range must be positive, got {self.true_range}")
        return self


class RawConfig(Section):
    """From raw episodes to clouds (`diffcloud.sensing.fusion.FusionSettings` says what each means)."""

    robot: Name | None = "gen3"
    """Whose pixels are masked: `gen3`, the package's own description, or the path of a URDF; null: nobody's."""
    robot_margin_m: NonNegative = 0.007
    """Margin around the robot."""
    workspace_m: tuple[Point, Point] = FusionSettings.workspace_m
    imager_offsets_m: Annotated[tuple[Annotated[float, Field(ge=-1, le=1)], ...], Field(max_length=10)] = (
        FusionSettings.imager_offsets_m
    )
    depth_jump_m: NonNegative = FusionSettings.depth_jump_m
    refine: bool = FusionSettings.refine
    clock_offset_s: Annotated[float, Field(ge=-10, le=10)] = FusionSettings.clock_offset_s
    table: bool = FusionSettings.table
    clearance_m: Positive = FusionSettings.clearance_m
    color_difference: Positive = FusionSettings.color_difference
    smoothing_px: CountOrNone = FusionSettings.smoothing_px
    cluster_gap_m: NonNegative = FusionSettings.cluster_gap_m
    min_cluster_fraction: Annotated[float, Field(ge=0, le=1)] = FusionSettings.min_cluster_fraction
    subpixel_px: Positive = FusionSettings.subpixel_px
    imager_focal_px: Positive = FusionSettings.imager_focal_px
    baseline_m: Positive = FusionSettings.baseline_m
    origin_m: Point | None = None
    """The scene's origin in the base frame; with `yaw_rad` and `length_unit_m` in place of what episode.json says."""
    yaw_rad: Component = 0.0
    length_unit_m: Positive = 1.0

    def fusion(self) -> FusionSettings:
        placement = None if self.origin_m is None else ScenePlacement(self.origin_m, self.yaw_rad, self.length_unit_m)
        own = {"robot", "robot_margin_m", "origin_m", "yaw_rad", "length_unit_m"}
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
    outlier_std: Positive = 5.0
    """A merged cloud is of uneven density: 2.5, the paper's, takes thin parts of the cloth."""
    radius_m: Positive | None = None
    """Points with fewer than `radius_neighbours` others within it are outliers too; in the scene's unit."""
    radius_neighbours: Count = 4
    points: Count | None = 3500
    """Kept per frame at most."""
    downsampling: Downsampling = "random"
    seed: Seed = 0

    @model_validator(mode="after")
    def _two_cameras(self) -> Self:
        if self.align_cameras is not None and len(set(self.align_cameras)) < 2:
            raise ValueError(f"align_cameras takes two different cameras, got {list(self.align_cameras)}")
        return self


class EvaluateConfig(Section):
    """Comparing methods, and what can be known of the parameters."""

    draws: Count = 4
    """Fresh point samples that a loss is averaged over."""
    seed: Seed = 1000
    baselines: Annotated[list[Baseline], Field(max_length=len(BASELINES) + 10)] = list(BASELINES)
    """Methods beside the fits and the networks; searches may simulate as often as the fit."""
    landscapes: Annotated[list[Name], Field(max_length=10_000)] = []
    """Patterns of <scenario>/<episode> whose loss landscape is simulated."""
    landscape_size: Annotated[int, Field(ge=2, le=1000)] = 7
    """Places along each of its axes."""

    def comparison(self, episode: str, fit: FitSettings) -> ComparisonSettings:
        """For <scenario>/<episode>."""

        def chosen(patterns: list[str]) -> bool:
            return any(fnmatch(episode, pattern) for pattern in patterns)

        return ComparisonSettings(
            baselines=tuple(self.baselines),
            draws=self.draws,
            seed=self.seed,
            level=fit.level,
            within=fit.identified_factor,
            landscape_size=self.landscape_size if chosen(self.landscapes) else 0,
        )


class ReportConfig(Section):
    """The page."""

    title: Name = "DiffCloud report"
    cloud_points: Count = 1200
    """Shown per cloud and frame."""


class Config(Section):
    """All of params.yaml."""

    scenes: Names = ["lift", "fold", "band_stretch", "vest_hang"]
    synthesize: SynthesizeConfig = SynthesizeConfig()
    preprocess: PreprocessConfig = PreprocessConfig()
    generate: GenerateSettings = GenerateSettings()
    fit: FitSettings = FitSettings()
    train: TrainSettings = TrainSettings()
    evaluate: EvaluateConfig = EvaluateConfig()
    report: ReportConfig = ReportConfig()


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
