"""What a fit's JSON holds, typed: one model from the fit through the comparison to the report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import ConfigDict, Field, ValidationError, field_validator, model_validator

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.estimation.names import SHARED, of_all
from diffcloud.estimation.parameters import Role
from diffcloud.io.files import read_json
from diffcloud.io.schema import Plain
from diffcloud.io.timings import read_seconds

SCHEMA = 13
"""Of the file. Another one is refused, by name."""

LARGEST = 1e12
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
Value = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
"""Of a variable; those of how a cloth lies may be negative."""
Count = Annotated[int, Field(ge=0, le=1_000_000_000)]
Text = Annotated[str, Field(max_length=1000)]
Friction = Annotated[float, Field(ge=0, le=100)]
Pose = Annotated[float, Field(ge=-1e3, le=1e3)]


class _Model(Plain):
    model_config = ConfigDict(extra="forbid")


class NuisanceValue(_Model):
    """One variable of how a recording lies."""

    value: Pose
    prior: Annotated[float, Field(gt=0, le=1e3)]
    """Standard deviation of its prior, about the offset of a clock (`RecordingFit.clocks`), or about zero."""
    unit: Literal["m", "rad", "s", "1"]
    """Of both."""
    of: Literal["pose", "cloth"] = "pose"
    """Of the scene against the recording (`estimation.pose`), or of the cloth when its motion begins
    (`estimation.initial_state`)."""


class LeftOut(_Model):
    """What the other recordings of a joint fit say of one: fitted to them alone, measured on it."""

    loss: NonNegative
    rms_mm: NonNegative
    parameters: dict[str, NonNegative]


class RecordingFit(_Model):
    """One recording beside the motion fitted to it, in SI but for `loss` and `centre`."""

    name: Text
    scenario: Text
    loss: NonNegative
    """[squared length unit of the scenario]"""
    rms_mm: NonNegative
    rms_to_recording_mm: NonNegative
    """From cloth to recording."""
    rms_to_cloth_mm: NonNegative | None
    """From recording to cloth; the paper's measure does not look that way."""
    grasp: Text = ""
    """What holds the cloth; empty where it is nodes."""
    frames: list[Count]
    """That were compared."""
    frame_rms_mm: list[NonNegative]
    """Of each."""
    counted: list[Annotated[float, Field(ge=0, le=1)]]
    """Part of the simulated points that count, in each."""
    cut_m: Pose | None
    """Height below which nothing was recorded."""
    nuisance: dict[str, NuisanceValue]
    """How the recording lies."""
    centre: tuple[Pose, Pose, Pose]
    """[3] of the recording, about which the scene is turned [length unit]."""
    clocks: dict[str, Pose] = Field(default_factory=lambda: {"lag": 0.0}, min_length=1)
    """Variable of the lag of each clock, in `nuisance` where it is free -> offset [s] that the recording states."""
    left_out: LeftOut | None = None
    """In a joint fit of several recordings."""

    @field_validator("nuisance")
    @classmethod
    def _lies_at_a_place(cls, told: dict[str, NuisanceValue]) -> dict[str, NuisanceValue]:
        if any(entry.of == "cloth" and entry.unit == "s" for entry in told.values()):
            raise ValueError("how a cloth lies is in m, rad or 1")
        return told

    @model_validator(mode="after")
    def _of_each_frame(self) -> Self:
        if not len(self.frames) == len(self.frame_rms_mm) == len(self.counted):
            raise ValueError("frames, frame_rms_mm and counted must be as long as each other")
        return self


class FittedParameter(_Model):
    """One parameter, fitted or given, and what it means."""

    value: NonNegative
    """In `unit`, which is SI if the scene is."""
    unit: Text
    meaning: Text
    nominal: NonNegative = 1.0
    """Value of the scene's own material, on which the simulator's multiplier acts; 1 where there is no multiplier."""
    multiplier: NonNegative
    """What the simulator takes: the value over `nominal`."""
    fixed: bool = False
    bounds: tuple[NonNegative, NonNegative] | None = None
    """Of a fitted one."""
    prior: Annotated[float, Field(gt=1, le=1e6)] | None = None
    """Factor of one deviation of its log-normal prior; None: none."""
    centre: Positive | None = None
    """Of the prior of a fitted one, in `unit`."""
    role: Role = "requested"
    """Other than requested: a nuisance, fitted because it is not known exactly."""
    at_bound: bool = False


class WholeMaterial(_Model):
    """All that the cloth was simulated with, fitted or not, in the scene's units, which are SI unless `length_unit_m` says
    otherwise; stiffness at rest."""

    density: Positive
    """[kg/m²] Mean over the cloth."""
    stretching: Positive
    """[N/m] Force per width per strain of a strip whose sides are free."""
    poisson: Annotated[float, Field(gt=-1, lt=1)]
    shear: Positive
    """[N/m] Force per width per shear angle."""
    compression: Annotated[float, Field(ge=0, le=1)]
    """Part of the stretching stiffness that resists compression."""
    bending: NonNegative
    """[N·m] Bending stiffness per width."""
    damping: NonNegative
    """[s] Proportional to the stiffness."""
    friction: Friction
    self_friction: Friction
    air_density: NonNegative
    """[kg/m³]"""
    added_mass: NonNegative
    """[kg/m²] Of the air that moves with the cloth, mean over the cloth."""
    linear_drag: NonNegative
    """[kg/(m²·s)]"""


