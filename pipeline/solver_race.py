"""`diffcloud bench --fits`: what each solver spends until it has found a cloth, over scenarios and numbers of variables.

A target is a cloth of drawn parameters, seen as its whole surface with noise and put down a little beside its place. Every
solver gets the same objective, priors and pose included, and stops at 1.05 times the reference loss: the lower one of a
much longer fit's and of a fit started at the truth.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from diffcloud.errors import DivergedError
from diffcloud.evaluation.markdown import markdown_table
from diffcloud.fit import GaussNewtonSettings, JointObjective, Objective, solve
from diffcloud.fit.inputs import Inputs
from diffcloud.fit.laid import parse_laid
from diffcloud.fit.solvers import SOLVERS, LikelihoodSettings, Settings
from diffcloud.io.episodes import Episode
from diffcloud.io.files import write_json
from diffcloud.io.fingerprints import fingerprint, kept_record
from diffcloud.scene.scenarios import Scenario, built_in, make_scenario
from diffcloud.sensing.whole_surface import sample_surface
from diffcloud.sim.properties import PARAMETERS, one_set
from pipeline.config import FitConfig
from pipeline.fit_jobs import FitJob, Recording
from pipeline.workers import Tell

RACING = tuple(name for name in SOLVERS if name != "likelihood")
"""Those that minimise the loss."""
SCENARIOS = ("lift", "fold", "band_stretch", "vest_hang")
ORDER = ("stretch", "mass", "bending", "drag", "damping", "friction_cloth", "friction_obstacle", "shear", "compression")
"""The first two, four, eight, or all of them are fitted."""
COUNTS = (2, 4, 8, 12)
"""Variables; twelve with `_LAID`, of a cloth that lies level."""
_LEVEL = ("lift", "fold")
_LAID = "turn=10deg,size=2%,track=2%"
_COMPRESSION = 0.3
"""Of the scenario's cloth where it is fitted: one that resists in full has no such parameter."""
WITHIN = 1.05
"""A solver has arrived at this multiple of the reference's loss."""
BUDGET = 200
"""Simulations of each solver."""
_ADAM_STARTS = 3
"""All at once, each with a third of the budget."""
_NOISE_M = 0.002
_BESIDE_M = 0.02
_TURNED = math.radians(5)
_CODE = ("mesh", "io", "sim", "scene", "clouds", "sensing", "fit")


@dataclass(frozen=True)
class RaceJob:
    """One target, and all solvers on it. A finished one is kept."""

    scenario: Scenario
    count: int
    index: int
    seed: int
    out: Path

    @property
    def label(self) -> str:
        return f"{self.scenario.name}/{self.count}/{self.index}"

    @property
    def names(self) -> list[str]:
        """Of the material."""
        return list(ORDER[: self.count])

    @property
    def laid(self) -> str:
        """How the cloth may lie, as `--laid` takes it."""
        return _LAID if self.count > len(ORDER) else "none"

    def run(self, tell: Tell) -> dict[str, Any]:
        """The record: truth, the reference's loss, and of each solver the loss, seconds of processor time, simulations, and
        whether it arrived.

        Raises:
            DivergedError: the truth, or every start of the reference, diverges.
        """
        path = self.out / self.scenario.name / str(self.count) / f"{self.index:04d}.json"
        truth = self.truth()
        solvers = [self._settings(name, 0.0) for name in RACING]
        plan = [self.scenario, truth, solvers, self.index, self.seed, BUDGET, WITHIN, _NOISE_M, _BESIDE_M, _TURNED]
        mark = fingerprint(plan, packages=_CODE)
        if (kept := kept_record(path, mark)) is not None:
            return kept
        recording = Recording(self.scenario, self.label, self._episode(truth))
        job = FitJob(self.label, [recording], self._config(), self.out)
        objective, space = job.objective(), job.space
        tell(0.0, "reference")
        wide = GaussNewtonSettings(starts=6, screen=96, seed=self.seed)
        near = GaussNewtonSettings(starts=1, screen=0, init=truth)
        lowest = min(solve(objective, space, settings).uninterrupted().loss for settings in (near, wide))
        told: dict[str, Any] = {"truth": truth, "reference": lowest, "solvers": {}}
        for place, name in enumerate(RACING):
            tell((place + 1) / (len(RACING) + 1), name)
            told["solvers"][name] = self._timed(objective, space, self._settings(name, WITHIN * lowest))
        record = {"fingerprint": mark, "scenario": self.scenario.name, "count": self.count, **told}
        write_json(path, record)
        return record

    def truth(self) -> dict[str, float]:
        """Multipliers, log-uniform within a factor of three of 1; other parameters are uniform in the lower half of their
        bounds. How the cloth lies is drawn from its priors."""
        rng = np.random.default_rng([self.seed, SCENARIOS.index(self.scenario.name), self.index])
        found = {}
        for name in self.names:  # more of them leave the first as they are
            low, high = self.scenario.bounds.get(name, PARAMETERS[name].bounds)
            share = rng.uniform()
            multiplies = PARAMETERS[name].basis is not None
            found[name] = 3.0 ** (2 * share - 1) if multiplies else low + share * (high - low) / 2
        return found | {name: deviation * rng.normal() for name, deviation in parse_laid(self.laid).items()}

    def _episode(self, truth: dict[str, float]) -> Episode:
        system, _ = self.scenario.scene.build()
        with torch.no_grad():
            run = Inputs.of(self.scenario, system, self.scenario.steps, one_set(truth), None).rollout()
        steps = self.scenario.scene.frame_steps
        nodes, times = run.positions[0, ::steps].numpy(), run.times[::steps].numpy()
        # what depth cameras record comes without its table
        obstacles = self.scenario.scene.surrounding.obstacles if self.scenario.recorder == "whole_surface" else ()
        seen = sample_surface(
            nodes, system.mesh.faces, times, obstacles[0] if obstacles else None, points=self.scenario.points,
            seed=self.seed, meta={"truth": truth},
        )  # fmt: skip
        rng = np.random.default_rng([self.seed, self.index, 1])
        angle, (x, y) = rng.normal(0, _TURNED), rng.normal(0, _BESIDE_M, 2)
        turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
        middle = seen.points.mean(axis=0)
        moved = (seen.points - middle) @ turn.T + middle + [x, y, 0] + rng.normal(0, _NOISE_M, seen.points.shape)
        return replace(seen, points=moved.astype(np.float32))

    def _settings(self, solver: str, threshold: float) -> Settings:
        """What `diffcloud fit` takes, with the same budget for all; Adam gets three starts from Gauss–Newton's screen."""
        given: dict[str, Any] = {"threshold": threshold, "seed": self.seed}
        if solver == "adam":
            like = GaussNewtonSettings()
            iterations = (BUDGET - 1 - like.screen) // _ADAM_STARTS - 1
            given |= {"starts": _ADAM_STARTS, "screen": like.screen, "iterations": iterations, "smoothing": 0.0}
        elif solver in ("cma_es", "random_search"):
            given["simulations"] = BUDGET
        return self._config(solver=solver, **given).solver_settings(self.scenario)

    def _config(self, **given: Any) -> FitConfig:
        return FitConfig(parameters=self.names, doubts="none", laid=self.laid, **given)

    def _timed(self, objective: Objective | JointObjective, space: Any, settings: Settings) -> dict[str, Any]:
        assert not isinstance(settings, LikelihoodSettings)  # it has no threshold to arrive at
        began = time.process_time()
        try:
            found = solve(objective, space, settings).uninterrupted()
        except DivergedError as error:
            return {"arrived": False, "error": str(error)}
        seconds = time.process_time() - began
        arrived = found.loss <= settings.threshold and found.simulations <= BUDGET
        return {"arrived": arrived, "loss": found.loss, "seconds": seconds, "simulations": found.simulations}


