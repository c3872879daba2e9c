"""Settings of the training of a regressor, and the named profiles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.regressors.grouping import Order
from diffcloud.regressors.networks import MODEL_NAMES, ModelName

Loss = Literal["normalised", "raw"]
"""L1 loss of parameters as fractions of their range (`normalised`), or in their own units as in the paper (`raw`)."""
Target = Literal["linear", "logarithmic"]
"""Meaning of a network's output: fraction of the range, linear or logarithmic. Logarithmic targets weigh relative
errors and keep predictions positive."""
Profile = Literal["quick", "reduced", "paper"]
PROFILE_NAMES: tuple[Profile, ...] = get_args(Profile)
BACKGROUND_REACH_M = 0.01
"""Distance within which points belong to the obstacle [m]: more than a depth camera's noise, less than a fold."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of one training; the defaults are the paper's."""

    epochs: int = 100
    batch_size: int = 32
    learning_rate: float = 1e-3
    schedule: Literal["constant", "cosine"] = "constant"
    """"cosine" lowers the learning rate to zero at the end, which short trainings need."""
    loss: Loss = "normalised"
    target: Target = "linear"
    predict_variance: bool = False
    """Second output per parameter: the width of a Laplace distribution, trained by its likelihood. Without, one width
    per parameter is estimated from the validation samples."""
    draws: int | None = None
    """Number of training samples to use; None for all."""
    points: int = 3500
    """Points per frame."""
    augment: bool = True
    viewpoints: tuple[tuple[float, float, float], ...] = ()
    """Positions of the recording cameras in the scene. Clouds then have the faces whose centre at least one camera
    sees, for a cloth displaced by about a centimetre. Default: random faces, as in the paper."""
    patience: int | None = None
    """Stop after this many epochs without a better validation loss; None: never."""
    subtract_background: bool = False
    """Remove points closer than 1 cm to the scenario's obstacle (the pole, the hook), whose position is known.
    Otherwise most points may be the same in every cloud."""
    dropout: float | None = None
    """Dropout rate in the head; None for the model's default."""
    order: Order = "cloud"
    density: float = 1.0
    """Fraction of the published numbers of centroids and neighbours."""
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: a value is out of range.
        """
        for name in ("epochs", "batch_size", "points", "draws", "patience"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ConfigError(f"{name} must be at least 1, got {value}.")
        if self.batch_size < 2:
            raise ConfigError("batch_size must be at least 2: batch normalisation needs more than one sample.")
        if self.viewpoints and not self.augment:
            raise ConfigError("Clouds that cameras see are augmented: leave out either the viewpoints or augment: false.")
        if not 0 < self.density <= 1:
            raise ConfigError(f"density must be above 0 and at most 1, got {self.density}.")
        if self.dropout is not None and not 0 <= self.dropout < 1:
            raise ConfigError(f"dropout must be at least 0 and below 1, got {self.dropout}.")
        if self.learning_rate <= 0:
            raise ConfigError(f"learning_rate must be positive, got {self.learning_rate}.")


_PAPER = TrainingSettings()
_SHORT = replace(_PAPER, schedule="cosine", order="nearest", dropout=0.0, batch_size=16, subtract_background=True)
PROFILES: Mapping[Profile, Mapping[ModelName, TrainingSettings]] = {
    "quick": {
        "mlp": replace(_SHORT, points=128, epochs=16),
        "pointnet2": replace(_SHORT, points=96, epochs=10, density=0.125, batch_size=8),
        "meteornet": replace(_SHORT, points=16, epochs=12, density=0.125),
        "posterior": replace(_SHORT, points=24, epochs=48, density=0.125),
    },
    "reduced": {
        "mlp": replace(_SHORT, points=512, epochs=60),
        "pointnet2": replace(_SHORT, points=512, epochs=18, density=0.25),
        "meteornet": replace(_SHORT, points=64, epochs=30, density=0.25),
        "posterior": replace(_SHORT, points=64, epochs=30, density=0.25),
    },
    "paper": dict.fromkeys(MODEL_NAMES, _PAPER),
}
"""`quick`: seconds, for the built-in pipeline and a first test. `reduced`: within 20 minutes on one core for 1,500
samples. `paper`: the published settings, for a GPU."""


def profile_settings(profile: str, model: str, **changes: object) -> TrainingSettings:
    """Return a profile's settings, with the given values (not None) replaced.

    Raises:
        ConfigError: the profile or model is unknown, or a value is out of range.
    """
    if profile not in PROFILE_NAMES:
        raise ConfigError(unknown_name("profile", profile, PROFILE_NAMES))
    if model not in MODEL_NAMES:
        raise ConfigError(unknown_name("model", model, MODEL_NAMES))
    given = {name: value for name, value in changes.items() if value is not None}
    return replace(PROFILES[profile][model], **given)  # type: ignore[index,arg-type]  # names and values are checked
