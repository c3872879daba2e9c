"""Parse numbers in text files: plain decimals, as in YAML 1.2 and JSON."""

from __future__ import annotations

import re

CORE = re.compile(r"[-+]?(?:\.[0-9]+|(?:0|[1-9][0-9]*)(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?")
"""A decimal number of YAML. Leading zeros are not allowed, since some readers take them as octal."""
WHOLE = re.compile(r"[-+]?(?:0|[1-9][0-9]*)")
DECIMAL = re.compile(r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?(?:inf|infinity|nan)", re.IGNORECASE)
PLAIN = "plain decimal numbers such as 90, -0.5 or 1e-3"
"""Description of the allowed form, for messages."""


def number(text: str) -> float:
    """Convert a string to a number. Python's `float` would also accept `1_000` and digits of other scripts.

    Raises:
        ValueError: the string is neither a plain decimal number nor `inf` or `nan`.
    """
    if DECIMAL.fullmatch(text.strip()) is None:
        raise ValueError(f"{text!r} is not a number; allowed are {PLAIN}")
    return float(text)


def whole(text: str) -> int:
    """Convert a string to a whole number.

    Raises:
        ValueError: the string is not a whole number.
    """
    if WHOLE.fullmatch(text) is None:
        raise ValueError(f"{text!r} is not a whole number, such as 7")
    return int(text)


def disguised(text: str) -> bool:
    """Whether Python's `float` accepts a string that is not a plain decimal number, such as `1_000`."""
    try:
        float(text)
    except ValueError:
        return False
    return DECIMAL.fullmatch(text.strip()) is None
