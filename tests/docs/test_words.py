"""Words that this project once gave a meaning of its own; the field has another word for each."""

from __future__ import annotations

import re
import subprocess

import pytest

from tests.docs.examples import ROOT

RETIRED = {
    "laid": "initial state",
    "doubt": "uncertain, nuisance",
    "misfit": "residual",
    "halvings": "mesh refinement",
    "in vain": "without improvement",
    "astray": "converges to a wrong minimum",
    "rival": "baseline",
    "verdict": "status",
    "remark": "warning",
    "basis material": "nominal material",
    "friction_obstacle": "friction",
    "friction_cloth": "self_friction",
    "--nuisance": "--alignment",
    "--doubts": "--uncertain",
}
"""Retired word -> what the field says."""
NOT_IN = ("CHANGELOG.md", "tests/")
"""Tests are no text for users."""
ENDINGS = (".py", ".md", ".yaml", ".toml", ".html", ".js")


def written() -> list[str]:
    """Files that people read, as git knows them."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    return [name for name in listed if name.endswith(ENDINGS) and not name.startswith(NOT_IN)]


@pytest.mark.parametrize("word", RETIRED)
def test_no_text_has_a_retired_word(word):
    pattern = re.compile(rf"(?<![a-z]){re.escape(word)}s?(?![a-z])", re.IGNORECASE)
    found = [
        f"{name}:{number}: {line.strip()}"
        for name in written()
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), 1)
        if pattern.search(line)
    ]
    assert not found, f"write {RETIRED[word]!r} instead:\n" + "\n".join(found)
