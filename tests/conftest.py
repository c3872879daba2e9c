"""Fixtures shared by all tests. Everything runs in float64 unless a test says otherwise."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from diffcloud.scene.scenarios import Scenario, built_in, grid_scenario

if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(1)  # as the commands do: beside another busy process spinning threads cost tenfold


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def small_lift(**changes: object) -> Scenario:
    """A lift with 5 x 5 nodes and few steps of the quicker integrator, for tests that only need some motion."""
    defaults: dict[str, object] = {
        "nodes": (5, 5),
        "frames": 5,
        "steps_per_frame": 2,
        "rate_hz": 10.0,
        "points": 200,
        "integrator": "linearised",
        "path": [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, -0.05, 0.15)],
    }
    return grid_scenario(built_in("lift").model_copy(update={**defaults, **changes}))


@pytest.fixture
def lift() -> Scenario:
    return small_lift()


@pytest.fixture(scope="session")
def release() -> Path:
    """The published data; tests that need it are skipped, loudly, where it is not."""
    folder = os.environ.get("DIFFCLOUD_RELEASE")
    if not folder:
        pytest.skip("DIFFCLOUD_RELEASE is not set (the folder that holds lift_real_pcls and conf)")
    path = Path(folder)
    assert (path / "conf").is_dir(), f"DIFFCLOUD_RELEASE={folder} holds no conf/"
    return path


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not os.environ.get("DIFFCLOUD_RELEASE"):
        terminalreporter.write_line(
            "NOTE: DIFFCLOUD_RELEASE is not set, so tests on the published data were SKIPPED.", yellow=True, bold=True
        )
