"""How a regressor is trained: one settings block, and the named profiles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.regressors.grouping import Order
from diffcloud.regressors.networks import MODEL_NAMES, ModelName

Loss = Literal["normalised", "raw"]
"""L1 of parameters as fractions of their bounds, or in their own units as the paper has it."""
Target = Literal["linear", "logarithmic"]
"""What a network's output stands for: the fraction of the way between the bounds, or of their logarithms. The second
weighs errors by their ratio, and keeps predictions positive."""
Profile = Literal["quick", "reduced", "paper"]
PROFILE_NAMES: tuple[Profile, ...] = get_args(Profile)
BACKGROUND_REACH_M = 0.01
"""What is nearer to the obstacle counts as its [m]: more than a depth camera's noise, less than a fold."""


@dataclass(frozen=True)
class TrainingSettings:
    """Of one training; the defaults are the paper's."""

    epochs: int = 100
    batch_size: int = 32
    learning_rate: float = 1e-3
    schedule: Literal["constant", "cosine"] = "constant"
    """"cosine" lowers the learning rate to zero at the end, which short trainings need."""
    loss: Loss = "normalised"
    target: Target = "linear"
    predict_variance: bool = False
    """A second output per parameter: the width of a Laplace distribution, trained by its likelihood. Without, one width
    per parameter comes from the validation draws."""
    draws: int | None = None
    """Training draws used; None for all."""
    points: int = 3500
    """Per frame."""
    augment: bool = True
    viewpoints: tuple[tuple[float, float, float], ...] = ()
    """Of cameras that will record, in the scene: clouds show faces whose middle one of them sees, instead of random ones
    as in the paper, of a cloth that lies about a centimetre beside its place."""
    patience: int | None = None
    """Stop after so many epochs without a better validation; None: never."""
    subtract_background: bool = False
    """Leave out of the clouds what is nearer than 1 cm to the scenario's obstacle (the pole, the hook), whose place is
    known. Without, most points may show what is the same in every cloud."""
    dropout: float | None = None
    """In the head; None for the model's own."""
    order: Order = "cloud"
    density: float = 1.0
    """Fraction of the published numbers of centroids and neighbours."""
    seed: int = 0

    def __post_init__(self) -> None:
        """
        Raises:
            ConfigError: a value out of range.
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
"""`quick`: seconds, for the embedded pipeline and a first look. `reduced`: within 20 minutes of one core for 1,500
draws. `paper`: the published numbers; for a GPU."""


def profile_settings(profile: str, model: str, **changes: object) -> TrainingSettings:
    """A profile's settings with what was given (not None) in place.

    Raises:
        ConfigError: an unknown profile or model, or a value out of range.
    """
    if profile not in PROFILE_NAMES:
        raise ConfigError(unknown_name("profile", profile, PROFILE_NAMES))
    if model not in MODEL_NAMES:
        raise ConfigError(unknown_name("model", model, MODEL_NAMES))
    given = {name: value for name, value in changes.items() if value is not None}
    return replace(PROFILES[profile][model], **given)  # type: ignore[index,arg-type]  # names and values are checked
