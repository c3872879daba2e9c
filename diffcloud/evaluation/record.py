"""Data models of the files that `python -m pipeline.evaluate` writes, to check them before the report uses them."""

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
    """Loss and errors, one for each parameter with a known true value."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Value | None] = Field(init=False)

    loss: Value
    loss_deviation: Value
    rms_mm: Value
    two_sided: Value
    success: bool | None = None


class MethodRecord(_Metrics):
    """Result and metrics of one method."""

    method: Text
    values: dict[str, Value]
    clipped: dict[str, Value]
    inside: bool
    simulations: int | None
    gradients: bool
    intervals: dict[str, tuple[Value, Value]] | None = None
    """Intervals of a posterior, at the level of the fit's intervals."""


class TransferRecord(_Metrics):
    """Metrics of the parameters of another recording."""

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
    """Intervals as this version writes them, without missing fields."""

    level: Annotated[float, Field(gt=0, lt=1)]
    within: Annotated[float, Field(gt=1, le=1e6)]
    warning: Text
    note: Text


class ComparisonRecord(Checked):
    """Comparison on one episode."""

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
    """Content of tables/comparison.json."""

    records: list[ComparisonRecord]
    failures: list[Text]
    references: list[tuple[Text, Text, Value]]


class FitRow(Plain):
    """A row of tables/fits.csv. Its other columns are losses, distances, parameters and their true values."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, NonNegative] = Field(init=False)

    scenario: Text
    episode: Text
    loss: NonNegative
    rms_start_mm: NonNegative | None = None
    """None if the start diverges."""
    rms_mm: NonNegative


class PredictionRow(Plain):
    """A row of tables/predictions.csv. Its other columns are parameters and their true values."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, Value] = Field(init=False)

    scenario: Text
    episode: Text
    model: Text
    inside: bool
    loss: NonNegative
    rms_mm: NonNegative


def check_file(model: Any, path: Path, content: Any) -> None:
    """Check the content of a file against its data model.

    Args:
        model: model of the content; for a table, a list of its row model.

    Raises:
        ConfigError: the file was not written by this version's `python -m pipeline.evaluate`; names the field.
    """
    try:
        TypeAdapter(model).validate_python(content)
    except ValidationError as error:
        told = f"{path} was not written by this version's `python -m pipeline.evaluate`; run it. There"
        raise explain(told, error, ConfigError) from error
