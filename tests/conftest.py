"""Fixtures shared by all tests. Everything runs in float64 unless a test says otherwise."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # as the commands do, before numpy and torch are imported

import signal
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from diffcloud.estimation.objective import Objective
from diffcloud.io.simulated import SimulatedSet
from diffcloud.mesh import grid_cloth
from diffcloud.scene.scenarios import Scenario, built_in, grid_scenario
from diffcloud.scene.scenarios.grid import Gripper
from diffcloud.sim.threads import cores

# a shell without job control starts background jobs deaf to Ctrl-C, and nohup deafens them to a closed terminal; processes
# inherit that, and tests send all three
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGHUP, signal.SIGQUIT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)


def pytest_xdist_auto_num_workers() -> int:
    """Of `-n auto`: one more than there are cores, since many tests of cameras, arm and processes wait."""
    return cores() + 1


@pytest.fixture(autouse=True, scope="session")
def _one_worker() -> Iterator[None]:
    """Commands that a test runs in its own process run their jobs there too, unless it gives --workers."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("diffcloud.jobs.pool.cores", lambda: 1)
        yield


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def small_lift(**changes: object) -> Scenario:
    """A lift with 5 x 5 nodes, one of them held, and few steps of the quicker integrator, for tests that only need some
    motion."""
    defaults: dict[str, object] = {
        "grip": "pivot",
        "grip_m": 0.0131,  # 0.2 edge lengths: the node as it is
        "nodes": (5, 5),
        "frames": 5,
        "steps_per_frame": 2,
        "rate_hz": 10.0,
        "points": 200,
        "integrator": "arcsim",
        "path": [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, -0.05, 0.15)],
    }
    return grid_scenario(built_in("lift").model_copy(update={**defaults, **changes}))


paper_objective = partial(Objective, paper=True)
"""The published measure: one frame, one direction, no pose."""


def shaken(**changes: object) -> Scenario:
    """The small cloth in the hands of two grippers, one of which holds two corners."""
    grippers = {
        "left": Gripper(grasped=("left_top",)),
        "right": Gripper(grasped=("right_top", "right_bottom"), path=[(0.0, 0.0, 0.0, 0.0), (0.5, 0.03, 0.0, 0.12)]),
    }
    return small_lift(**{"yaw_deg": 0.0, "grasped": (), "grippers": grippers, **changes})


def flat_set(
    *,
    runs: int = 3,
    frames: int = 2,
    nodes_of: Sequence[Sequence[float]] | None = None,
    faces: Sequence[Sequence[int]] | None = None,
) -> SimulatedSet:
    """A simulated set of a cloth that lies still: 4 x 5 nodes, or the given mesh."""
    mesh = grid_cloth(4, 5, 0.3, 0.4)
    nodes = np.array(mesh.nodes if nodes_of is None else nodes_of, dtype=np.float32)
    return SimulatedSet(
        scenario="flat",
        names=("stretching", "density"),
        bounds=np.array([[0.1, 10.0], [0.1, 10.0]]),
        parameters=np.random.default_rng(0).uniform(0.1, 10, (runs, 2)),
        nodes=np.tile(nodes, (runs, frames, 1, 1)),
        times=0.1 * np.arange(frames),
        faces=mesh.faces if faces is None else np.array(faces),
        loss_faces=None,
        loss_frame=frames - 1,
        first_frame=0,
        obstacle=None,
        length_unit_m=1.0,
    )


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
