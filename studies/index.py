"""`python -m studies index`: the question and the answer of each page of results, in the order of the site."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
import yaml

from diffcloud.io.files import write_text


def index(out: Annotated[Path, typer.Option(help="Markdown page.")] = Path("docs/results/index.md")) -> None:
    """Write a line for each page of results: its question and its answer."""
    write_text(out, index_page())


def index_page() -> str:
    """Return the page, from the pages that mkdocs.yml names under Results."""
    root = Path(__file__).parents[1]
    nav = yaml.safe_load((root / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    pages = [
        page for entry in nav for named in entry.get("Results", ()) if isinstance(named, dict) for page in named.values()
    ]
    lines = ["# Results", ""]
    for page in pages:
        question, answer, *_ = (root / "docs" / page).read_text(encoding="utf-8").split("\n\n")
        lines.append(f"- [{question.removeprefix('# ')}]({Path(page).name}) {answer}")
    return "\n".join([*lines, ""])
