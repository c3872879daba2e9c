"""Boxes: what many kernels share, passed as one pointer.

A kernel that is given a named tuple of fifty arrays gets their hundreds of numbers one by one, and compiling each
call takes a second. A box is a place in memory with named fields, which kernels read and write; only the fields that
a kernel names cost it anything. A module makes one in three lines:

    class RoomType(BoxType): ...
    class Room(Box): ...
    define(Room, RoomType, ["size", "pairs"])

`Room(size, pairs)` makes one inside a kernel. A field keeps the type that it was made with.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numba.core import types
from numba.experimental import structref

from diffcloud.compiled import UNCOMPILED

BoxType: Any = types.StructRef
"""Of the numba type that belongs to a box; its class must be a module's own, where the cache finds it."""


class _Plain:
    """A box without numba."""

    fields: Sequence[str] = ()

    def __init__(self, *values: object) -> None:
        for name, value in zip(self.fields, values, strict=True):
            setattr(self, name, value)


Box: Any = _Plain if UNCOMPILED else structref.StructRefProxy


def define(box: Any, kind: Any, fields: Sequence[str]) -> None:
    """Let kernels make boxes of a class, and read and write their fields."""
    if UNCOMPILED:
        box.fields = tuple(fields)
    else:
        structref.register(kind)
        structref.define_constructor(box, kind, list(fields))
