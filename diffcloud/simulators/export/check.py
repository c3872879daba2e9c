"""Run an exported cloth and compare: analytical solutions with the fitted material, and the recorded motion.

The exported script runs in a separate process, as a user would run it.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from diffcloud.errors import ConfigError
from diffcloud.simulators import mujoco, newton, ours
from diffcloud.simulators.export.cloth import ExportedCloth
from diffcloud.simulators.export.write import for_mujoco
from diffcloud.simulators.problem import Problem, Track, distances
from diffcloud.simulators.problems import Known, cantilever, strip

Runnable = Literal["mujoco", "newton"]
_SCRIPTS: dict[Runnable, str] = {"mujoco": "run_mujoco.py", "newton": "run_newton.py"}
_VBD_STEPS = {"strip": 5_000, "cantilever": 15_000}
"""Number of time steps with which VBD converges to the analytical solutions. More steps lose accuracy (float32)."""
_MINUTES = 30


@dataclass(frozen=True)
class Answer:
    """One quantity of a test with an analytical solution."""

    test: str
    measure: str
    theory: float
    ours: float
    theirs: float

    @property
    def error(self) -> float:
        """Relative error of the target simulator."""
        return self.theirs / self.theory - 1


@dataclass(frozen=True)
class Checked:
    """Results of an exported cloth in its target simulator."""

    answers: list[Answer]
    times: NDArray[np.float64]
    """[T] [s]"""
    apart_mm: NDArray[np.float64]
    """[T] RMS distance of the nodes from the fitted motion. NaN after the target simulator diverged."""
    simplified_mm: NDArray[np.float64]
    """[T] the same for the exported problem in DiffCloud's simulator, that is, the effect of simplifications."""

    def largest(self, test: str) -> float:
        """Return the largest relative error in a test."""
        return max(abs(answer.error) for answer in self.answers if answer.test == test)


def check_export(cloth: ExportedCloth, target: Runnable, folder: Path, tell: Callable[[str], None]) -> Checked:
    """Run the tests with analytical solutions and the exported script in the target simulator.

    Args:
        folder: folder with the exported files.
        tell: called with the name of each step.

    Raises:
        ConfigError: the script fails.
    """
    answers = []
    for known in (strip(cloth.problem.sheet), cantilever(cloth.problem.sheet)):
        tell(known.problem.name)
        answers += _answers(known, target)
    tell("motion")
    with tempfile.TemporaryDirectory() as made:
        theirs = _run(folder / _SCRIPTS[target], Path(made) / "nodes.npz")
    apart = np.where(np.isfinite(theirs).all((1, 2)), distances(Track(theirs, 0.0), Track(cloth.motion, 0.0)), np.nan)
    return Checked(answers, cloth.problem.times, 1e3 * apart, 1e3 * cloth.simplified_m)


def _answers(known: Known, target: Runnable) -> list[Answer]:
    own, theirs = known.measures(ours.simulate(known.problem)), known.measures(_theirs(known.problem, target))
    return [
        Answer(known.problem.name, name, theory, own[name], theirs[name])
        for name, theory in known.theory.items()
    ]  # fmt: skip


def _theirs(problem: Problem, target: Runnable) -> Track:
    if target == "mujoco":
        given, settings = for_mujoco(problem)
        return mujoco.simulate(given, settings)
    return newton.simulate(problem, newton.Settings(step=problem.seconds / _VBD_STEPS[problem.name]))


def _run(script: Path, out: Path) -> NDArray[np.float64]:
    command = [sys.executable, str(script.resolve()), "--out", str(out)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60 * _MINUTES, check=False)
    except subprocess.TimeoutExpired as error:
        raise ConfigError(f"{script} did not end within {_MINUTES} minutes; run it by hand to see where it is.") from error
    if done.returncode:
        told = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise ConfigError(f"{script} failed ({told}); run it by hand to see more.")
    with np.load(out, allow_pickle=False) as told_nodes:
        return np.asarray(told_nodes["nodes"], dtype=np.float64)