def race_jobs(targets: int, seed: int, out: Path) -> list[RaceJob]:
    """The first target of every cell, then the second of every cell, and so on."""
    cells = [
        (race_scenario(name, count), count)
        for name in SCENARIOS
        for count in COUNTS
        if count <= len(ORDER) or name in _LEVEL
    ]
    return [RaceJob(scenario, count, index, seed, out) for index in range(targets) for scenario, count in cells]


def race_scenario(name: str, count: int) -> Scenario:
    """In which a target of so many variables moves."""
    known = {"compression": _COMPRESSION} if "compression" in ORDER[:count] else {}
    return make_scenario(built_in(name).model_copy(update=known))


HEAD = ("scenario", "variables", "targets", *RACING)


def race_rows(records: Sequence[dict[str, Any]]) -> list[list[str]]:
    """A row for each cell: of each solver the median of seconds and simulations, and how often it arrived."""
    rows = []
    for name in SCENARIOS:
        for count in COUNTS:
            cell = [record["solvers"] for record in records if (record["scenario"], record["count"]) == (name, count)]
            if cell:
                told = [_cell([solvers[solver] for solvers in cell]) for solver in RACING]
                rows.append([name, str(count), str(len(cell)), *told])
    return rows


def _cell(runs: Sequence[dict[str, Any]]) -> str:
    """Medians over all targets, where those that did not arrive took for ever."""
    arrived = sum(run["arrived"] for run in runs)
    seconds, simulations = (
        float(np.median([run[key] if run["arrived"] else math.inf for run in runs])) for key in ("seconds", "simulations")
    )
    spent = f"{seconds:.1f} s, {simulations:.0f} runs" if math.isfinite(seconds) else "–"
    return f"{spent} ({arrived} of {len(runs)})"


def race_page(rows: Sequence[Sequence[str]], seed: int) -> str:
    """Markdown of docs/results/solvers.md."""
    lines = [
        "# Solvers on drawn cloths",
        "",
        f"How long each solver takes until its loss is at most {WITHIN:g} times that of a reference fit: the better of "
        "Gauss–Newton from the truth, and from the six best of 97 candidates. A target is a cloth of drawn parameters "
        f"(seed {seed}), its whole surface with {1e3 * _NOISE_M:g} mm of noise, shifted by about {1e2 * _BESIDE_M:g} cm "
        "and turned by about 5°. All solvers minimise the same objective, with priors and with the pose found "
        f"for every parameter set, and may spend {BUDGET} simulations; Adam gets {_ADAM_STARTS} starts "
        "from Gauss–Newton's screen.",
        "",
        "Cells hold medians over all targets of processor time on one thread and of simulations (one with derivatives "
        "counts once), and how many targets were reached. A dash: half of them or more were not. Two variables are "
        "stretch and mass; four, bending and drag too; eight, also damping, both frictions and shear. Twelve add "
        "compression, of a cloth that wrinkles, the cloth's turn and size, and how far the gripper goes "
        f"(`--laid {_LAID}`). That needs a cloth that lies level, so bands and vests have no such row.",
        "",
        *markdown_table(HEAD, rows),
        "",
        f"Command: `diffcloud bench --fits build/solvers --targets {rows[0][2]} --seed {seed} --workers 2 --markdown "
        "docs/results/solvers.md`; finished targets are kept.",
        "",
    ]
    return "\n".join(lines)
