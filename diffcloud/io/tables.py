"""Read CSV files of the user."""

from __future__ import annotations

import csv
import io
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from diffcloud.errors import DiffCloudError
from diffcloud.io.inputs import read_text
from diffcloud.io.numbers import PLAIN, disguised

_MOST_BYTES = 200_000_000
"""Largest file [bytes], about a joint log of one hour at 1 kHz."""
_LONGEST_CELL = 10_000


def read_csv(
    path: Path, *, kind: str, error: type[DiffCloudError], text: Sequence[str] = (), torn: bool = False
) -> pd.DataFrame:
    """Read a CSV file as a pandas table. Numbers must be plain decimals.

    Args:
        kind: kind of file, for messages, such as "gripper file".
        text: columns that are read as text.
        torn: ignore an incomplete last line, as a power cut may leave it.

    Raises:
        error: the file is missing, not a regular file, too large, not UTF-8, or has no header. Also if a column name
            occurs twice, rows differ in length, or a cell has an ambiguous number (`1_000`).
    """
    path = Path(path)
    content = read_text(path, kind=kind, error=error, most_bytes=_MOST_BYTES)
    if torn:
        content = content[: content.rfind("\n") + 1]
    try:
        names = next(csv.reader(io.StringIO(content), skipinitialspace=True), [])
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise ValueError(f"it has the column {twice[0]!r} twice")
        with warnings.catch_warnings():  # pandas only warns when it truncates rows that are longer than the header
            warnings.simplefilter("error", pd.errors.ParserWarning)
            kinds = dict.fromkeys(text, str)
            table = pd.read_csv(io.StringIO(content), skipinitialspace=True, dtype=kinds, index_col=False)
        words = table.select_dtypes(exclude=["number", "bool"])
        longest = max((len(cell) for name in words for cell in words[name] if isinstance(cell, str)), default=0)
        if longest > _LONGEST_CELL:
            raise ValueError(f"a cell has {longest} letters")
        for name in words:
            if name not in text and (wrong := next((cell for cell in words[name] if _disguised(cell)), None)):
                raise ValueError(f"column {name!r} has {wrong!r}, which is no number; allowed are {PLAIN}")
        return table
    except (ValueError, csv.Error, pd.errors.ParserWarning) as damage:  # pandas' own errors are ValueErrors
        raise error(f"{path} is not a readable {kind}: {damage}.") from damage


def _disguised(cell: object) -> bool:
    return isinstance(cell, str) and disguised(cell)


def numbers(table: pd.DataFrame, columns: Sequence[str], *, place: str, error: type[DiffCloudError]) -> NDArray[np.float64]:
    """Return columns of a table as an array [rows, columns]. An empty cell is NaN.

    Args:
        place: name of the table, for messages.

    Raises:
        error: a column is missing, or has cells that are not plain numbers, such as `1:30` or `True`.
    """
    missing = [name for name in columns if name not in table.columns]
    if missing:
        raise error(f"{place}: columns {missing} are missing; it has {list(table.columns)}.")
    for name in columns:
        if table[name].dtype.kind == "b":
            raise error(f"{place} is not a CSV of numbers: column {name!r} has truth values. Allowed are {PLAIN}.")
    try:
        return table[list(columns)].to_numpy(np.float64)
    except ValueError as damage:
        raise error(f"{place} is not a CSV of numbers: {damage}. Allowed are {PLAIN}.") from damage
