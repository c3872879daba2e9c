"""What the models of all files share (pydantic): every field known, every number finite, and errors that name both."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from diffcloud.errors import DiffCloudError

_MOST_FAULTS = 10
"""That a message lists."""
_MOST = 1e11
"""More than any quantity of a cloth in SI units is; beyond it arithmetic overflows."""
_FARTHEST = 1e6
Component = Annotated[float, Field(ge=-_FARTHEST, le=_FARTHEST)]
Vector = tuple[Component, Component, Component]
Positive = Annotated[float, Field(gt=0, le=_MOST)]
NonNegative = Annotated[float, Field(ge=0, le=_MOST)]
FileName = Annotated[str, Field(max_length=250)]
"""Longer ones no file system has."""


class Checked(BaseModel):
    """A block of a file: frozen, every field known."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


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
