"""Read `.npy` files from untrusted sources: plain arrays, and pickled dictionaries of arrays as in the published data.

Unpickling can run arbitrary code, so no pickle is loaded. Instead, this module interprets only the pickle instructions
that such dictionaries need. A call of numpy is recorded, not executed. An array is built from its bytes only if type,
shape and number of bytes agree. Other instructions are refused. Sizes are checked before memory is allocated.
"""

from __future__ import annotations

import io
import math
import pickletools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import EpisodeError
from diffcloud.io.arrays import ELEMENTS, MOST_DIMENSIONS, npy_header, readable
from diffcloud.io.inputs import read_input

_LARGEST_BYTES = 256 * 2**20
_LARGEST_PICKLE_BYTES = 4 * 2**20
"""Limit for a pickle. The published ones have less than a thousand bytes."""
_DEEPEST = 16


def load_npy(path: Path) -> Any:
    """Read an `.npy` file: a plain array, or a pickled object made of plain containers, numbers, strings and arrays.

    Raises:
        EpisodeError: the file is missing, too large or damaged, or its pickle has other contents.
    """
    path = Path(path)
    data = read_input(path, error=EpisodeError, most_bytes=_LARGEST_BYTES)
    if not data:
        raise EpisodeError(f"{path} is empty.")
    stream = io.BytesIO(data)
    try:
        shape, fortran, kind = npy_header(stream)
    except ValueError as error:
        raise EpisodeError(f"{path} is not a readable .npy file: {error}.") from error
    content = data[stream.tell() :]
    try:
        return _array(kind, shape, fortran, content) if not kind.hasobject else _unpickled(content, shape)
    except _Refused as error:
        raise EpisodeError(f"{path} {error}.") from error


class _Refused(Exception):
    """The file cannot be read. The message continues a sentence that starts with the path."""


@dataclass
class _Call:
    """A numpy function or type in a pickle, with the arguments of its call. The call is recorded, not executed."""

    name: str
    arguments: tuple[Any, ...] = ()
    state: Any = None
    done: Any = None
    """Result of the call, once it has been computed."""


def _array(kind: np.dtype[Any], shape: Any, fortran: bool, content: bytes) -> NDArray[Any]:
    """Build an array in new memory. The content must have exactly the expected length."""
    whole = isinstance(shape, tuple) and all(isinstance(length, int) and length >= 0 for length in shape)
    if not whole or len(shape) > MOST_DIMENSIONS or not readable(kind):
        raise _Refused(
            f"holds an array of {kind} and shape {shape}; only numbers and strings are read, in at most {MOST_DIMENSIONS} "
            "dimensions"
        )
    if math.prod(shape) * kind.itemsize != len(content):
        wanted = math.prod(shape) * kind.itemsize
        raise _Refused(f"is damaged: {shape} values of {kind} take {wanted} bytes, it has {len(content)}")
    try:
        return np.frombuffer(content, kind).reshape(shape, order="F" if fortran else "C").copy()
    except ValueError as error:  # a shape such as (0, 2**63) passes the size check but is no valid shape
        raise _Refused(f"is damaged: {error}") from error


def _unpickled(content: bytes, shape: tuple[int, ...]) -> Any:
    """Return the single object in a pickled array of shape ()."""
    if shape != ():
        raise _Refused(f"holds an array of objects of shape {shape}; only a single dictionary or list is read")
    if len(content) > _LARGEST_PICKLE_BYTES:
        raise _Refused(f"holds a pickle of {len(content)} bytes; at most {_LARGEST_PICKLE_BYTES} are read")
    value = _interpreted(pickletools.genops(content))
    if not isinstance(value, _Call) or value.name != "reconstruct":
        raise _Refused("is no pickle of numpy's; only plain containers, numbers and arrays in one are read")
    elements = _plain(value)
    if not isinstance(elements, list) or len(elements) != 1:
        raise _Refused("is a damaged pickle: one object is expected")
    return elements[0]


_NAMES = {
    "numpy.ndarray": "ndarray",
    "numpy.dtype": "dtype",
    "numpy.core.multiarray._reconstruct": "reconstruct",
    "numpy._core.multiarray._reconstruct": "reconstruct",
    "numpy.core.multiarray.scalar": "scalar",
    "numpy._core.multiarray.scalar": "scalar",
    "_codecs.encode": "encode",
}
"""Names that a pickle may refer to -> kind of the recorded call."""
_MARK = object()


