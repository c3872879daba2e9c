"""Pages of results in Markdown, all of one form: question, answer, table, note, picture, command, folded details."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

Blocks = Sequence[str | Sequence[str]]
"""Paragraphs, each a text or the lines of a table or list."""


def result_page(
    question: str,
    answer: str,
    table: Sequence[str],
    *,
    command: str,
    made: str = "",
    note: str = "",
    picture: str = "",
    details: Mapping[str, Blocks] | None = None,
) -> str:
    """Return a page. The index of results shows its question and answer.

    Args:
        question: title, which ends with a question mark.
        answer: one or two sentences with the main figure.
        table: lines of the main table.
        command: what makes the page.
        made: date of the measurement, and its versions; by default today in UTC.
        note: what a reader of the table must know.
        picture: Markdown of an image.
        details: summary -> long tables and methods, folded. The id of an entry is its summary in lower case with hyphens.
    """
    source = f"Made on {made or datetime.now(UTC).date()} by `{command}`."
    parts = [f"# {question}", answer, "\n".join(table), note, picture, source]
    for summary, blocks in (details or {}).items():
        name = re.sub(r"[^a-z0-9]+", "-", summary.lower()).strip("-")
        texts = [block if isinstance(block, str) else "\n".join(block) for block in blocks]
        parts += [f'<details markdown="1" id="{name}"><summary>{summary}</summary>', *texts, "</details>"]
    return "\n\n".join(part for part in parts if part) + "\n"


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table, none without rows; a missing value is a dash."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)] if rows else []
    return lines + ["| " + " | ".join(_cell(value) for value in row) + " |" for row in rows]


def _cell(value: object) -> str:
    if value is None or value != value:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
