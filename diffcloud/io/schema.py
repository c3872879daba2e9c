"""Common types of the pydantic schemas of all files: unknown fields and non-finite numbers are errors."""

from __future__ import annotations

from typing import Annotated, Any, cast

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, PydanticCustomError
from pydantic_core.core_schema import no_info_before_validator_function

from diffcloud.errors import DiffCloudError
from diffcloud.io.numbers import CORE, PLAIN

_MOST_FAULTS = 10
"""Largest number of errors in a message."""
_MOST = 1e11
"""Largest accepted quantity in SI units. Larger values would overflow in the simulation."""
_FARTHEST = 1e6
Component = Annotated[float, Field(ge=-_FARTHEST, le=_FARTHEST)]
Vector = tuple[Component, Component, Component]
Positive = Annotated[float, Field(gt=0, le=_MOST)]
NonNegative = Annotated[float, Field(ge=0, le=_MOST)]
Friction = Annotated[float, Field(ge=0, le=100)]
"""Coulomb friction coefficient [-]."""
FileName = Annotated[str, Field(max_length=250)]
"""No file system allows longer names."""


def _plain(schema: Any) -> Any:
    """Return a pydantic core schema with strict parsing of numbers and booleans (`_number`, `_truth`)."""
    if isinstance(schema, list | tuple):
        return type(schema)(map(_plain, schema))
    if not isinstance(schema, dict):
        return schema
    held = {name: _plain(part) if name != "metadata" else part for name, part in schema.items()}
    match held.get("type"):
        case "int" | "float":
            return no_info_before_validator_function(_number, cast(CoreSchema, held))
        case "bool":
            return no_info_before_validator_function(_truth, cast(CoreSchema, held))
    return held


def _number(value: object) -> object:
    if isinstance(value, bytes | bool) or (isinstance(value, str) and CORE.fullmatch(value) is None):
        raise PydanticCustomError("plain_number", f"Input should be a number. Allowed are {PLAIN}")
    return value


def _truth(value: object) -> object:
    if not isinstance(value, bool):
        raise PydanticCustomError("plain_bool", "Input should be true or false, without quotes")
    return value


class Plain(BaseModel):
    """Base of schemas in which numbers are plain decimals (quotes are allowed), and booleans are not numbers."""

    model_config = ConfigDict(allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return _plain(handler(source))


class Checked(Plain):
    """Base of immutable schemas without unknown fields."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def explain(source: object, error: ValidationError, kind: type[DiffCloudError]) -> DiffCloudError:
    """Convert a validation error to one message with path, value and rule for each invalid field."""
    faults = []
    for fault in error.errors()[:_MOST_FAULTS]:
        place = ".".join(str(part) for part in fault["loc"]) or "(the whole)"
        got = repr(fault["input"])
        shown = got if len(got) <= 60 else got[:57] + "..."
        if fault["type"] == "extra_forbidden":
            faults.append(f"{place}: unknown or unsupported field (value {shown})")
        else:
            faults.append(f"{place}: {fault['msg']} (got {shown})")
    return kind(f"{source}: " + "; ".join(faults) + ".")