class Measure(_Model):
    """What recording and motion are compared by: keyword arguments of `Objective`, for a recording that is new to the fit;
    `FitRecord.measured_by` has those for one that it knows."""

    paper: bool
    nuisance: dict[str, Annotated[float, Field(gt=0, le=1e3)]]
    """Free variables of the pose -> standard deviation of the prior [m, rad, s]; of the first recording."""
    frames: list[int] | None
    """Requested; None: the scenario's, or every usable one."""
    points: Annotated[int, Field(ge=1, le=10_000_000)] | None
    """Requested; None: the scenario's."""
    seed: Annotated[int, Field(ge=0)]


class History(_Model):
    """N iterations of B starts; k parameters. What diverged, or grew beyond `LARGEST`, is None."""

    names: list[Text]
    """[k]"""
    loss: list[list[NonNegative | None]]
    """[N][B]"""
    values: list[list[list[Value | None]]]
    """[N][B][k]"""
    gradient_norm: list[list[NonNegative | None]]
    """[N][B]; empty of a search."""

    @model_validator(mode="after")
    def _has_one_shape(self) -> Self:
        starts = [len(row) for row in self.loss]
        if self.values and [len(row) for row in self.values] != starts:
            raise ValueError("values must be [N][B][k] for loss [N][B], or empty")
        if any(len(start) != len(self.names) for row in self.values for start in row):
            raise ValueError("values must hold one number for each of the names")
        if self.gradient_norm and [len(row) for row in self.gradient_norm] != starts:
            raise ValueError("gradient_norm must be [N][B] as loss is, or empty")
        return self


class Followed(_Model):
    """How far the model follows one recording."""

    horizon_s: float
    """Frames after it did not count [s]."""
    chi_squares: list[NonNegative]
    """Of each frame that counted, its mean squared distance over what noise, spacing and mesh account for."""
    finer_mm: list[NonNegative]
    """By how much a mesh of half the edge length moves the cloth in each, RMS over the nodes."""


class EstimateRecord(_Model):
    """What the solver `likelihood` says of the requested parameters, on the axis of the fit; k of them."""

    mean: dict[str, Value]
    """Of all answers, by their likelihoods."""
    sources: dict[str, list[list[Annotated[float, Field(ge=-1e9, le=1e9)]]]]
    """Source -> its part of the covariance [k][k]."""
    starts: list[dict[str, Value]]
    """Where each start ended, the likeliest first."""
    weights: list[Annotated[float, Field(ge=0, le=1)]]
    """Of these."""
    recordings: list[Followed] = Field(min_length=1)
    grip_m: Annotated[float, Field(gt=0, le=10)] | None = None
    """Size of the grasp that was found, with which the fit is simulated; None where it was known."""

    @model_validator(mode="after")
    def _has_one_shape(self) -> Self:
        count = len(self.mean)
        if any(len(rows) != count or any(len(row) != count for row in rows) for rows in self.sources.values()):
            raise ValueError("sources must hold [k][k] numbers for the k parameters of mean")
        if len(self.starts) != len(self.weights):
            raise ValueError("starts and weights must be as long as each other")
        return self


