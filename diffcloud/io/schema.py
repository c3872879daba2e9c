"""What the models of all files share (pydantic): every field known, every number finite, and errors that name both."""

from __future__ import annotations

from typing import Annotated, Any, cast

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationError
from pydantic_core import CoreSchema, PydanticCustomError
from pydantic_core.core_schema import no_info_before_validator_function

from diffcloud.errors import DiffCloudError
from diffcloud.io.numbers import CORE, PLAIN

_MOST_FAULTS = 10
"""That a message lists."""
_MOST = 1e11
"""More than any quantity of a cloth in SI units is; beyond it arithmetic overflows."""
_FARTHEST = 1e6
Component = Annotated[float, Field(ge=-_FARTHEST, le=_FARTHEST)]
Vector = tuple[Component, Component, Component]
Positive = Annotated[float, Field(gt=0, le=_MOST)]
NonNegative = Annotated[float, Field(ge=0, le=_MOST)]
Friction = Annotated[float, Field(ge=0, le=100)]
"""A Coulomb coefficient [-]."""
FileName = Annotated[str, Field(max_length=250)]
"""Longer ones no file system has."""


def _plain(schema: Any) -> Any:
    """A schema of pydantic whose numbers and truth values are plain."""
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
    """A block of a file whose numbers are plain decimals, also in quotes; a truth value is no number, nor the reverse."""

    model_config = ConfigDict(allow_inf_nan=False)

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return _plain(handler(source))


class Checked(Plain):
    """A block of a file: frozen, every field known."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def explain(source: object, error: ValidationError, kind: type[DiffCloudError]) -> DiffCloudError:
    """A validation error in one message: each field with its path, what came, and what is allowed."""
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
