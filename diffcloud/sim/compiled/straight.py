"""Compiles generated straight-line code to machine code without most of numba.

Numba's passes over tens of thousands of lines of arithmetic would take most of a minute, and are not needed for such code.

The code also runs as plain Python (`DIFFCLOUD_UNCOMPILED`). It consists of assignments to numbers, additions to array
elements, and loops. The results equal those of numba's own compilation bit for bit: the same operations in the same order.
The outer loop processes four elements at once, one per lane of the processor's vector unit. Results are written for one
element after the other. So an element must not read what another one writes.
"""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from itertools import groupby
from typing import Any, NamedTuple, TypeVar, cast

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from diffcloud.compiled import UNCOMPILED

F = TypeVar("F", bound=Callable[..., Any])

_LANES = 4
"""Elements processed at once. On processors with shorter vectors, LLVM splits them."""
_REAL = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_WHOLE = {ast.Add: "add", ast.FloorDiv: "sdiv", ast.Mod: "srem"}  # for indices, which are not negative
_COMPARE = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.Eq: "=="}
_OF_LLVM = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor"}
_OF_NUMBA = {name: getattr(math, name) for name in ("log", "sin", "cos", "atan2")}
_CALLED = {"len", "int", "min", *_OF_LLVM, *_OF_NUMBA}
_INTEGER, _DOUBLE = ir.IntType(64), ir.DoubleType()


def straight(function: F) -> F:
    """Compile a function of arrays, numbers and named tuples for use in kernels. Its code must have only the forms named
    above. Indices must not be negative; they do not count from the end."""
    if UNCOMPILED:
        return function
    names = list(inspect.signature(function).parameters)

    def typed(_context: Any, *given: Any) -> Any:
        def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            body = cast(ast.FunctionDef, ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]).body
            scope = dict(zip(names, zip(signature.args, values, strict=True), strict=True))
            _Emitter(context, builder, scope).statements(body)
            return context.get_dummy_value()

        return types.none(*given), emit

    # numba binds the arguments of an intrinsic by its signature
    typed.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in ("typingctx", *names)]
    )
    typed.__name__ = function.__name__
    return cast(F, intrinsic(typed))


class _Array(NamedTuple):
    """Components of an array."""

    kind: Any
    data: Any
    shape: list[Any]
    strides: list[Any]


