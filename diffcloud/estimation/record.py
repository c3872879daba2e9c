"""Data model of a fit's JSON file. The fit, the comparison of methods and the report all use it."""

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
"""Version of the file format. Files of other versions are rejected."""

LARGEST = 1e12
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
Value = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
"""Value of a variable. Initial-state variables may be negative."""
Count = Annotated[int, Field(ge=0, le=1_000_000_000)]
Text = Annotated[str, Field(max_length=1000)]
Friction = Annotated[float, Field(ge=0, le=100)]
Pose = Annotated[float, Field(ge=-1e3, le=1e3)]


class _Model(Plain):
    model_config = ConfigDict(extra="forbid")


class NuisanceValue(_Model):
    """Value and prior of one pose or initial-state variable of a recording."""

    value: Pose
    prior: Annotated[float, Field(gt=0, le=1e3)]
    """Standard deviation of the prior, which is centred on the stated clock offset for a lag, and else on zero."""
    unit: Literal["m", "rad", "s", "1"]
    """Unit of value and prior."""
    of: Literal["pose", "cloth"] = "pose"
    """`pose`: scene relative to the recording (`estimation.pose`). `cloth`: initial state
    (`estimation.initial_state`)."""


class LeftOut(_Model):
    """Leave-one-out result: parameters fitted to the other recordings, evaluated on this one."""

    loss: NonNegative
    rms_mm: NonNegative
    parameters: dict[str, NonNegative]


class RecordingFit(_Model):
    """Result for one recording, in SI units except for `loss` and `centre`."""

    name: Text
    scenario: Text
    loss: NonNegative
    """Loss of this recording [squared length unit of the scenario]."""
    rms_mm: NonNegative
    rms_to_recording_mm: NonNegative
    """RMS distance from the cloth to the recorded points."""
    rms_to_cloth_mm: NonNegative | None
    """RMS distance from the recorded points to the cloth; None with the loss of the paper."""
    grasp: Text = ""
    """Description of the grasp; empty if the scene holds fixed nodes."""
    frames: list[Count]
    """Numbers of the compared frames."""
    frame_rms_mm: list[NonNegative]
    """RMS distance in each compared frame."""
    counted: list[Annotated[float, Field(ge=0, le=1)]]
    """Fraction of the simulated points that were compared, in each frame."""
    cut_m: Pose | None
    """Height below which the recording was cropped [m]."""
    nuisance: dict[str, NuisanceValue]
    """Pose and initial-state variables."""
    centre: tuple[Pose, Pose, Pose]
    """[3] centre of the recording, about which the scene is rotated [length unit]."""
    clocks: dict[str, Pose] = Field(default_factory=lambda: {"lag": 0.0}, min_length=1)
    """Lag variable of each clock -> offset [s] that the recording states. Free ones are also in `nuisance`."""
    left_out: LeftOut | None = None
    """Leave-one-out result, in a joint fit."""

    @field_validator("nuisance")
    @classmethod
    def _lies_at_a_place(cls, told: dict[str, NuisanceValue]) -> dict[str, NuisanceValue]:
        if any(entry.of == "cloth" and entry.unit == "s" for entry in told.values()):
            raise ValueError("the unit of an initial-state variable must be m, rad or 1")
        return told

    @model_validator(mode="after")
    def _of_each_frame(self) -> Self:
        if not len(self.frames) == len(self.frame_rms_mm) == len(self.counted):
            raise ValueError("frames, frame_rms_mm and counted must be as long as each other")
        return self


class FittedParameter(_Model):
    """One fitted or fixed parameter."""

    value: NonNegative
    """Value in `unit`, which is SI if the scene is in SI units."""
    unit: Text
    meaning: Text
    nominal: NonNegative = 1.0
    """Value of the scene's own material, to which the multiplier refers; 1 if the parameter has no multiplier."""
    multiplier: NonNegative
    """Input of the simulator: value divided by `nominal`."""
    fixed: bool = False
    bounds: tuple[NonNegative, NonNegative] | None = None
    """Search range of a fitted parameter."""
    prior: Annotated[float, Field(gt=1, le=1e6)] | None = None
    """Standard deviation of the log-normal prior, as a factor; None: no prior."""
    centre: Positive | None = None
    """Centre of the prior of a fitted parameter, in `unit`."""
    role: Role = "requested"
    """All roles other than `requested` are nuisance parameters."""
    at_bound: bool = False


