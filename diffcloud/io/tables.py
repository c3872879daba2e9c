"""CSV files from others."""

from __future__ import annotations

import csv
import io
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from diffcloud.errors import DiffCloudError

MOST_BYTES = 200_000_000
"""Of a file: a joint log of an hour at a kilohertz has as many."""
_LONGEST_CELL = 10_000


def read_csv(
    path: Path, *, kind: str, error: type[DiffCloudError], text: Sequence[str] = (), torn: bool = False
) -> pd.DataFrame:
    """A table, as pandas reads it.

    Args:
        kind: what it is, for messages: "gripper file".
        text: columns that are not read as numbers, whatever is in them.
        torn: whether the last line may have been cut off by a power cut; it is left out.

    Raises:
        error: missing, too large, no UTF-8, without a line of names, with a name twice, or with rows of different length.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > MOST_BYTES:
            raise error(f"{path} has {size / 1e6:.0f} MB; a {kind} may have {MOST_BYTES / 1e6:.0f} MB.")
        content = path.read_text(encoding="utf-8")
    except FileNotFoundError as missing:
        raise error(f"No such {kind}: {path}.") from missing
    except (OSError, UnicodeDecodeError) as damage:
        raise error(f"{path} is not a readable {kind}: {damage}.") from damage
    if torn:
        content = content[: content.rfind("\n") + 1]
    try:
        names = next(csv.reader(io.StringIO(content), skipinitialspace=True), [])
        twice = [name for name, count in Counter(names).items() if count > 1]
        if twice:
            raise ValueError(f"it has the column {twice[0]!r} twice")
        with warnings.catch_warnings():  # of rows that are longer than the line of names, whose end pandas would drop
            warnings.simplefilter("error", pd.errors.ParserWarning)
            kinds = dict.fromkeys(text, str)
            table = pd.read_csv(io.StringIO(content), skipinitialspace=True, dtype=kinds, index_col=False)
        words = table.select_dtypes(exclude=["number", "bool"])
        longest = max((len(cell) for name in words for cell in words[name] if isinstance(cell, str)), default=0)
        if longest > _LONGEST_CELL:
            raise ValueError(f"a cell has {longest} letters")
        return table
    except (ValueError, csv.Error, pd.errors.ParserWarning) as damage:  # pandas' own errors are values'
        raise error(f"{path} is not a readable {kind}: {damage}.") from damage