def _interpreted(operations: Iterator[tuple[Any, Any, Any]]) -> Any:
    """Interpret the instructions of a pickle and return its object, in which calls are `_Call` records."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    try:
        for operation, argument, _ in operations:
            match operation.name:
                case "PROTO" | "FRAME":
                    pass
                case "STOP":
                    return stack.pop()
                case "MARK":
                    stack.append(_MARK)
                case "NONE" | "NEWTRUE" | "NEWFALSE":
                    stack.append({"NONE": None, "NEWTRUE": True, "NEWFALSE": False}[operation.name])
                case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT":
                    stack.append(argument)
                case "BINUNICODE" | "SHORT_BINUNICODE" | "BINBYTES" | "SHORT_BINBYTES":
                    stack.append(argument)
                case "EMPTY_LIST" | "EMPTY_DICT" | "EMPTY_TUPLE":
                    stack.append({"EMPTY_LIST": [], "EMPTY_DICT": {}, "EMPTY_TUPLE": ()}[operation.name])
                case "TUPLE1" | "TUPLE2" | "TUPLE3":
                    stack[-int(operation.name[-1]) :] = [tuple(stack[-int(operation.name[-1]) :])]
                case "TUPLE":
                    stack.append(tuple(_since_mark(stack)))
                case "APPEND" | "APPENDS":
                    items = [stack.pop()] if operation.name == "APPEND" else _since_mark(stack)
                    stack[-1].extend(items)
                case "SETITEM" | "SETITEMS":
                    items = [stack.pop(-2), stack.pop()] if operation.name == "SETITEM" else _since_mark(stack)
                    stack[-1].update(zip(items[::2], items[1::2], strict=True))
                case "GLOBAL" | "STACK_GLOBAL":
                    name = ".".join([stack.pop(-2), stack.pop()]) if argument is None else argument.replace(" ", ".")
                    if name not in _NAMES:
                        raise _Refused(f"refers to {name}; only plain containers, numbers and numpy arrays are read")
                    stack.append(_Call(_NAMES[name]))
                case "REDUCE":
                    arguments = stack.pop()
                    stack[-1] = _Call(stack[-1].name, tuple(arguments))
                case "BUILD":
                    state = stack.pop()
                    if stack[-1].state is not None:
                        raise _Refused("is a damaged pickle: an array is described twice")
                    stack[-1].state = state
                case "BINPUT" | "LONG_BINPUT" | "MEMOIZE":
                    memo[len(memo) if argument is None else argument] = stack[-1]
                case "BINGET" | "LONG_BINGET":
                    known = memo[argument]
                    # Repeated containers could expand to any size.
                    if isinstance(known, list | dict) or (isinstance(known, tuple) and not all(map(_is_scalar, known))):
                        raise _Refused("refers to one container twice; only plain nesting is read")
                    stack.append(known)
                case other:
                    raise _Refused(
                        f"has the pickle instruction {other}; only plain containers, numbers and arrays are read"
                    )
    except _Refused:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, StopIteration) as error:
        raise _Refused(f"is a damaged pickle: {error or type(error).__name__}") from error
    raise _Refused("is a damaged pickle: its end is missing")


def _since_mark(stack: list[Any]) -> list[Any]:
    """Pop and return the values above the topmost mark, and pop the mark."""
    begin = len(stack) - 1 - next(index for index, value in enumerate(reversed(stack)) if value is _MARK)
    items = stack[begin + 1 :]
    del stack[begin:]
    return items


def _plain(value: Any, depth: int = 0) -> Any:
    """Replace all recorded calls in nested containers by their results."""
    if depth > _DEEPEST:
        raise _Refused(f"is nested more than {_DEEPEST} deep")
    if isinstance(value, _Call):
        return _carried_out(value, depth)
    if isinstance(value, list | tuple):
        return type(value)(_plain(entry, depth + 1) for entry in value)
    if isinstance(value, dict):
        if not all(map(_is_scalar, value)):
            raise _Refused("has keys that are neither numbers nor strings")
        return {key: _plain(entry, depth + 1) for key, entry in value.items()}
    if not _is_scalar(value):
        raise _Refused("is a damaged pickle: a value is missing")
    return value


def _is_scalar(value: Any) -> bool:
    return value is None or isinstance(value, str | bytes | int | float)


def _carried_out(call: _Call, depth: int) -> Any:
    """Return the array, number or bytes that a recorded call gives."""
    if call.done is not None:
        return call.done
    try:
        match call.name:
            case "encode":
                text, encoding = call.arguments
                call.done = text.encode({"latin1": "latin1"}[encoding])
            case "scalar":
                kind, content = call.arguments
                call.done = _array(_dtype(kind), (), False, _plain(content, depth + 1))[()]
            case "reconstruct":
                _, shape, kind, fortran, content = call.state
                if _dtype_name(kind).startswith("O"):  # the outer object array; its elements follow as a list
                    if not isinstance(content, list):
                        raise _Refused("holds objects as bytes; these would be forged pointers")
                    call.done = _plain(content, depth + 1)
                else:
                    call.done = _array(_dtype(kind), shape, bool(fortran), _plain(content, depth + 1))
            case other:
                raise _Refused(f"refers to numpy's {other} as a value; only arrays and numbers are read")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _Refused(f"is a damaged pickle: {error}") from error
    return call.done


def _dtype_name(call: Any) -> str:
    if not isinstance(call, _Call) or call.name != "dtype" or not isinstance(call.arguments[0], str):
        raise _Refused("is a damaged pickle: an array without an element type")
    return call.arguments[0]


def _dtype(call: Any) -> np.dtype[Any]:
    """Return the element type, in the byte order of the call's state."""
    kind = np.dtype(_dtype_name(call))
    if kind.kind not in ELEMENTS:
        raise _Refused(f"holds an array of {kind}; only numbers and strings are read")
    return kind.newbyteorder(">") if call.state and call.state[1] == ">" else kind
