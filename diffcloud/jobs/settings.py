"""Settings of each pipeline stage, one section of params.yaml each. Unknown keys and invalid values are errors."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, ValidationError, model_validator

from diffcloud.errors import ConfigError
from diffcloud.estimation.settings import FitSettings
from diffcloud.evaluation.settings import BASELINES, Baseline, ComparisonSettings
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
    """Synthetic recordings. The user's own are in raw/, where `diffcloud data preprocess` finds them."""

    per_scenario: CountOrNone = 2
    """Number of recordings per scenario. 0: use only the user's own."""
    seed: Seed = 0
    true_range: Bounds = (0.3, 3.0)
    """Range of the hidden multipliers of camera recordings, sampled log-uniformly. Fully observed scenarios (`recorder:
    whole_surface`) sample uniformly within the bounds of a fit, as in the paper."""
    image_size: tuple[Pixels, Pixels] = (424, 240)
    """Width and height of camera images; a D435 offers 424 x 240, 640 x 480, 848 x 480 and more."""
    subpixel_px: NonNegative = DepthNoise.subpixel_px
    """Standard deviation of the cameras' disparity [px of the infrared images]."""
    clock_offset_s: NonNegative = RecorderSettings.clock_offset_s
    """Delay of the joint log relative to the images."""
    extrinsic_error: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Error (millimetres, degrees) in the stated pose of each camera except the first."""
    rig_error: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Common error (millimetres, degrees) in the stated poses of all cameras."""
    placement_error: tuple[NonNegative, NonNegative] = (0.0, 0.0)
    """Error (millimetres, degrees) in the stated pose of cloth and gripper."""

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
    """Conversion of raw episodes to clouds. `diffcloud.sensing.fusion.FusionSettings` explains each setting."""

    robot: Name | None = "gen3"
    """Robot whose pixels are masked: `gen3` (included), or the path of a URDF; null: none."""
    robot_margin_m: NonNegative = 0.007
    """Margin of the mask around the robot."""
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
    """Origin of the scene in the base frame. It replaces, with `yaw_rad` and `length_unit_m`, the values in
    episode.json."""
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
    """Names of two cameras. The second one's pose, depth scale and clock are corrected against the first, as far as the
    recording identifies them (`diffcloud.sensing.agreement`). Clouds must be in metres. Off by default, since
    `raw.refine` already estimates camera poses, and one recording of a stiff or slow cloth adds little."""
    crop_m: tuple[Point, Point] | None = None
    """Lowest and highest corner of the crop box in the scene's frame."""
    outlier_neighbours: CountOrNone = 20
    outlier_std: Positive = 5.0
    """Outlier threshold in standard deviations. Merged clouds vary in density: the paper's 2.5 removes thin parts of
    the cloth."""
    radius_m: Positive | None = None
    """Points with fewer than `radius_neighbours` others within this radius are outliers too; in the scene's unit."""
    radius_neighbours: Count = 4
    points: Count | None = 3500
    """Largest number of points per frame."""
    downsampling: Downsampling = "random"
    seed: Seed = 0

    @model_validator(mode="after")
    def _two_cameras(self) -> Self:
        if self.align_cameras is not None and len(set(self.align_cameras)) < 2:
            raise ValueError(f"align_cameras takes two different cameras, got {list(self.align_cameras)}")
        return self


class EvaluateConfig(Section):
    """Comparison of methods, and identifiability of the parameters."""

    draws: Count = 4
    """Number of fresh point samples over which a loss is averaged."""
    seed: Seed = 1000
    baselines: Annotated[list[Baseline], Field(max_length=len(BASELINES) + 10)] = list(BASELINES)
    """Methods besides fits and networks. Searches may simulate as often as the fit."""
    landscapes: Annotated[list[Name], Field(max_length=10_000)] = []
    """Patterns of <scenario>/<episode> for which the loss landscape is simulated."""
    landscape_size: Annotated[int, Field(ge=2, le=1000)] = 7
    """Number of grid points along each axis of a landscape."""

    def comparison(self, episode: str, fit: FitSettings) -> ComparisonSettings:
        """Return the settings of the comparison for <scenario>/<episode>."""

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
    """Report page."""

    title: Name = "DiffCloud report"
    cloud_points: Count = 1200
    """Number of points shown per cloud and frame."""


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
    """Read params.yaml. None gives the defaults.

    Raises:
        ConfigError: the file is not readable, a key is unknown, or a value is invalid.
    """
    if path is None:
        return Config()
    data = read_yaml(path, error=ConfigError, kind="parameter file")
    try:
        return Config.model_validate({} if data is None else data)
    except ValidationError as error:
        raise explain(path, error, ConfigError) from error