class WholeMaterial(_Model):
    """All material properties of the simulated cloth, fitted or not. Stiffness is that at rest. Values are in the
    scene's units, which are SI unless `length_unit_m` differs from 1."""

    density: Positive
    """[kg/m²] mean over the cloth."""
    stretching: Positive
    """[N/m] force per width per strain of a strip with free sides."""
    poisson: Annotated[float, Field(gt=-1, lt=1)]
    shear: Positive
    """[N/m] force per width per shear angle."""
    compression: Annotated[float, Field(ge=0, le=1)]
    """Fraction of the stretching stiffness that resists compression."""
    bending: NonNegative
    """[N·m] bending stiffness per width."""
    damping: NonNegative
    """[s] stiffness-proportional damping."""
    friction: Friction
    self_friction: Friction
    air_density: NonNegative
    """[kg/m³] density of the air."""
    added_mass: NonNegative
    """[kg/m²] mass of the air that moves with the cloth, mean over the cloth."""
    linear_drag: NonNegative
    """[kg/(m²·s)] drag of the air per area that is linear in speed."""


class Measure(_Model):
    """Keyword arguments of `Objective` for a recording that is new to the fit. `FitRecord.measured_by` returns those
    for a fitted recording."""

    paper: bool
    nuisance: dict[str, Annotated[float, Field(gt=0, le=1e3)]]
    """Free pose variables of the first recording -> standard deviation of the prior [m, rad, s]."""
    frames: list[int] | None
    """Requested frames; None: the scenario's, or all usable ones."""
    points: Annotated[int, Field(ge=1, le=10_000_000)] | None
    """Requested number of points; None: the scenario's."""
    seed: Annotated[int, Field(ge=0)]


class History(_Model):
    """History of N iterations, B starts and k variables. None stands for diverged values and values above `LARGEST`."""

    names: list[Text]
    """[k] names of the variables."""
    loss: list[list[NonNegative | None]]
    """[N][B] losses."""
    values: list[list[list[Value | None]]]
    """[N][B][k] values."""
    gradient_norm: list[list[NonNegative | None]]
    """[N][B]; empty for a search."""

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
    """Agreement of the model with one recording."""

    horizon_s: float
    """Frames after this time were not used [s]."""
    departs: bool = False
    """Whether the horizon is earlier because the simulation departs from the recording."""
    chi_squares: list[NonNegative]
    """Mean squared distance of each used frame, divided by the variance expected from noise, point spacing and mesh."""
    finer_mm: list[NonNegative]
    """RMS node displacement in each used frame when the mesh is refined to half the edge length."""


class EstimateRecord(_Model):
    """Estimate of the k requested parameters by the solver `likelihood`, in the fit coordinates (`residuals.Axis`)."""

    mean: dict[str, Value]
    """Mean over all starts, weighted by their likelihoods."""
    sources: dict[str, list[list[Annotated[float, Field(ge=-1e9, le=1e9)]]]]
    """Source of uncertainty -> its contribution to the covariance [k][k]."""
    starts: list[dict[str, Value]]
    """Result of each start, the most likely first."""
    weights: list[Annotated[float, Field(ge=0, le=1)]]
    """Weights of the starts."""
    recordings: list[Followed] = Field(min_length=1)
    grip_m: Annotated[float, Field(gt=0, le=10)] | None = None
    """Estimated size of the grasp, which the final simulation uses; None if it was known."""

    @model_validator(mode="after")
    def _has_one_shape(self) -> Self:
        count = len(self.mean)
        if any(len(rows) != count or any(len(row) != count for row in rows) for rows in self.sources.values()):
            raise ValueError("sources must hold [k][k] numbers for the k parameters of mean")
        if len(self.starts) != len(self.weights):
            raise ValueError("starts and weights must be as long as each other")
        return self


