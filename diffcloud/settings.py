"""What sections of settings are made of: types with their limits, and the base of every section."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Field, ValidationError, model_validator

from diffcloud.errors import ConfigError
from diffcloud.io.schema import Checked, Component, Vector, explain

_MOST, _FACTOR = 10_000_000, 1e6
MOST_STARTS = 100
"""Of a fit. A start takes seconds to minutes."""
Count = Annotated[int, Field(ge=1, le=_MOST)]
CountOrNone = Annotated[int, Field(ge=0, le=_MOST)]
"""Zero: there is none, or it is left out."""
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Level = Annotated[float, Field(ge=0.01, le=0.999)]
"""A probability of intervals."""
Factor = Annotated[float, Field(gt=1, le=_FACTOR)]
"""Within which something is known."""
Name = Annotated[str, Field(max_length=1000)]
"""Of a thing, a file or a folder."""
Pixels = Annotated[int, Field(ge=1, le=10_000)]
Names = Annotated[list[Name], Field(min_length=1, max_length=10_000)]
Bounds = tuple[Component, Component]
Point = Vector


def check_bounds(name: str, bounds: Bounds) -> None:
    if not bounds[0] < bounds[1]:
        raise ValueError(f"{name} must be in order (low < high), got {list(bounds)}")


class Section(Checked):
    """One section of params.yaml. The text below a field is its help."""

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
    """The section with the options that were given (not None) in place.

    Raises:
        ConfigError: a value out of range.
    """
    given = {name: value for name, value in options.items() if value is not None}
    try:
        return type(section).model_validate({**section.model_dump(), **given})
    except ValidationError as error:
        raise explain("command line", error, ConfigError) from error
