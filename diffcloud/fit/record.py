"""What a fit's JSON holds, typed: one model from the fit through the comparison to the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from diffcloud.errors import ConfigError
from diffcloud.io.files import read_json

SCHEMA = 5
"""Of the file. Another one is refused, by name."""


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class NuisanceValue(_Model):
    """One variable of a recording's pose."""

    value: float
    prior: float
    """Standard deviation of its prior about zero."""
    unit: Literal["m", "rad", "s"]
    """Of both."""


class LeftOut(_Model):
    """What the other recordings of a joint fit say of one: fitted to them alone, measured on it."""

    loss: float
    rms_mm: float
    parameters: dict[str, float]


class RecordingFit(_Model):
    """One recording beside the motion fitted to it, in SI but for `loss` and `centre`."""

    name: str
    scenario: str
    loss: float
    """[squared length unit of the scenario]"""
    rms_mm: float
    rms_to_recording_mm: float
    """From cloth to recording."""
    rms_to_cloth_mm: float | None
    """From recording to cloth; the paper's measure does not look that way."""
    frames: list[int]
    """That were compared."""
    frame_rms_mm: list[float]
    """Of each."""
    counted: list[float]
    """Part of the simulated points that count, in each."""
    cut_m: float | None
    """Height below which nothing was recorded."""
    nuisance: dict[str, NuisanceValue]
    """How the recording lies."""
    centre: list[float]
    """[3] of the recording, about which the scene is turned [length unit]."""
    left_out: LeftOut | None = None
    """In a joint fit of several recordings."""


class FittedParameter(_Model):
    """One parameter, fitted or given, and what it means."""

    value: float
    unit: str
    """"x basis" of a multiplier."""
    physical: float
    physical_unit: str
    meaning: str
    fixed: bool = False
    bounds: tuple[float, float] | None = None
    """Of a fitted one."""
    prior: float | None = None
    """Factor of one deviation of its log-normal prior about the basis material; None: none."""
    at_bound: bool = False


class WholeMaterial(_Model):
    """All that the cloth was simulated with, fitted or not, in the scene's units, which are SI unless `length_unit_m` says
    otherwise; stiffness at rest."""

    density: float
    """[kg/m²] Mean over the cloth."""
    stretching: float
    """[N/m] Force per width per strain of a strip whose sides are free."""
    poisson: float
    shear: float
    """[N/m] Force per width per shear angle."""
    bending: float
    """[N·m] Bending stiffness per width."""
    damping: float
    """[s] Proportional to the stiffness."""
    friction_obstacle: float
    friction_cloth: float
    air_density: float
    """[kg/m³]"""


class Measure(_Model):
    """What recording and motion were compared by: keyword arguments of `Objective`."""

    paper: bool
    nuisance: dict[str, float]
    """Free variables of the pose -> standard deviation of the prior [m, rad, s]."""
    frames: list[int] | None
    """Asked for; None: the scenario's, or every usable one."""
    points: int | None
    """Asked for; None: the scenario's."""
    seed: int


class History(_Model):
    """N iterations of B starts; k parameters. What diverged is None."""

    names: list[str]
    """[k]"""
    loss: list[list[float | None]]
    """[N][B]"""
    values: list[list[list[float | None]]]
    """[N][B][k]"""
    gradient_norm: list[list[float | None]]
    """[N][B]; empty of a search."""


class FitRecord(_Model):
    """One fit."""

    schema_version: int = Field(default=SCHEMA, alias="schema")
    scenario: str
    """Of the first recording."""
    episodes: list[RecordingFit] = Field(min_length=1)
    nuisance: dict[str, NuisanceValue]
    """How the only recording lies; empty in a joint fit, where each episode has its own."""
    solver: str
    """Of `SOLVERS`."""
    parameters: dict[str, FittedParameter] = Field(min_length=1)
    material: WholeMaterial
    loss: float
    """[squared length unit, mean over points], by the fit's own random points, without priors; of a joint fit the geometric
    mean over its recordings, with `paper` the plain one."""
    loss_start: float
    """At `start`."""
    loss_resampled: float
    """Mean over fresh points, which the fit could not adapt to."""
    rms_mm: float
    length_unit_m: float
    iterations: int
    simulations: int
    """Runs of the simulator; one with derivatives counts once."""
    seconds: float
    stop_reason: Literal["converged", "rough", "iterations", "simulations", "threshold", "interrupted"]
    start: dict[str, float]
    """Parameters of the first start, the given ones too."""
    best_start: int
    measure: Measure
    settings: dict[str, float | int | bool | None]
    """Of the solver."""
    history: History
    failures: list[str]
    """Of starts that diverged."""
    versions: dict[str, str]
    fingerprint: str = ""
    """Of inputs and code, by which a later call knows a finished fit."""

    @property
    def values(self) -> dict[str, float]:
        """Parameter -> value, the given ones too."""
        return {name: parameter.value for name, parameter in self.parameters.items()}

    @property
    def fitted(self) -> dict[str, float]:
        """Parameter -> value, of those that were not given."""
        return {name: parameter.value for name, parameter in self.parameters.items() if not parameter.fixed}

    def plain(self) -> dict[str, Any]:
        """As the file has it."""
        return self.model_dump(mode="json", by_alias=True)


def read_fit(path: Path) -> FitRecord:
    """
    Raises:
        ConfigError: missing, damaged, not a fit, or one of another version.
    """
    told = read_json(path, error=ConfigError)
    if not isinstance(told, dict) or "parameters" not in told or "loss" not in told:
        raise ConfigError(f"{path} is not a fit written by `diffcloud fit`: it lacks `parameters` or `loss`.")
    if told.get("schema") != SCHEMA:
        raise ConfigError(
            f"{path} was written by another version (schema {told.get('schema')}, read here: {SCHEMA}); fit again."
        )
    try:
        return FitRecord.model_validate(told)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{path} is a damaged fit: {place}: {first['msg']}. Fit again.") from error
