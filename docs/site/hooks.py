"""What the site has beside docs/*.md, and how links that work in the repository work in it (MkDocs calls `on_*`).

- README, CONTRIBUTING and CHANGELOG are pages of the site; links to them, and their links into docs/, are turned.
- Commands and settings have generated pages (`reference`); where prose names a command it becomes a link to its page.
- LaTeX becomes MathML (`equations`).
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from equations import with_mathml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from reference import address, command_of, command_pages, navigation, title

ROOT = Path(__file__).parents[2]
OUTSIDE = {"README.md": "index.md", "CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
"""Files of the repository that are pages -> their address."""
_LINK = re.compile(r"\[([^\]]*)\]\(([^)\s:#]+)(#[^)]*)?\)")
_CODE = re.compile(r"(?<!<pre>)(?<!</span>)<code>(diffcloud\s[^<]*)</code>(?!</a>)")


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Fill in the navigation's generated pages."""
    for entry in config.nav or []:
        if "Commands" in entry:
            entry["Commands"] = navigation()
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in docs/."""
    pages = {place: (ROOT / name).read_text(encoding="utf-8") for name, place in OUTSIDE.items()}
    written = {file.src_uri: file.content_string for file in files.documentation_pages()}
    guides = {place: text for place, text in written.items() if not place.startswith("results/")}
    pages |= command_pages({"index.md": pages["index.md"], **guides})
    for place, text in pages.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, files: Files, **_: Any) -> str:
    """Turn links between docs/ and the files that become pages; a link that shows a file's name shows the page's title."""
    if page.file.src_uri.startswith("commands/"):
        return markdown
    inside = {place: name for name, place in OUTSIDE.items()}
    source = inside.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    here = posixpath.dirname(page.file.src_uri)

    def turned(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), match[2]))
        if (ROOT / target).is_dir() and target.startswith("docs/"):
            target += "/index.md"  # as GitHub shows a folder
        place = OUTSIDE.get(target, target.removeprefix("docs/") if target.startswith("docs/") else None)
        if place is None:
            return match[0]
        file = files.get_file_from_path(place)
        named = file is not None and file.is_documentation_page() and match[1].endswith((match[2], ".md"))
        shown = title(file.content_string) if file is not None and named else match[1]
        return f"[{shown}]({posixpath.relpath(place, here or '.')}{match[3] or ''})"

    return _LINK.sub(turned, markdown)


def on_page_content(html: str, page: Page, files: Files, **_: Any) -> str:
    """Draw equations, and link commands that the prose names."""

    def linked(match: re.Match[str]) -> str:
        path = command_of(match[1])
        found = files.get_file_from_path(address(path)) if path else None
        return (
            match[0]
            if found is None or found is page.file
            else f'<a href="{found.url_relative_to(page.file)}">{match[0]}</a>'
        )

    try:
        return with_mathml(_CODE.sub(linked, html))
    except ValueError as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from error
