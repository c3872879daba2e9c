"""Building blocks of settings: types with limits, and the base class of all sections."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Field, ValidationError, model_validator

from diffcloud.errors import ConfigError
from diffcloud.io.schema import Checked, Component, Vector, explain

_MOST, _FACTOR = 10_000_000, 1e6
MOST_STARTS = 100
"""Largest number of starts of a fit. A start takes seconds to minutes."""
Count = Annotated[int, Field(ge=1, le=_MOST)]
CountOrNone = Annotated[int, Field(ge=0, le=_MOST)]
"""A number of items. 0: none, or the step is skipped."""
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Level = Annotated[float, Field(ge=0.01, le=0.999)]
"""Probability of an interval."""
Factor = Annotated[float, Field(gt=1, le=_FACTOR)]
"""Standard deviation as a factor: a value is known within this factor."""
Name = Annotated[str, Field(max_length=1000)]
"""Name of an object, file or folder."""
Pixels = Annotated[int, Field(ge=1, le=10_000)]
Names = Annotated[list[Name], Field(min_length=1, max_length=10_000)]
Bounds = tuple[Component, Component]
Point = Vector


def check_bounds(name: str, bounds: Bounds) -> None:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"{name} must be in order (low < high), got {list(bounds)}")


class Section(Checked):
    """Base of the sections of params.yaml. The docstring of a field is its help text."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _decides_results(cls, data: Any) -> Any:
        for name in ("workers", "loaders"):
            if isinstance(data, dict) and name in data:
                raise ValueError(f"{name}: now only the option --{name}, since it does not change results; remove the key")
        return data


S = TypeVar("S", bound=Section)


def updated(section: S, **options: object) -> S:
    """Return the section with the given options. Options that are None keep their value.

    Raises:
        ConfigError: a value is out of range.
    """
    given = {name: value for name, value in options.items() if value is not None}
    try:
        return type(section).model_validate({**section.model_dump(), **given})
    except ValidationError as error:
        raise explain("command line", error, ConfigError) from error
