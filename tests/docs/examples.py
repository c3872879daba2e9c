"""What the pages tell a reader to type, taken from their Markdown, so that a new example is tested without a new test."""

from __future__ import annotations

import re
import shlex
import textwrap
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "raw/README.md",
    *sorted(str(p.relative_to(ROOT)) for p in ROOT.glob("docs/**/*.md")),
]

_FENCE = re.compile(r"^ *(?:\d+\. |- )?```(?P<language>\w*)\n(?P<body>.*?)^ *```$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"`([^`]+)`")
_FILE = re.compile(r"# (\S+\.\w+)\n")


@dataclass(frozen=True)
class Example:
    """One thing to type, or to put into a file."""

    kind: str
    """command: words of a shell; python: a program; file: text of the file `words[0]`."""
    words: tuple[str, ...]
    text: str


def read(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def examples(markdown: str) -> list[Example]:
    """In the order of the page: fenced blocks of bash, python and files (their first line is the name in a comment), and
    `diffcloud` commands with options or arguments in the prose."""
    found = []
    end = 0
    for fence in _FENCE.finditer(markdown):
        found += _in_prose(markdown[end : fence.start()])
        end = fence.end()
        body = textwrap.dedent(fence["body"])
        name = _FILE.match(body)
        if name is not None:
            found.append(Example("file", (name[1],), body))
        elif fence["language"] == "python":
            found.append(Example("python", (), body))
        elif fence["language"] == "bash":
            found += _in_shell(body)
    return found + _in_prose(markdown[end:])


def mentions(markdown: str) -> list[str]:
    """Inline code that names a command without anything to it, or an option alone."""
    prose = _FENCE.sub("", markdown)
    codes = [" ".join(code.split()) for code in _INLINE.findall(prose)]
    return [code for code in codes if code.startswith(("diffcloud ", "--"))]


def _in_shell(body: str) -> list[Example]:
    lines = body.replace("\\\n", " ").splitlines()
    split = [shlex.split(line, comments=True) for line in lines]
    return [Example("command", tuple(words), shlex.join(words)) for words in split if words]


def _in_prose(text: str) -> list[Example]:
    codes = [" ".join(code.split()) for code in _INLINE.findall(text)]
    return [
        Example("command", tuple(shlex.split(code)), code)
        for code in codes
        if code.startswith("diffcloud ") and re.search(r" (-|\S*[/.])", code)
    ]
