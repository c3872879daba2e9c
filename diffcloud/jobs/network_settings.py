"""Settings of simulated sets and networks. Options, params.yaml and the documentation are generated from these fields.

This module does not import torch, so that `--help` is fast.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from diffcloud.io.schema import Component, Positive
from diffcloud.settings import Count, CountOrNone, Name, Names, Section, Seed


class GenerateSettings(Section):
    """Simulated sets for the regressors."""

    scenes: Names = ["lift", "fold"]
    """Scenes for which the pipeline makes sets."""
    parameters: Names = ["stretching", "density"]
    """Parameters to vary, comma-separated."""
    distribution: Literal["uniform", "sobol", "logarithmic", "modes"] = "uniform"
    """Distribution of the parameters within their bounds. logarithmic: uniform in the logarithm if the lower bound is
    positive; modes: the published mixture of soft, medium and stiff cloths."""
    uncertain: Name | None = None
    """Other material that varies between runs by these factors: bending=1.5x,air_density=1.3x. Default: none."""
    train: CountOrNone = 1500
    """Number of training runs."""
    test: CountOrNone = 375
    """Number of test runs."""
    seed: Seed = 0
    """Seed of the parameters and of exported clouds."""


class TrainSettings(Section):
    """Training of networks. Omitted values (null) are those of the profile (`diffcloud.regressors.settings`)."""

    scenes: Names = ["lift", "fold"]
    """Scenes for which the pipeline trains networks."""
    models: Names = Field(default=["mlp", "pointnet2", "meteornet"], json_schema_extra={"flag": "--model"})
    """mlp, pointnet2, meteornet, or posterior (an extra); comma-separated."""
    profile: Literal["quick", "reduced", "paper"] = "reduced"
    """Preset of all hyper-parameters."""
    epochs: Count | None = None
    """Passes over the training runs."""
    draws: Count | None = None
    points: Count | None = None
    batch_size: Count | None = None
    learning_rate: Positive | None = None
    loss: Literal["normalised", "raw"] | None = None
    target: Literal["linear", "logarithmic"] | None = None
    augment: bool | None = None
    viewpoints: tuple[tuple[Component, Component, Component], ...] | None = None
    """Camera positions in the scene, in its length unit. Clouds then have only points that these cameras see."""
    subtract_background: bool | None = None
    predict_variance: bool | None = None
    patience: Count | None = None
    seed: Seed | None = None
    """Seed of all random numbers."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to train. gpu uses mixed precision."""

    def changes(self) -> dict[str, object]:
        """Return the values that differ from the profile."""
        return self.model_dump(exclude={"scenes", "models", "profile", "device"}, exclude_none=True)
