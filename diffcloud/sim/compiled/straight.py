"""Generated code to machine code, past most of numba: its passes over tens of thousands of lines of straight-line
arithmetic take most of a minute, and none of them is needed.

The code is Python that also runs as Python (`DIFFCLOUD_UNCOMPILED`), of assignments to numbers, additions to array
elements, and loops. It computes what numba's own compilation of it would, bit for bit: the same operations in the same
order.
"""

from __future__ import annotations

import ast
import inspect
import math
import textwrap
from collections.abc import Callable
from typing import Any, TypeVar, cast

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from diffcloud.compiled import UNCOMPILED

F = TypeVar("F", bound=Callable[..., Any])

_REAL = {ast.Add: "fadd", ast.Sub: "fsub", ast.Mult: "fmul", ast.Div: "fdiv"}
_WHOLE = {ast.Add: "add", ast.FloorDiv: "sdiv", ast.Mod: "srem"}  # of indices, which are not negative
_COMPARE = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.Eq: "=="}
_MATH = {name: getattr(math, name) for name in ("sqrt", "log", "sin", "cos", "floor", "atan2")}
_CALLED = {"len", "int", "abs", "min", *_MATH}


def straight(function: F) -> F:
    """A function for kernels to call, of arrays, numbers and named tuples of both, whose code keeps to the few forms above.

    Indices are not negative: they do not count from the end.
    """
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


class _Emitter:
    """Emits statements with a builder. A value is its numba type and its LLVM value."""

    def __init__(self, context: Any, builder: Any, scope: dict[str, tuple[Any, Any]]) -> None:
        self.context, self.builder, self.scope = context, builder, scope

    def statements(self, body: list[ast.stmt]) -> None:
        for statement in body:
            match statement:
                case ast.Assign(targets=[ast.Name(id=name)], value=value):
                    self.scope[name] = self.value(value)
                case ast.Assign(targets=[ast.Subscript() as place], value=value):
                    self.builder.store(self._number(value), self._pointer(place)[1])
                case ast.AugAssign(target=ast.Subscript() as place, op=ast.Add(), value=value):
                    pointer = self._pointer(place)[1]
                    self.builder.store(self.builder.fadd(self.builder.load(pointer), self._number(value)), pointer)
                case ast.For(target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"), args=[count])):
                    with cgutils.for_range(self.builder, self.value(count)[1]) as loop:
                        outside = dict(self.scope)
                        self.scope[name] = (types.intp, loop.index)
                        self.statements(statement.body)
                        self.scope = outside
                case ast.Pass():
                    pass
                case _:
                    raise NotImplementedError(f"Straight code has no {ast.unparse(statement)!r}.")

    def value(self, node: ast.expr) -> tuple[Any, Any]:
        builder = self.builder
        match node:
            case ast.Name(id=name):
                return self.scope[name]
            case ast.Constant(value=bool() | str()):
                pass
            case ast.Constant(value=int(value)):
                return types.intp, self.context.get_constant(types.intp, value)
            case ast.Constant(value=float(value)):
                return types.float64, self.context.get_constant(types.float64, value)
            case ast.Attribute(value=owner, attr=name):
                kind, value = self.value(owner)
                place = kind.fields.index(name)
                return kind.types[place], builder.extract_value(value, place)
            case ast.Subscript():
                kind, pointer = self._pointer(node)
                return kind.dtype, builder.load(pointer)
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return types.float64, builder.fneg(self._number(operand))
            case ast.BinOp(op=ast.BitAnd(), left=left, right=right):
                return types.boolean, builder.and_(self.value(left)[1], self.value(right)[1])
            case ast.BinOp(op=operator, left=left, right=right) if type(operator) in _REAL | _WHOLE:
                a, b = self.value(left), self.value(right)
                if a[0] == b[0] == types.intp and type(operator) in _WHOLE:
                    return types.intp, getattr(builder, _WHOLE[type(operator)])(a[1], b[1])
                return types.float64, getattr(builder, _REAL[type(operator)])(self._real(a), self._real(b))
            case ast.Compare(left=left, ops=[operator], comparators=[right]) if type(operator) in _COMPARE:
                a, b = self.value(left), self.value(right)
                sign = _COMPARE[type(operator)]
                if a[0] == b[0] == types.intp:
                    return types.boolean, builder.icmp_signed(sign, a[1], b[1])
                return types.boolean, builder.fcmp_ordered(sign, self._real(a), self._real(b))
            case ast.IfExp(test=test, body=then, orelse=otherwise):
                condition = self.value(test)[1]
                return types.float64, builder.select(condition, self._number(then), self._number(otherwise))
            case ast.Call(func=ast.Name(id=name), args=arguments) if name in _CALLED:
                return self._call(name, arguments)
        raise NotImplementedError(f"Straight code has no {ast.unparse(node)!r}.")

    def _call(self, name: str, arguments: list[ast.expr]) -> tuple[Any, Any]:
        builder = self.builder
        if name == "len":
            kind, value = self.value(arguments[0])
            array = self.context.make_array(kind)(self.context, builder, value)
            return types.intp, builder.extract_value(array.shape, 0)
        numbers = [self._number(argument) for argument in arguments]
        if name == "int":
            return types.intp, builder.fptosi(numbers[0], ir.IntType(64))
        if name == "abs":
            return types.float64, builder.call(builder.module.declare_intrinsic("llvm.fabs", [ir.DoubleType()]), numbers)
        if name == "min":
            return types.float64, builder.select(builder.fcmp_ordered("<", numbers[1], numbers[0]), numbers[1], numbers[0])
        given = [types.float64] * len(numbers)
        returned = types.intp if name == "floor" else types.float64
        called = self.context.get_function(_MATH[name], returned(*given))
        return returned, called(builder, numbers)

    def _number(self, node: ast.expr) -> Any:
        return self._real(self.value(node))

    def _real(self, value: tuple[Any, Any]) -> Any:
        kind, number = value
        return number if kind == types.float64 else self.context.cast(self.builder, number, kind, types.float64)

    def _pointer(self, place: ast.Subscript) -> tuple[Any, Any]:
        """An array's type, and where one of its elements lies."""
        kind, value = self.value(place.value)
        indices = place.slice.elts if isinstance(place.slice, ast.Tuple) else [place.slice]
        numbers = [self.value(index)[1] for index in indices]
        return kind, cgutils.get_item_pointer(
            self.context, self.builder, kind, self.context.make_array(kind)(self.context, self.builder, value), numbers
        )
