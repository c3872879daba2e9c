"""The form of a page of results: question, answer, table, note, picture, what made it; all else is folded."""

from __future__ import annotations

import re

MOST_WORDS = 300
_FOLDED = re.compile(r'<details markdown="1" id="[\w-]+"><summary>[^\n]+</summary>\n\n.*?\n\n</details>', re.DOTALL)
_NO_PROSE = re.compile(r"!\[.*?\]\(.*?\)|`[^`]*`|(?<=\])\([^)]*\)")
"""Pictures, code, addresses of links."""


def check_form(page: str) -> None:
    """
    Raises:
        AssertionError: the page has another form.
    """
    question, answer, table, *others, made = re.split(r"\n{2,}", _FOLDED.sub("", page).strip())
    assert re.fullmatch(r"# [^\n]+\?", question), f"the title is no question: {question}"
    assert re.search(r"\d", answer), f"the answer has no figure: {answer}"
    assert table.startswith("| "), f"no table follows the answer: {table}"
    assert re.fullmatch(r"Made on \d{4}-\d\d-\d\d[^`]* by `[^`]+`\.", made), f"date or command is not last: {made}"
    pictures = [block for block in others if block.startswith("![")]
    assert others[len(others) - len(pictures) :] == pictures, "the picture comes after the notes"
    assert len(pictures) <= 1, "one picture at most"
    extra = [block for block in others if block.startswith(("|", "#", "<", "```"))]
    assert not extra, f"fold into details: {extra}"
    words = len(_NO_PROSE.sub("", " ".join([question, answer, *others, made])).split())
    assert words <= MOST_WORDS, f"{words} words; {MOST_WORDS} at most outside tables, code and details"
