"""Equations of the site: LaTeX to MathML, which browsers draw themselves, without a script and without a network."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

_FOUND = re.compile(r'<(div|span) class="arithmatex">\\[\[(](.*?)\\[\])]</\1>', re.DOTALL)
# commands that the converter leaves as they are land in the MathML as text
_UNKNOWN = re.compile(r"<mi>\\[A-Za-z]+</mi>")


def with_mathml(page: str) -> str:
    """HTML with the equations that `pymdownx.arithmatex` marked as MathML.

    Raises:
        ValueError: an equation that cannot be converted.
    """

    def converted(match: re.Match[str]) -> str:
        latex = html.unescape(match[2]).strip()
        try:
            mathml = convert(latex, display="block" if match[1] == "div" else "inline")
        except Exception as error:
            raise ValueError(f"no equation: {latex} ({error!r})") from error
        if _UNKNOWN.search(mathml):
            raise ValueError(f"no equation: {latex} ({', '.join(_UNKNOWN.findall(mathml))})")
        return f'<div class="equation">{mathml}</div>' if match[1] == "div" else mathml

    return _FOUND.sub(converted, page)
