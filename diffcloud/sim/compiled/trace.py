"""Symbolic expressions: a force is written once as a formula. Its value, stiffness and derivatives are generated.

A formula is an ordinary Python function of `Scalar` and `Vector`. Calling it builds a graph, in which equal expressions are
one node. `compiled.derivatives` builds graphs of derivatives. `compiled.source` writes graphs as straight-line Python code,
which numba compiles.

Conditions are values (`where`), not branches: both sides are computed.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import overload

_COMMUTE = {"add", "mul", "eq", "and"}


@dataclass(eq=False)
class Graph:
    """All nodes of one or more formulas."""

    nodes: list[Scalar] = field(default_factory=list)
    _known: dict[tuple[object, ...], Scalar] = field(default_factory=dict)

    def node(self, operation: str, *operands: Scalar, payload: object = None) -> Scalar:
        """Return the node of an operation, and create it if it does not exist."""
        numbers = [operand.number for operand in operands]
        if operation in _COMMUTE:
            numbers.sort()
        key = (operation, *numbers, payload)
        found = self._known.get(key)
        if found is None:
            found = Scalar(self, len(self.nodes), operation, operands, payload)
            self.nodes.append(found)
            self._known[key] = found
        return found

    def constant(self, value: float) -> Scalar:
        return self.node("constant", payload=float(value))

    def input(self, name: str) -> Scalar:
        """An input of the code: the name of a variable, or of an array with its indices."""
        return self.node("input", payload=name)

    def vector(self, *names: str) -> Vector:
        return Vector(*(self.input(name) for name in names))


@dataclass(eq=False, frozen=True, repr=False)
class Scalar:
    """A number in a formula. Operators build the graph; comparisons give conditions for `where`."""

    graph: Graph
    number: int
    operation: str
    operands: tuple[Scalar, ...]
    payload: object = None

    def __bool__(self) -> bool:
        raise TypeError(
            "A formula is recorded before its numbers are known: `where` instead of `if`, `&` instead of `and`."
        )

    @property
    def value(self) -> float | None:
        """Value of a constant; None for other nodes."""
        return self.payload if self.operation == "constant" else None  # type: ignore[return-value]

    def of(self, other: Scalar | float) -> Scalar:
        """Convert a number to a node of this graph."""
        return other if isinstance(other, Scalar) else self.graph.constant(other)

    def __add__(self, other: Scalar | float) -> Scalar:
        return _add(self, self.of(other))

    def __radd__(self, other: float) -> Scalar:
        return _add(self.of(other), self)

    def __sub__(self, other: Scalar | float) -> Scalar:
        return _sub(self, self.of(other))

    def __rsub__(self, other: float) -> Scalar:
        return _sub(self.of(other), self)

    @overload
    def __mul__(self, other: Scalar | float) -> Scalar: ...
    @overload
    def __mul__(self, other: Vector) -> Vector: ...
    def __mul__(self, other: Scalar | float | Vector) -> Scalar | Vector:
        return other * self if isinstance(other, Vector) else _mul(self, self.of(other))

    def __rmul__(self, other: float) -> Scalar:
        return _mul(self.of(other), self)

    def __truediv__(self, other: Scalar | float) -> Scalar:
        return _div(self, self.of(other))

    def __rtruediv__(self, other: float) -> Scalar:
        return _div(self.of(other), self)

    def __neg__(self) -> Scalar:
        return _neg(self)

    def __lt__(self, other: Scalar | float) -> Scalar:
        return self.graph.node("lt", self, self.of(other))

    def __le__(self, other: Scalar | float) -> Scalar:
        return self.graph.node("le", self, self.of(other))

    def __gt__(self, other: Scalar | float) -> Scalar:
        return self.of(other) < self

    def __ge__(self, other: Scalar | float) -> Scalar:
        return self.of(other) <= self

    def equals(self, other: Scalar | float) -> Scalar:
        """Condition that two numbers are equal. (`==` compares nodes.)"""
        return self.graph.node("eq", self, self.of(other))

    def __and__(self, other: Scalar) -> Scalar:
        return self.graph.node("and", self, other)

    def __repr__(self) -> str:
        return f"<{self.operation} {self.number}>"


@dataclass(frozen=True)
class Vector:
    """Three numbers in a formula."""

    x: Scalar
    y: Scalar
    z: Scalar

    def __iter__(self) -> Iterable[Scalar]:
        return iter((self.x, self.y, self.z))

    def __getitem__(self, axis: int) -> Scalar:
        return (self.x, self.y, self.z)[axis]

    def __add__(self, other: Vector) -> Vector:
        return Vector(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vector) -> Vector:
        return Vector(self.x - other.x, self.y - other.y, self.z - other.z)

    def __mul__(self, factor: Scalar | float) -> Vector:
        return Vector(self.x * factor, self.y * factor, self.z * factor)

    __rmul__ = __mul__

    def __truediv__(self, divisor: Scalar | float) -> Vector:
        return self * (1.0 / divisor)

    def __neg__(self) -> Vector:
        return Vector(-self.x, -self.y, -self.z)


def dot(a: Vector, b: Vector) -> Scalar:
    """Dot product a · b."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vector, b: Vector) -> Vector:
    """Cross product a × b."""
    return Vector(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def total(parts: Iterable[Vector]) -> Vector:
    """Sum of one or more vectors."""
    first, *rest = parts
    for part in rest:
        first = first + part
    return first


def squareroot(a: Scalar) -> Scalar:
    return unary("sqrt", a)


def logarithm(a: Scalar) -> Scalar:
    return unary("log", a)


def floor(a: Scalar) -> Scalar:
    """Floor of a number, without derivative."""
    return unary("floor", a)


def absolute(a: Scalar) -> Scalar:
    return unary("abs", a)


def arctangent(sine: Scalar, cosine: Scalar) -> Scalar:
    """atan2(sine, cosine)."""
    return sine.graph.node("atan2", sine, cosine)


def sine(a: Scalar) -> Scalar:
    return unary("sin", a)


def cosine(a: Scalar) -> Scalar:
    return unary("cos", a)


def where(condition: Scalar, then: Scalar | float, otherwise: Scalar | float) -> Scalar:
    """`then` if the condition holds, otherwise `otherwise`."""
    a, b = condition.of(then), condition.of(otherwise)
    return a if a is b else condition.graph.node("where", condition, a, b)


def maximum(a: Scalar, low: Scalar | float) -> Scalar:
    """The larger of a number and a constant."""
    return where(a >= low, a, low)


def clamped(a: Scalar, low: float, high: float) -> Scalar:
    """A number limited to [low, high]."""
    return where(a < low, low, where(a > high, high, a))


def minimum(a: Scalar, b: Scalar) -> Scalar:
    """The smaller of two numbers."""
    return a.graph.node("min", a, b)


def larger(a: Scalar, b: Scalar) -> Scalar:
    """The larger of two numbers."""
    return -minimum(-a, -b)


def norm(a: Vector, tiny: float = 1e-30) -> Scalar:
    """|a|, with zero derivative at the origin instead of an infinite one."""
    return squareroot(maximum(dot(a, a), tiny))


def held(a: Scalar) -> Scalar:
    """The same number, treated as a constant in derivatives."""
    return a.graph.node("held", a)


def ordered(outputs: Iterable[Scalar]) -> list[Scalar]:
    """All nodes that the outputs need, each after its operands (in order of creation)."""
    seen: dict[int, Scalar] = {}
    todo = list(outputs)
    while todo:
        node = todo.pop()
        if node.number not in seen:
            seen[node.number] = node
            todo += node.operands
    return [seen[number] for number in sorted(seen)]


def _add(a: Scalar, b: Scalar) -> Scalar:
    if a.value is not None and b.value is not None:
        return a.graph.constant(a.value + b.value)
    if a.value == 0:
        return b
    if b.value == 0:
        return a
    if b.operation == "neg":
        return _sub(a, b.operands[0])
    if a.operation == "neg":
        return _sub(b, a.operands[0])
    return a.graph.node("add", a, b)


def _sub(a: Scalar, b: Scalar) -> Scalar:
    if a is b:
        return a.graph.constant(0.0)
    if a.value is not None and b.value is not None:
        return a.graph.constant(a.value - b.value)
    if b.value == 0:
        return a
    if a.value == 0:
        return _neg(b)
    if b.operation == "neg":
        return _add(a, b.operands[0])
    return a.graph.node("sub", a, b)


def _mul(a: Scalar, b: Scalar) -> Scalar:
    if a.value is not None:
        a, b = b, a  # a constant comes second
    if b.value is not None:
        if a.value is not None:
            return a.graph.constant(a.value * b.value)
        if b.value == 0:
            return b
        if b.value == 1:
            return a
        if b.value == -1:
            return _neg(a)
    if a.operation == "neg":
        return _neg(_mul(a.operands[0], b))
    if b.operation == "neg":
        return _neg(_mul(a, b.operands[0]))
    # The other factor is a derivative that is nonzero on one side of a condition only.
    if b.operation == "where" and {b.operands[1].value, b.operands[2].value} == {0.0, 1.0}:
        return where(b.operands[0], _mul(a, b.operands[1]), _mul(a, b.operands[2]))
    return a.graph.node("mul", a, b)


def _div(a: Scalar, b: Scalar) -> Scalar:
    if a.value == 0:
        return a
    if b.value is not None:
        return _mul(a, a.graph.constant(1 / b.value)) if _is_power_of_two(b.value) else a.graph.node("div", a, b)
    if a.operation == "neg":
        return _neg(_div(a.operands[0], b))
    return a.graph.node("div", a, b)


def _neg(a: Scalar) -> Scalar:
    if a.value is not None:
        return a.graph.constant(-a.value)
    if a.operation == "neg":
        return a.operands[0]
    if a.operation == "sub":
        return _sub(a.operands[1], a.operands[0])
    return a.graph.node("neg", a)


def unary(operation: str, a: Scalar) -> Scalar:
    return a.graph.node(operation, a)


def _is_power_of_two(value: float) -> bool:
    return value != 0 and math.frexp(value)[0] in (0.5, -0.5)