class _Emitter:
    """Emits LLVM code for statements. A value is a pair of its numba type and its LLVM value, which is a number or a vector
    with one number per lane."""

    def __init__(self, context: Any, builder: Any, scope: dict[str, tuple[Any, Any]]) -> None:
        self.context, self.builder, self.scope = context, builder, scope
        self.arrays: dict[str, _Array] = {}
        """Arrays in use, by their source code."""
        self.filled: list[Any] = []
        """For each lane, whether it has an element. Empty outside the outer loop."""

    def statements(self, body: Sequence[ast.stmt]) -> None:
        for writes, group in groupby(body, _writes):
            if writes:
                self._write(list(group))
                continue
            for statement in group:
                match statement:
                    case ast.Assign(targets=[ast.Name(id=name)], value=value):
                        self.scope[name] = self.value(value)
                    case ast.For(target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"), args=[count])):
                        outside = dict(self.scope), dict(self.arrays)
                        self._loop(name, self.value(count)[1], statement.body)
                        self.scope, self.arrays = outside
                    case ast.Pass():
                        pass
                    case _:
                        raise NotImplementedError(f"Straight code has no {ast.unparse(statement)!r}.")

    def _loop(self, name: str, count: Any, body: Sequence[ast.stmt]) -> None:
        builder = self.builder
        if self.filled:
            with cgutils.for_range(builder, count) as loop:
                self.scope[name] = (types.intp, loop.index)
                self.statements(body)
            return
        with cgutils.for_range(builder, builder.sdiv(builder.add(count, _INTEGER(_LANES - 1)), _INTEGER(_LANES))) as loop:
            first = self._wide(builder.mul(loop.index, _INTEGER(_LANES)))
            places = builder.add(first, ir.Constant(first.type, list(range(_LANES))))
            within = builder.icmp_signed("<", places, self._wide(count))
            # Lanes beyond the last element compute it again, but write nothing.
            places = builder.select(within, places, self._wide(builder.sub(count, _INTEGER(1))))
            self.filled = [_lane(builder, within, lane) for lane in range(_LANES)]
            self.scope[name] = (types.intp, places)
            self.statements(body)
            self.filled = []

    def _write(self, body: Sequence[ast.stmt]) -> None:
        """Emit stores, and additions to array elements, for one lane after the other."""
        builder = self.builder
        writes = [(self._place(_target(one)), self._number(one.value), one) for one in body]  # type: ignore[attr-defined]
        for lane, filled in enumerate(self.filled or [None]):
            with builder.if_then(filled, likely=True) if lane > 0 else nullcontext():
                for place, number, statement in writes:
                    pointer, new = self._pointer(place, lane), _lane(builder, number, lane)
                    if isinstance(statement, ast.AugAssign):
                        new = builder.fadd(builder.load(pointer), new)
                    builder.store(new, pointer)

    def value(self, node: ast.expr) -> tuple[Any, Any]:
        builder = self.builder
        match node:
            case ast.Name(id=name):
                return self.scope[name]
            case ast.Constant(value=bool() | str()):
                pass
            case ast.Constant(value=int(value)):
                return types.intp, _INTEGER(value)
            case ast.Constant(value=float(value)):
                return types.float64, _DOUBLE(value)
            case ast.Attribute(value=owner, attr=name):
                kind, value = self.value(owner)
                place = kind.fields.index(name)
                return kind.types[place], builder.extract_value(value, place)
            case ast.Subscript():
                place = self._place(node)
                lanes = range(_LANES if any(map(_is_wide, place[1])) else 1)
                return place[0].kind.dtype, self._joined([builder.load(self._pointer(place, lane)) for lane in lanes])
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return types.float64, builder.fneg(self._number(operand))
            case ast.BinOp(op=ast.BitAnd(), left=left, right=right):
                a, b = self._alike(self.value(left)[1], self.value(right)[1])
                return types.boolean, builder.and_(a, b)
            case ast.BinOp(op=operator, left=left, right=right) if type(operator) in _REAL | _WHOLE:
                kind, a, b = self._both(left, right, whole=type(operator) in _WHOLE)
                names = _WHOLE if kind == types.intp else _REAL
                return kind, getattr(builder, names[type(operator)])(a, b)
            case ast.Compare(left=left, ops=[operator], comparators=[right]) if type(operator) in _COMPARE:
                kind, a, b = self._both(left, right, whole=True)
                compare = builder.icmp_signed if kind == types.intp else builder.fcmp_ordered
                return types.boolean, compare(_COMPARE[type(operator)], a, b)
            case ast.IfExp(test=test, body=then, orelse=otherwise):
                condition, a, b = self._alike(self.value(test)[1], self._number(then), self._number(otherwise))
                return types.float64, builder.select(condition, a, b)
            case ast.Call(func=ast.Name(id=name), args=arguments) if name in _CALLED:
                return self._call(name, arguments)
        raise NotImplementedError(f"Straight code has no {ast.unparse(node)!r}.")

    def _call(self, name: str, arguments: list[ast.expr]) -> tuple[Any, Any]:
        builder = self.builder
        if name == "len":
            kind, value = self.value(arguments[0])
            array = self.context.make_array(kind)(self.context, builder, value)
            return types.intp, builder.extract_value(array.shape, 0)
        numbers = self._alike(*(self._number(argument) for argument in arguments))
        kind = numbers[0].type
        if name == "int":
            return types.intp, builder.fptosi(numbers[0], ir.VectorType(_INTEGER, _LANES) if kind != _DOUBLE else _INTEGER)
        if name == "min":
            return types.float64, builder.select(builder.fcmp_ordered("<", numbers[1], numbers[0]), numbers[1], numbers[0])
        if name in _OF_LLVM:
            width = "f64" if kind == _DOUBLE else f"v{_LANES}f64"
            of = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(kind, [kind]), f"llvm.{_OF_LLVM[name]}.{width}"
            )
            return types.float64, builder.call(of, numbers)
        called = self.context.get_function(_OF_NUMBA[name], types.float64(*[types.float64] * len(numbers)))
        lanes = range(_LANES if kind != _DOUBLE else 1)
        return types.float64, self._joined([called(builder, [_lane(builder, n, lane) for n in numbers]) for lane in lanes])

    def _number(self, node: ast.expr) -> Any:
        """A value converted to double."""
        return self._real(*self.value(node))

    def _real(self, kind: Any, number: Any) -> Any:
        if kind == types.float64:
            return number
        return self.builder.sitofp(number, ir.VectorType(_DOUBLE, _LANES) if _is_wide(number) else _DOUBLE)

    def _both(self, left: ast.expr, right: ast.expr, *, whole: bool) -> tuple[Any, Any, Any]:
        """Two values of one type: integers if both are and the operation supports them, otherwise doubles."""
        a, b = self.value(left), self.value(right)
        if whole and a[0] == b[0] == types.intp:
            return types.intp, *self._alike(a[1], b[1])
        return types.float64, *self._alike(self._real(*a), self._real(*b))

    def _place(self, node: ast.Subscript) -> tuple[_Array, list[Any]]:
        """Array and indices of an array element."""
        indices = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
        name = ast.unparse(node.value)
        if name not in self.arrays:
            kind, value = self.value(node.value)
            array = self.context.make_array(kind)(self.context, self.builder, value)
            shape, strides = (cgutils.unpack_tuple(self.builder, one, kind.ndim) for one in (array.shape, array.strides))
            self.arrays[name] = _Array(kind, array.data, shape, strides)
        return self.arrays[name], [self.value(index)[1] for index in indices]

    def _pointer(self, place: tuple[_Array, list[Any]], lane: int) -> Any:
        """Pointer to the array element of one lane."""
        array, indices = place
        return cgutils.get_item_pointer2(
            self.context,
            self.builder,
            array.data,
            array.shape,
            array.strides,
            array.kind.layout,
            [_lane(self.builder, index, lane) for index in indices],
        )

    def _alike(self, *numbers: Any) -> list[Any]:
        """Convert all numbers to vectors if one of them is a vector."""
        return [self._wide(number) for number in numbers] if any(map(_is_wide, numbers)) else list(numbers)

    def _wide(self, number: Any) -> Any:
        """A number repeated in every lane."""
        return number if _is_wide(number) else self._joined([number] * _LANES)

    def _joined(self, numbers: Sequence[Any]) -> Any:
        """A vector with one number per lane. A single number is returned unchanged."""
        if len(numbers) == 1:
            return numbers[0]
        found = ir.Constant(ir.VectorType(numbers[0].type, _LANES), ir.Undefined)
        for lane, number in enumerate(numbers):
            found = self.builder.insert_element(found, number, ir.IntType(32)(lane))
        return found


def _writes(statement: ast.stmt) -> bool:
    match statement:
        case ast.Assign(targets=[ast.Subscript()]) | ast.AugAssign(target=ast.Subscript(), op=ast.Add()):
            return True
    return False


def _target(statement: ast.stmt) -> ast.Subscript:
    """Target of a statement that writes to an array."""
    return cast(ast.Subscript, statement.target if isinstance(statement, ast.AugAssign) else statement.targets[0])  # type: ignore[attr-defined]


def _is_wide(number: Any) -> bool:
    return isinstance(number.type, ir.VectorType)


def _lane(builder: Any, number: Any, lane: int) -> Any:
    return builder.extract_element(number, ir.IntType(32)(lane)) if _is_wide(number) else number
