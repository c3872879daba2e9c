"""All damaged files of all kinds, read one by one; what became of each, and what should have."""

from __future__ import annotations

import random
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import asdict
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from tests.robustness import damage
from tests.robustness.damage import Damaged
from tests.robustness.isolated import Outcome, read_alone
from tests.robustness.kinds import KINDS, Kind

SEED = 20261125
_EXPECTED = Path(__file__).with_name("expected.yaml")


def damages(kind: Kind, good: bytes) -> list[Damaged]:
    """Of one kind, those of its form first."""
    forms: dict[str, Callable[[], Iterator[Damaged]]] = {
        "document": lambda: damage.document(good, Path(kind.file).suffix),
        "table": lambda: damage.table(good),
        "arrays": lambda: damage.arrays(good),
        "xml": lambda: damage.xml(good),
        "bytes": lambda: iter(()),
    }
    found = list(forms[kind.form]())
    if len(found) > kind.most:
        found = random.Random(SEED).sample(found, kind.most)
    return [*found, *damage.flipped(good, kind.flips, SEED)]


@cache
def expected() -> dict[str, dict[str, list[str]]]:
    """Kind -> pattern of fields -> damages that make no bad file: a number of that size or sign may stand there, or what is
    missing has a default. All others must be refused. Flipped bytes may be either."""
    return dict(yaml.safe_load(_EXPECTED.read_text()))


def judged(kind: Kind, one: Damaged, outcome: Outcome) -> str | None:
    """What is wrong with an outcome."""
    if outcome.verdict not in ("taken", "refused"):
        return outcome.verdict
    if one.field == "bytes":
        return None
    taken = any(
        fnmatch(one.field, pattern.replace("[", "[[]")) and one.damage in listed
        for pattern, listed in expected().get(kind.as_of or kind.name, {}).items()
    )
    return "taken, though it must be refused" if outcome.verdict == "taken" and not taken else None


def all_of(name: str, project: Path, sample: int | None = None) -> list[dict[str, Any]]:
    """Damages of one kind, in a project of its own: plain values, one mapping each."""
    kind = next(kind for kind in KINDS if kind.name == name)
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / "project"
        shutil.copytree(project, own)
        whole = read_alone(own, kind.read)
        if whole.verdict != "taken":
            raise AssertionError(f"{name}: the good file is refused, so no damage of it says anything: {whole.told}")
        chosen = damages(kind, (own / kind.file).read_bytes())
        if sample is not None and sample < len(chosen):
            chosen = random.Random(f"{SEED} {name}").sample(chosen, sample)
        return [_told(name, one, outcome, judged(kind, one, outcome)) for one, outcome in tried(kind, own, chosen)]


def _told(name: str, one: Damaged, outcome: Outcome, wrong: str | None) -> dict[str, Any]:
    about = {"suite": "inputs", "of": name, "where": one.field, "what": one.damage, "wrong": wrong}
    return about | asdict(outcome) | {"told": outcome.told[:600]}


def tried(kind: Kind, project: Path, chosen: list[Damaged]) -> Iterator[tuple[Damaged, Outcome]]:
    """Read damaged files of one kind, in a project that is as it was afterwards."""
    file = project / kind.file
    good = file.read_bytes()
    try:
        for one in chosen:
            file.write_bytes(one.data)
            yield one, read_alone(project, kind.read)
    finally:
        file.write_bytes(good)
