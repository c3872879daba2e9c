"""What `python -m pipeline.evaluate` leaves for the report, as files hold it: checked before anything is drawn from it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from diffcloud.errors import ConfigError
from diffcloud.evaluation.intervals import Intervals
from diffcloud.io.schema import Checked, NonNegative, Plain, explain

Value = Annotated[float, Field(ge=-1e12, le=1e12)]
Place = Annotated[float, Field(gt=0, le=1e12)]
Text = Annotated[str, Field(max_length=10_000)]


class _Metrics(Plain):
    """Loss and errors, one for each parameter that has a known truth."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Value | None] = Field(init=False)

    loss: Value
    loss_deviation: Value
    rms_mm: Value
    two_sided: Value
    success: bool | None = None


class MethodRecord(_Metrics):
    """What one method found, and how good it is."""

    method: Text
    values: dict[str, Value]
    clipped: dict[str, Value]
    inside: bool
    simulations: int | None
    gradients: bool
    intervals: dict[str, tuple[Value, Value]] | None = None
    """Of a posterior, at the level of the fit's."""


class TransferRecord(_Metrics):
    """Parameters of another recording."""

    source: Text
    clipped: dict[str, Value]


class GapRecord(Checked):
    """A method without a result."""

    method: Text
    reason: Text
    expected: bool


class LandscapeRecord(Checked):
    """Losses around a fit."""

    names: Annotated[list[Text], Field(min_length=2, max_length=2)]
    x: Annotated[list[NonNegative], Field(min_length=1)]
    y: Annotated[list[NonNegative], Field(min_length=1)]
    loss: list[list[Value | None]]
    paths: list[list[list[Value]]]
    fitted: list[Value]


class StatedIntervals(Intervals):
    """As this version writes them: no field may be missing."""

    level: Annotated[float, Field(gt=0, lt=1)]
    within: Annotated[float, Field(gt=1, le=1e6)]
    warning: Text
    note: Text


class ComparisonRecord(Checked):
    """One episode."""

    scenario: Text
    episode: Text
    fit: Text
    fabric: Text | None
    category: Text | None
    repeat: int | None
    source: Text | None
    category_assumed: bool
    truth: dict[str, Value]
    length_unit_m: Place
    threshold: Value | None
    frames: list[int]
    nuisance: list[Text]
    start: _Metrics | None
    methods: list[MethodRecord]
    gaps: list[GapRecord]
    failures: list[Text]
    transfers: list[TransferRecord]
    intervals: StatedIntervals | None
    landscape: LandscapeRecord | None


class ComparisonFile(Checked):
    """tables/comparison.json."""

    records: list[ComparisonRecord]
    failures: list[Text]
    references: list[tuple[Text, Text, Value]]


class FitRow(Plain):
    """A row of tables/fits.csv. Its other columns are losses, distances, parameters and their truth."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, NonNegative] = Field(init=False)

    scenario: Text
    episode: Text
    loss: NonNegative
    rms_start_mm: NonNegative | None = None
    """None where the start diverges."""
    rms_mm: NonNegative


class PredictionRow(Plain):
    """A row of tables/predictions.csv. Its other columns are parameters and their truth."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Value] = Field(init=False)

    scenario: Text
    episode: Text
    model: Text
    inside: bool
    loss: NonNegative
    rms_mm: NonNegative


def check_file(model: Any, path: Path, content: Any) -> None:
    """
    Args:
        model: of the content; of a table, a list of the model of its rows.

    Raises:
        ConfigError: a file is not as this version's `python -m pipeline.evaluate` writes it; names the field.
    """
    try:
        TypeAdapter(model).validate_python(content)
    except ValidationError as error:
        told = f"{path} was not written by this version's `python -m pipeline.evaluate`; run it. There"
        raise explain(told, error, ConfigError) from error
