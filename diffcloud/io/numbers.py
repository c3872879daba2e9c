"""The one way in which text files write numbers: plain decimals, as YAML 1.2 and JSON have them."""

from __future__ import annotations

import re

CORE = re.compile(r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
"""A decimal number of YAML, where a zero in front would be octal to some."""
WHOLE = re.compile(r"[-+]?(?:0|[1-9][0-9]*)")
DECIMAL = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?(?:inf|infinity|nan)", re.IGNORECASE)
PLAIN = "plain decimal numbers such as 90, -0.5 or 1e-3"
"""What is allowed, for messages."""


def number(text: str) -> float:
    """The number that a word stands for; Python's `float` would also take `1_000` and digits of other scripts.

    Raises:
        ValueError: it is no plain decimal number, nor `inf` or `nan`.
    """
    if DECIMAL.fullmatch(text.strip()) is None:
        raise ValueError(f"{text!r} is not a number; allowed are {PLAIN}")
    return float(text)


def whole(text: str) -> int:
    """The whole number that a word stands for.

    Raises:
        ValueError: it is none.
    """
    if WHOLE.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a whole number, such as 7")
    return int(text)


def disguised(text: str) -> bool:
    """Whether some reader would take a word for a number that it does not plainly say, such as `1_000`."""
    try:
        float(text)
    except ValueError:
        return False
    return DECIMAL.fullmatch(text.strip()) is None
