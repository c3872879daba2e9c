"""The race of the solvers: its targets, its table, and the command."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from diffcloud.sim.properties import PARAMETERS
from pipeline import solver_race
from pipeline.fit_jobs import FitJob, Recording
from pipeline.solver_race import COUNTS, RACING, SCENARIOS, RaceJob, race_jobs, race_page, race_rows, race_scenario
from tests.pipeline.invoke import invoke


def job(tmp_path, scenario="lift", count=2, index=0, seed=1):
    return RaceJob(race_scenario(scenario, count), count, index, seed, tmp_path)


def test_truths_lie_within_the_bounds_and_more_variables_leave_the_first_as_they_are(tmp_path):
    truths = [job(tmp_path, count=count).truth() for count in COUNTS]
    assert [len(truth) for truth in truths] == list(COUNTS)
    assert list(truths[0]) == ["stretch", "mass"]
    for fewer, more in pairwise(truths):
        assert fewer == {name: more[name] for name in fewer}
    for index in range(20):
        for name, value in job(tmp_path, count=COUNTS[-1], index=index).truth().items():
            if name in PARAMETERS:
                low, high = PARAMETERS[name].bounds
                assert low <= value <= high
                assert PARAMETERS[name].basis is None or 1 / 3 <= value <= 3
    assert job(tmp_path, index=1).truth() != truths[0] != job(tmp_path, scenario="fold").truth()


@pytest.mark.parametrize(("scenario", "count"), [*(("lift", count) for count in COUNTS), ("fold", COUNTS[-1])])
def test_a_fit_has_the_variables_of_its_target_which_lies_within_their_bounds(tmp_path, scenario, count):
    one = job(tmp_path, scenario=scenario, count=count)
    fit = FitJob("", [Recording(one.scenario, "", one._episode(one.truth()))], one._config(), tmp_path)
    assert set(fit.space.names) == set(one.truth())
    assert all(variable.low <= one.truth()[variable.name] <= variable.high for variable in fit.space.variables)


def test_the_target_moves_with_each_of_its_variables(tmp_path, monkeypatch):
    monkeypatch.setattr(solver_race, "_NOISE_M", 0.0)
    one = job(tmp_path, scenario="fold", count=COUNTS[-1])
    truth = one.truth()
    points = one._episode(truth).points
    for name, value in truth.items():
        assert not np.array_equal(one._episode({**truth, name: 0.9 * value}).points, points), name


def test_a_target_is_its_cloth_turned_shifted_and_noisy(tmp_path, monkeypatch):
    one = job(tmp_path)
    monkeypatch.setattr(solver_race, "_NOISE_M", 0.0)
    still = one._episode(one.truth()).points.astype(np.float64)
    monkeypatch.setattr(solver_race, "_TURNED", 0.0)
    monkeypatch.setattr(solver_race, "_BESIDE_M", 0.0)
    home = one._episode(one.truth()).points.astype(np.float64)
    a, b = (points - points.mean(axis=0) for points in (home, still))
    torch.testing.assert_close(np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1), atol=1e-6, rtol=0)
    off = np.abs(still - home).max(axis=0)
    assert off[:2].max() > 1e-3
    assert off[2] < 1e-6
    monkeypatch.setattr(solver_race, "_NOISE_M", 0.002)
    assert (one._episode(one.truth()).points - home).std() == pytest.approx(0.002, rel=0.02)


def test_cells_are_medians_in_which_a_solver_that_did_not_arrive_took_for_ever():
    def solvers(*seconds):
        runs = [{"arrived": s is not None, "seconds": s or 9.0, "simulations": 10 * (s or 9)} for s in seconds]
        return dict(zip(RACING, runs, strict=True))

    records = [
        {"scenario": "lift", "count": 2, "solvers": solvers(1.0, 2.0, None, 4.0)},
        {"scenario": "lift", "count": 2, "solvers": solvers(3.0, None, None, 4.0)},
        {"scenario": "lift", "count": 2, "solvers": solvers(2.0, 5.0, 1.0, None)},
    ]
    (row,) = race_rows(records)
    assert row == ["lift", "2", "3", "2.0 s, 20 runs (3 of 3)", "5.0 s, 50 runs (2 of 3)", "– (1 of 3)",
                   "4.0 s, 40 runs (2 of 3)"]  # fmt: skip
    page = race_page([row], seed=7)
    assert "| lift | 2 | 3 | 2.0 s, 20 runs (3 of 3) |" in page
    assert "seed 7" in page


def test_every_cell_has_its_targets(tmp_path):
    jobs = race_jobs(2, 0, tmp_path)
    assert len({one.label for one in jobs}) == len(jobs)
    cells = {one.label.rpartition("/")[0] for one in jobs}
    assert len(jobs) == 2 * len(cells)
    level = {"lift/12", "fold/12"}  # elsewhere, the cloth does not lie level
    assert cells == {f"{name}/{count}" for name in SCENARIOS for count in COUNTS[:-1]} | level


@pytest.mark.slow
def test_the_command_races_and_keeps_what_is_finished(tmp_path, monkeypatch):
    monkeypatch.setattr(solver_race, "SCENARIOS", ("lift",))
    monkeypatch.setattr(solver_race, "COUNTS", (2,))
    arguments = ["bench", "--fits", tmp_path / "race", "--targets", 1, "--markdown", tmp_path / "page.md"]
    told = invoke(*arguments).result
    (record,) = told["records"]
    runs = record["solvers"]
    assert set(runs) == set(RACING)
    assert runs["gauss_newton"]["arrived"]
    assert all(run["loss"] >= 0.99 * record["reference"] for run in runs.values())
    assert all(not math.isclose(run["seconds"], 0) for run in runs.values())
    assert "| lift | 2 | 1 |" in (tmp_path / "page.md").read_text()
    monkeypatch.setattr(solver_race, "solve", None)
    assert invoke(*arguments).result["records"] == [record]