class FitRecord(_Model):
    """One fit."""

    schema_version: int = Field(default=SCHEMA, alias="schema")
    scenario: Text
    """Of the first recording."""
    episodes: list[RecordingFit] = Field(min_length=1)
    nuisance: dict[str, NuisanceValue]
    """How the only recording lies; empty in a joint fit, where each episode has its own."""
    solver: Text
    """Of `SOLVERS`."""
    parameters: dict[str, FittedParameter] = Field(min_length=1)
    material: WholeMaterial
    loss: NonNegative
    """[squared length unit, mean over points], by the fit's own random points, without priors; of a joint fit the geometric
    mean over its recordings, with `paper` the plain one."""
    loss_start: NonNegative
    """At `start`, with priors."""
    loss_resampled: NonNegative
    """Mean over fresh points, which the fit could not adapt to."""
    rms_mm: NonNegative
    length_unit_m: Annotated[float, Field(gt=0, le=1e3)]
    iterations: Count
    simulations: Annotated[int, Field(ge=1, le=1_000_000_000)]
    """Runs of the simulator; one with derivatives counts once. Those of fits that leave a recording out do not."""
    seconds: NonNegative | None = Field(default=None, exclude=True)
    """Wall time, which lies beside the file (`io.timings`); None where it is not known."""
    stop_reason: Literal["converged", "iterations", "simulations", "threshold", "interrupted"]
    start: dict[str, Value]
    """Parameters of the first start, the given ones too, and how the cloth lies, named as in `free`."""
    best_start: Annotated[int, Field(ge=0, le=1_000_000)]
    measure: Measure
    settings: dict[str, Annotated[int, Field(ge=0)] | bool | NonNegative | None]
    """Of the solver."""
    history: History
    estimate: EstimateRecord | None = None
    """Of the solver `likelihood`."""
    failures: list[str]
    """Of starts that diverged."""
    fingerprint: Text = ""
    """Of inputs and code, by which a later call knows a finished fit."""

    def initial_state_in(self, recording: RecordingFit | None) -> dict[str, float]:
        """Name -> value, of how the cloth lies when a recording's motion begins, as the simulator takes it
        (`estimation.initial_state`).

        Args:
            recording: one of `episodes`; None: one that is new to the fit, of which is known what all share.
        """
        unit = {"m": self.length_unit_m, "rad": 1.0, "1": 1.0}
        return {
            name: entry.value / unit[entry.unit]
            for name, entry in (recording or self.episodes[0]).nuisance.items()
            if entry.of == "cloth" and (recording is not None or name in SHARED)
        }

    def place_of(self, name: str, scenario: str | None = None) -> int:
        """Of a recording in `episodes`.

        Args:
            scenario: that the fit simulates it in; needed where it has two recordings of this name.

        Raises:
            ConfigError: none, or several.
        """
        if name not in {one.name for one in self.episodes}:
            raise ConfigError(unknown_name("recording of the fit", name, {one.name for one in self.episodes}))
        found = {one.scenario: place for place, one in enumerate(self.episodes) if one.name == name}
        if scenario in found:
            return found[scenario]
        if len(found) > 1:
            raise ConfigError(
                f"The fit knows {name} in {' and '.join(sorted(found))}; rename one of these recordings and fit again."
            )
        return next(iter(found.values()))

    def known_place(self, name: str, scenario: str | None = None) -> int | None:
        """As `place_of`; None where the fit knows no recording of this name.

        Raises:
            ConfigError: several.
        """
        return self.place_of(name, scenario) if name in {one.name for one in self.episodes} else None

    def measured_by(self, recording: int) -> dict[str, Any]:
        """Keyword arguments of `Objective` with which a recording was compared, with its own pose and frames.

        Args:
            recording: its place in `episodes`.
        """
        one = self.episodes[recording]
        pose = {name: entry.prior for name, entry in one.nuisance.items() if entry.of == "pose"}
        return {**self.measure.model_dump(), "nuisance": pose, "frames": one.frames}

    @property
    def grasps(self) -> str:
        """What holds the cloth in its recordings, for people; empty where nodes are held as they are."""
        return "; ".join(dict.fromkeys(one.grasp for one in self.episodes if one.grasp))

    @property
    def values(self) -> dict[str, float]:
        """Parameter -> multiplier, the given ones too."""
        return {name: parameter.multiplier for name, parameter in self.parameters.items()}

    @property
    def fitted(self) -> dict[str, float]:
        """Requested parameter -> multiplier."""
        return {name: one.multiplier for name, one in self.parameters.items() if not (one.fixed or one.role != "requested")}

    @property
    def free(self) -> dict[str, float]:
        """Name -> value, of all that was fitted: requested, uncertain material, and of how the cloth lies."""
        material = {name: parameter.multiplier for name, parameter in self.parameters.items() if not parameter.fixed}
        return {**material, **self._initial_states}

    @property
    def simulated(self) -> dict[str, float]:
        """Name -> value, of all that the fitted motions were simulated with, named as in `free`."""
        return {**self.values, **self._initial_states}

    @property
    def _initial_states(self) -> dict[str, float]:
        return of_all([self.initial_state_in(one) for one in self.episodes])

    def plain(self) -> dict[str, Any]:
        """As the file has it."""
        return self.model_dump(mode="json", by_alias=True)


def _is_record(told: Any) -> bool:
    return isinstance(told, dict) and "parameters" in told and "loss" in told


def is_fit(path: Path) -> bool:
    """Whether a JSON file holds a fit, of whatever version.

    Raises:
        ConfigError: missing, or no JSON.
    """
    return _is_record(read_json(path, error=ConfigError))


def read_fit(path: Path) -> FitRecord:
    """
    Raises:
        ConfigError: missing, damaged, not a fit, or one of another version.
    """
    told = read_json(path, error=ConfigError)
    if not _is_record(told):
        raise ConfigError(f"{path} is not a fit written by `diffcloud fit`: it lacks `parameters` or `loss`.")
    if told.get("schema") != SCHEMA:
        raise ConfigError(
            f"{path} was written by another version (schema {told.get('schema')}, read here: {SCHEMA}); fit again."
        )
    try:
        return FitRecord.model_validate({**told, "seconds": read_seconds(path)})
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{path} is a damaged fit: {place}: {first['msg']}. Fit again.") from error
