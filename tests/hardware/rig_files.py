"""rig.yaml of tests."""

from __future__ import annotations

from pathlib import Path

import yaml


def write_rig(folder: Path, **settings: object) -> Path:
    """Write rig.yaml with these settings; numbers and texts are as YAML has them."""
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(settings, allow_unicode=True))
    return path
