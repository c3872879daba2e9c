"""Settings of simulated sets and of networks: one field for each, from which options, params.yaml and the page are made.

Nothing here imports torch, so that help is quick.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from diffcloud.io.schema import Component, Positive
from diffcloud.settings import Count, CountOrNone, Name, Names, Section, Seed


class GenerateSettings(Section):
    """Simulated sets for the regressors."""

    scenes: Names = ["lift", "fold"]
    """Those that the pipeline makes sets of."""
    parameters: Names = ["stretching", "density"]
    """Parameters to vary, comma-separated."""
    distribution: Literal["uniform", "sobol", "logarithmic", "modes"] = "uniform"
    """Of the parameters, over their bounds; logarithmic: uniform in the logarithm where the lower bound is positive;
    modes: the published mixture of soft, medium and stiff cloths."""
    uncertain: Name | None = None
    """Other material that varies from run to run by such factors: bending=1.5x,air_density=1.3x. Default: none."""
    train: CountOrNone = 1500
    """Runs to train on."""
    test: CountOrNone = 375
    """Runs to test on."""
    seed: Seed = 0
    """Of the parameters and of exported clouds."""


class TrainSettings(Section):
    """Of networks. What is not given (null) is the profile's (`diffcloud.regressors.settings`)."""

    scenes: Names = ["lift", "fold"]
    """Those that the pipeline trains for."""
    models: Names = Field(default=["mlp", "pointnet2", "meteornet"], json_schema_extra={"flag": "--model"})
    """mlp, pointnet2, meteornet, or posterior (an extra); comma-separated."""
    profile: Literal["quick", "reduced", "paper"] = "reduced"
    """All hyper-parameters."""
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
    """Places in the scene, in its length unit: clouds show what cameras there see."""
    subtract_background: bool | None = None
    predict_variance: bool | None = None
    patience: Count | None = None
    seed: Seed | None = None
    """Of all random numbers."""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """Where to train; gpu: in mixed precision."""

    def changes(self) -> dict[str, object]:
        """What differs from the profile."""
        return self.model_dump(exclude={"scenes", "models", "profile", "device"}, exclude_none=True)