class FitRecord(_Model):
    """Complete record of one fit."""

    schema_version: int = Field(default=SCHEMA, alias="schema")
    scenario: Text
    """Scenario of the first recording."""
    episodes: list[RecordingFit] = Field(min_length=1)
    nuisance: dict[str, NuisanceValue]
    """Pose and initial state of the only recording. It is empty in a joint fit, where each episode has its own."""
    solver: Text
    """Key in `SOLVERS`."""
    parameters: dict[str, FittedParameter] = Field(min_length=1)
    material: WholeMaterial
    loss: NonNegative
    """[squared length unit, mean over points] without priors, at the fit's own sample points. In a joint fit it is the
    geometric mean over the recordings, with `paper` the arithmetic mean."""
    loss_start: NonNegative
    """Loss at `start`, with priors."""
    loss_resampled: NonNegative
    """Mean loss at newly sampled points, to which the fit could not adapt."""
    rms_mm: NonNegative
    length_unit_m: Annotated[float, Field(gt=0, le=1e3)]
    iterations: Count
    simulations: Annotated[int, Field(ge=1, le=1_000_000_000)]
    """Number of simulator runs. A run with derivatives counts once. Leave-one-out fits are not included."""
    seconds: NonNegative | None = Field(default=None, exclude=True)
    """Wall time, stored in a separate file (`io.timings`); None if unknown."""
    stop_reason: Literal["converged", "iterations", "simulations", "threshold", "interrupted"]
    start: dict[str, Value]
    """Values of the first start, including fixed parameters and the initial state, named as in `free`."""
    best_start: Annotated[int, Field(ge=0, le=1_000_000)]
    measure: Measure
    settings: dict[str, Annotated[int, Field(ge=0)] | bool | NonNegative | None]
    """Settings of the solver."""
    history: History
    estimate: EstimateRecord | None = None
    """Result of the solver `likelihood`; None for other solvers."""
    failures: list[str]
    """Messages of diverged starts."""
    fingerprint: Text = ""
    """Hash of inputs and code, by which a later call recognises a finished fit."""

    def initial_state_in(self, recording: RecordingFit | None) -> dict[str, float]:
        """Return the initial-state variables of a recording in simulator units (`estimation.initial_state`): name ->
        value.

        Args:
            recording: one of `episodes`. None: a new recording, for which only the shared variables are known.
        """
        unit = {"m": self.length_unit_m, "rad": 1.0, "1": 1.0}
        return {
            name: entry.value / unit[entry.unit]
            for name, entry in (recording or self.episodes[0]).nuisance.items()
            if entry.of == "cloth" and (recording is not None or name in SHARED)
        }

    def place_of(self, name: str, scenario: str | None = None) -> int:
        """Return the index of a recording in `episodes`.

        Args:
            scenario: scenario of the recording; needed if two recordings have the same name.

        Raises:
            ConfigError: no recording matches, or several do.
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
        """Return the same as `place_of`, or None if the fit has no recording of this name.

        Raises:
            ConfigError: several recordings match.
        """
        return self.place_of(name, scenario) if name in {one.name for one in self.episodes} else None

    def measured_by(self, recording: int) -> dict[str, Any]:
        """Return the keyword arguments of `Objective` for a fitted recording, with its own pose priors and frames.

        Args:
            recording: index in `episodes`.
        """
        one = self.episodes[recording]
        pose = {name: entry.prior for name, entry in one.nuisance.items() if entry.of == "pose"}
        return {**self.measure.model_dump(), "nuisance": pose, "frames": one.frames}

    @property
    def grasps(self) -> str:
        """Description of the grasps in all recordings; empty if only fixed nodes are held."""
        return "; ".join(dict.fromkeys(one.grasp for one in self.episodes if one.grasp))

    @property
    def values(self) -> dict[str, float]:
        """Parameter -> multiplier, including fixed parameters."""
        return {name: parameter.multiplier for name, parameter in self.parameters.items()}

    @property
    def fitted(self) -> dict[str, float]:
        """Requested parameter -> fitted multiplier."""
        return {name: one.multiplier for name, one in self.parameters.items() if not (one.fixed or one.role != "requested")}

    @property
    def free(self) -> dict[str, float]:
        """Name -> value of all fitted variables: requested, uncertain material and initial state."""
        material = {name: parameter.multiplier for name, parameter in self.parameters.items() if not parameter.fixed}
        return {**material, **self._initial_states}

    @property
    def simulated(self) -> dict[str, float]:
        """Name -> value of all variables in the simulation, named as in `free`."""
        return {**self.values, **self._initial_states}

    @property
    def _initial_states(self) -> dict[str, float]:
        return of_all([self.initial_state_in(one) for one in self.episodes])

    def plain(self) -> dict[str, Any]:
        """Return the content of the JSON file."""
        return self.model_dump(mode="json", by_alias=True)


def _is_record(told: Any) -> bool:
    return isinstance(told, dict) and "parameters" in told and "loss" in told


def is_fit(path: Path) -> bool:
    """Return whether a JSON file is a fit record, of any version.

    Raises:
        ConfigError: the file is missing or not JSON.
    """
    return _is_record(read_json(path, error=ConfigError))


def read_fit(path: Path) -> FitRecord:
    """Read a fit record.

    Raises:
        ConfigError: the file is missing or damaged, is not a fit, or has another version.
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
