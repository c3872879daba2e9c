"""The ways in which a good file goes bad: each field of a document, each column of a table, each array, and bytes."""

from __future__ import annotations

import copy
import io
import json
import math
import random
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

KINDS = ("missing", "wrong type", "odd number", "NaN", "infinite", "negative", "zero", "huge", "duplicate", "too deep")
_DEEP = "@@deep@@"
_TWICE = "@@twice@@"
_ODD = "1_000"
"""A number to Python, and to YAML 1.1."""
_LEVELS = 100_000
_LONG = 1_000_000


@dataclass(frozen=True)
class Damaged:
    """One bad file."""

    field: str
    """Where, such as `gripper.path[0][1]`; `bytes` for those."""
    damage: str
    data: bytes


def document(data: bytes, suffix: str) -> Iterator[Damaged]:
    """Every field of a JSON or YAML document in turn."""
    tree = yaml.safe_load(data) if suffix == ".yaml" else json.loads(data)
    for place in list(_places(tree)):
        name = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in place).lstrip(".")
        for damage in KINDS:
            changed = _changed(tree, place, damage, suffix)
            if changed is not None and changed != tree:
                yield Damaged(name, damage, _written(changed, suffix))


def _places(tree: Any, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Each key, each first element of a list, and what they hold."""
    if at:
        yield at
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _places(value, (*at, key))
    elif isinstance(tree, list) and tree:
        yield from _places(tree[0], (*at, 0))


def _changed(tree: Any, place: tuple[str | int, ...], damage: str, suffix: str) -> Any:
    """A copy with one damage; None where it makes no sense there."""
    changed = copy.deepcopy(tree)
    holder = changed
    for key in place[:-1]:
        holder = holder[key]
    key, value = place[-1], holder[place[-1]]
    number = isinstance(value, int | float) and not isinstance(value, bool)
    match damage:
        case "missing":
            del holder[key]
        case "wrong type":
            holder[key] = "text" if number or isinstance(value, list | dict | bool) or value is None else [1, 2]
        case "odd number" if number:
            holder[key] = _ODD
        case "NaN" | "infinite" if number:
            holder[key] = math.nan if damage == "NaN" else math.inf
        case "negative" if number:
            holder[key] = -abs(value) - 1
        case "zero" if number:
            holder[key] = 0
        case "huge" if number:
            holder[key] = 10**12 if isinstance(value, int) else 1e300
        case "huge" if isinstance(value, str):
            holder[key] = "x" * _LONG
        case "huge" if isinstance(value, list) and value:
            holder[key] = value * (_LONG // (50 if suffix == ".yaml" else 10) // len(value))
        case "duplicate" if isinstance(holder, dict):
            holder[f"{_TWICE}{key}"] = value
        case "too deep":
            holder[key] = _DEEP
        case _:
            return None
    return changed


def _written(tree: Any, suffix: str) -> bytes:
    text = yaml.safe_dump(tree, sort_keys=False) if suffix == ".yaml" else json.dumps(tree)
    deep = "[" * _LEVELS + "]" * _LEVELS
    for quoted in (f'"{_DEEP}"', f"'{_DEEP}'", _DEEP):
        text = text.replace(quoted, deep)
    if suffix == ".yaml":
        text = text.replace(f"'{_ODD}'", _ODD)
    return text.replace(f"'{_TWICE}", "'").replace(_TWICE, "").encode()


def table(data: bytes) -> Iterator[Damaged]:
    """Every column of a CSV file in turn, in its second row; and the whole."""
    lines = [line.split(",") for line in data.decode().splitlines()]
    cells = {
        "wrong type": "text", "odd number": _ODD, "NaN": "nan", "infinite": "inf", "negative": "-1", "zero": "0",
        "huge": "1e300", "missing": "", "too deep": "9" * _LONG,
    }  # fmt: skip
    for column, name in enumerate(lines[0]):
        for damage, cell in cells.items():
            rows = [list(line) for line in lines]
            rows[min(2, len(rows) - 1)][column] = cell
            if rows != lines:
                yield Damaged(name, damage, _joined(rows))
        yield Damaged(name, "missing column", _joined([line[:column] + line[column + 1 :] for line in lines]))
        yield Damaged(name, "duplicate column", _joined([[*line, line[column]] for line in lines]))
    yield Damaged("rows", "duplicate", _joined([*lines[:2], *lines[1:]]))
    yield Damaged("rows", "missing", _joined(lines[:1]))
    yield Damaged("rows", "ragged", _joined([*lines[:2], lines[1][:1], *lines[2:]]))
    yield Damaged("text", "no UTF-8", b"\xff\xfe" + data)


def _joined(rows: list[list[str]]) -> bytes:
    return ("\n".join(",".join(row) for row in rows) + "\n").encode()


def arrays(data: bytes) -> Iterator[Damaged]:
    """Every array of an NPZ file in turn."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        held = dict(file)
    changes: dict[str, Callable[[np.ndarray], np.ndarray | None]] = {
        "missing": lambda one: None,
        "wrong type": lambda one: np.full(one.shape, "text"),
        "complex": lambda one: one.astype(complex) if one.dtype.kind in "fiu" else one,
        "NaN": lambda one: _filled(one, math.nan),
        "infinite": lambda one: _filled(one, math.inf),
        "negative": lambda one: _filled(one, -1),
        "zero": lambda one: np.zeros_like(one),
        "huge": lambda one: _filled(one, 1e30 if one.dtype.kind == "f" else np.iinfo(one.dtype).max),
        "one dimension more": lambda one: one[..., None],
        "empty": lambda one: one[:0] if one.ndim else np.zeros(0, one.dtype),
        "one shorter": lambda one: one[:-1] if one.ndim else one[None][:0],
        "twice as long": lambda one: np.concatenate([one, one]) if one.ndim else np.stack([one, one]),
    }
    for name, array in held.items():
        for damage, change in changes.items():
            if array.dtype.kind not in "fiu" and damage in ("NaN", "infinite", "negative", "huge", "complex"):
                continue
            if array.dtype.kind != "f" and damage in ("NaN", "infinite"):
                continue
            if array.dtype.kind == "u" and damage == "negative":
                continue
            other = change(array)
            if other is not None and other.shape == array.shape and np.array_equal(other, array):
                continue
            stream = io.BytesIO()
            np.savez_compressed(stream, **{key: value for key, value in {**held, name: other}.items() if value is not None})
            yield Damaged(name, damage, stream.getvalue())
        stream = io.BytesIO(data)
        with zipfile.ZipFile(stream, "a") as archive, warnings.catch_warnings(action="ignore", category=UserWarning):
            archive.writestr(f"{name}.npy", archive.read(f"{name}.npy"))
        yield Damaged(name, "duplicate", stream.getvalue())


def _filled(array: np.ndarray, value: float) -> np.ndarray:
    """A copy whose last element is this."""
    changed = array.copy()
    if changed.size:
        changed.reshape(-1)[-1] = np.asarray(value).astype(changed.dtype) if changed.dtype.kind == "f" else int(value)
    return changed


def xml(data: bytes) -> Iterator[Damaged]:
    """Every attribute of an XML file in turn, every element twice, and none, and one far down."""
    values = {
        "wrong type": "text", "NaN": "nan", "infinite": "inf", "negative": "-1", "zero": "0", "huge": "1e300",
        "too long": "9" * _LONG,
    }  # fmt: skip
    for place in range(1, len(list(ElementTree.fromstring(data).iter()))):
        for damage in ("missing", "duplicate", "too deep"):
            tree = ElementTree.fromstring(data)
            element = list(tree.iter())[place]
            parent = next(one for one in tree.iter() if element in list(one))
            name = f"{element.tag} {element.get('name', place)}"
            if damage == "duplicate":
                parent.insert(0, copy.deepcopy(element))
            else:
                parent.remove(element)
                if damage == "too deep":
                    parent.text = _DEEP
            deep = f"<{element.tag}>" * _LEVELS + f"</{element.tag}>" * _LEVELS
            yield Damaged(name, damage, ElementTree.tostring(tree).replace(_DEEP.encode(), deep.encode()))
        for key in list(ElementTree.fromstring(data).iter())[place].attrib:
            for damage, value in {**values, "missing": None}.items():
                tree = ElementTree.fromstring(data)
                element = list(tree.iter())[place]
                name = f"{element.tag} {element.get('name', place)}.{key}"
                parts = element.attrib[key].split()
                if value is None:
                    del element.attrib[key]
                elif element.attrib[key] != (changed := " ".join([value, *parts[1:]])):
                    element.set(key, changed)
                else:
                    continue
                yield Damaged(name, damage, ElementTree.tostring(tree))


def flipped(data: bytes, count: int, seed: int) -> Iterator[Damaged]:
    """Flipped bytes, one to four at a time, and cut ends."""
    draw = random.Random(seed)
    for index in range(count):
        if index % 3 == 0:
            yield Damaged("bytes", "truncated", data[: draw.randrange(len(data))])
            continue
        changed = bytearray(data)
        for _ in range(draw.randint(1, 4)):
            # half of them near the start, where headers are
            changed[draw.randrange(min(len(data), 256) if draw.random() < 0.5 else len(data))] ^= 1 << draw.randrange(8)
        yield Damaged("bytes", "flipped", bytes(changed))
