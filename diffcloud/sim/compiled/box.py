"""Boxes: structures with named fields that kernels pass by pointer.

Numba passes a named tuple of fifty arrays as hundreds of separate arguments, and compiling each call takes a second. A box
is passed as one pointer. Kernels read and write its fields by name, and a kernel only pays for the fields that it uses. A
module defines a box in three lines:

    class RoomType(BoxType): ...
    class Room(Box): ...
    define(Room, RoomType, ["size", "pairs"])

`Room(size, pairs)` creates one inside a kernel. The type of a field cannot change afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numba.core import types
from numba.experimental import structref

from diffcloud.compiled import UNCOMPILED

BoxType: Any = types.StructRef
"""Base class of the numba type of a box. Its subclass must be defined in a module, where numba's cache can find it."""


class _Plain:
    """A box for runs without compilation."""

    fields: Sequence[str] = ()

    def __init__(self, *values: object) -> None:
        for name, value in zip(self.fields, values, strict=True):
            setattr(self, name, value)


Box: Any = _Plain if UNCOMPILED else structref.StructRefProxy


def define(box: Any, kind: Any, fields: Sequence[str]) -> None:
    """Register a box class, so that kernels can create boxes and access their fields."""
    if UNCOMPILED:
        box.fields = tuple(fields)
    else:
        structref.register(kind)
        structref.define_constructor(box, kind, list(fields))
