"""The notebook of examples/ runs without changes, and its fit gives the figures of README."""

from __future__ import annotations

import json
import shutil
from typing import Any

import pytest

from tests.docs.examples import ROOT

FOUND, INTERVAL, TRUE = 16.5, (12.6, 21.8), 18.3
"""Stretching stiffness [N/m] as README has it."""


@pytest.mark.slow
def test_the_notebook_runs_and_gives_the_figures_of_readme(tmp_path, monkeypatch):
    shutil.copy(ROOT / "examples" / "towel.npz", tmp_path)
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((ROOT / "examples" / "towel.ipynb").read_text(encoding="utf-8"))
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    found = names["fit"].parameters["stretching"]
    assert names["fit"].status == "fits_to_noise"
    assert (found.value, *found.interval) == pytest.approx((FOUND, *INTERVAL), abs=0.1)
    assert found.interval[0] < TRUE < found.interval[1]
    assert found.status == "identified"
    assert (tmp_path / "out" / "report.html").stat().st_size > 100_000
    assert (tmp_path / "out" / "mujoco" / "sample_0001" / "cloth.json").is_file()
    assert 0 < names["height"].item() < 0.3
    assert names["stiffness"].grad is not None
