"""The comparison through the command line: the same twice, gaps told, finished episodes kept, a page that stands alone."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

import diffcloud.jobs.comparison
from diffcloud.estimation.record import read_fit
from diffcloud.io.episodes import write_episode
from diffcloud.io.files import claimed
from tests.cli.invoke import stage, study
from tests.cli.test_commands import SMALL
from tests.conftest import small_lift
from tests.estimation.test_fit import clouds_of

ROOT = Path(__file__).parents[2]
PARAMS = {
    "scenes": ["small"],
    "train": {"scenes": ["other"], "models": ["mlp"]},
    "fit": {"solver": {"max_steps": 3, "starts": 2}},
    "evaluate": {"draws": 2, "landscapes": ["*/tan1"], "landscape_size": 3},
    "report": {"cloud_points": 50},
}


def recording(repeat, *, stretch=0.7):
    """As of a real fabric: its parameters are not told."""
    told = {"fabric": "tan", "category": "medium", "repeat": repeat}
    return replace(clouds_of(small_lift(), seed=repeat, stretching=stretch, density=1.0), meta=told)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Two recordings of one fabric, fitted and evaluated."""
    folder = tmp_path_factory.mktemp("evaluate")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        (folder / "raw" / "scenes").mkdir(parents=True)
        (folder / "raw" / "scenes" / "small.yaml").write_text(yaml.safe_dump(SMALL))
        (folder / "params.yaml").write_text(yaml.safe_dump(PARAMS))
        for repeat in (1, 2):
            write_episode(folder / "data" / "episodes" / "small" / f"tan{repeat}.npz", recording(repeat))
        stage("fit", "--params", "params.yaml", "--out", "data/fits", "data/episodes")
        stage("evaluate", "--params", "params.yaml")
    return folder


@pytest.fixture
def work(finished, tmp_path, monkeypatch):
    """A copy, to change."""
    shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def results(folder):
    names = [path for path in sorted((folder / "reports").rglob("*")) if path.suffix in (".json", ".csv")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in names}


def test_twice_gives_the_same_but_for_wall_times(work):
    first = results(work)
    shutil.rmtree(work / "reports")
    stage("evaluate", "--params", "params.yaml")
    second = results(work)
    assert set(first) == set(second)
    differing = {name for name in first if first[name] != second[name]}
    assert all(name == "reports/seconds.csv" or name.startswith("reports/episodes/") for name in differing)


def test_dvc_draws_loss_traces_and_residuals(work):
    """Each plot of dvc.yaml finds its columns and has one line an episode."""
    shutil.copytree(ROOT / ".dvc" / "plots", work / ".dvc" / "plots")
    shutil.copy(ROOT / ".dvc" / "config", work / ".dvc" / "config")
    plots = yaml.safe_load((ROOT / "dvc.yaml").read_text())["plots"]
    assert len(plots) == 2
    (work / "dvc.yaml").write_text(yaml.safe_dump({"plots": plots}))
    subprocess.run(["git", "init", "--quiet"], cwd=work, check=True)
    for name in (name for plot in plots for name in plot):
        told = subprocess.run(
            [sys.executable, "-m", "dvc", "plots", "show", "--show-vega", name], cwd=work, check=True, capture_output=True
        )
        drawn = json.loads(told.stdout)
        rows = drawn["data"]["values"]
        assert {row["episode"] for row in rows} == {"tan1", "tan2"}
        for axis in ("x", "y"):
            assert all(float(row[drawn["encoding"][axis]["field"]]) >= 0 for row in rows)


def test_tables_hold_methods_repeats_and_transfer(work):
    tables = {
        path.stem: pd.read_csv(path) for path in (work / "reports" / "tables").glob("*.csv") if path.stat().st_size > 1
    }
    methods = tables["methods"][tables["methods"]["status"] == "ok"]
    assert set(methods["method"]) == {"diffcloud", "single_start", "middle", "random_search", "cma_es"}
    assert tables["transfer"][["source", "target"]].to_numpy().tolist() == [["tan2", "tan1"], ["tan1", "tan2"]]
    assert set(tables["repeatability"]["parameter"]) == {"stretching", "density", "ratio"}
    assert len(tables["intervals"]) == 4
    metrics = json.loads((work / "reports" / "metrics.json").read_text())["small"]
    means = tables["means"].set_index("method")["rms_mm"]
    assert metrics["rms_mm"] == pytest.approx(means.to_dict(), rel=1e-3)
    assert "ratio_factor" not in metrics  # the truth is not known
    budgets = [read_fit(path).simulations for path in (work / "data" / "fits" / "small").glob("[!.]*.json")]
    spent = tables["means"].set_index("method")["simulations"]
    assert spent["diffcloud"] == spent["cma_es"] == np.mean(budgets)


def test_recordings_of_a_joint_fit_are_compared_each_as_it_lay(work):
    joint = {"joint": True, "initial_state": "turn=5deg", "solver": {"starts": 1, "max_steps": 2}}
    (work / "params.yaml").write_text(yaml.safe_dump(PARAMS | {"fit": joint}))
    shutil.copytree(work / "data" / "fits" / "small", work / "single")  # of other settings, and removed
    stage("fit", "--params", "params.yaml", "--out", "data/fits", "data/episodes")
    shutil.copytree(work / "single", work / "data" / "fits" / "small", dirs_exist_ok=True)
    fit = read_fit(work / "data" / "fits" / "joint.json")
    stage("evaluate", "--params", "params.yaml")
    alone = {one.name: read_fit(work / "data" / "fits" / "small" / f"{one.name}.json") for one in fit.episodes}
    for one, other in zip(fit.episodes, fit.episodes[::-1], strict=True):
        own = json.loads((work / "reports" / "episodes" / "small" / f"{one.name}.json").read_text())["record"]
        (transfer,) = own["transfers"]  # of the other's own fit, not of the joint one, which has seen this recording
        assert transfer["clipped"]["stretching"] == pytest.approx(alone[other.name].values["stretching"])
        kept = work / "reports" / "episodes" / "small" / f"joint-{one.name}.json"
        record = json.loads(kept.read_text())["record"]
        row = next(row for row in record["methods"] if row["method"] == "diffcloud")
        assert record["fit"] == "joint"
        assert record["transfers"] == []
        assert row["clipped"]["turn"] == fit.initial_state_in(one)["turn"] != 0


def test_finished_episodes_are_kept_until_their_inputs_change(work, monkeypatch):
    def never(*arguments, name, **options):
        raise AssertionError(f"{name} was compared again")

    monkeypatch.setattr(diffcloud.jobs.comparison, "compare_episode", never)
    before = results(work)
    stage("evaluate", "--params", "params.yaml", "--markdown", "page.md")
    assert results(work) == before
    assert "| small | tan2 |" in (work / "page.md").read_text()
    write_episode(work / "data/episodes/small/tan2.npz", recording(2, stretch=0.9))
    with pytest.raises(AssertionError, match="tan2 was compared again"):
        stage("evaluate", "--params", "params.yaml")


@pytest.mark.slow
def test_two_processes_give_what_one_gives(work):
    one = results(work)
    shutil.rmtree(work / "reports")
    stage("evaluate", "--params", "params.yaml", "--workers", 2)
    assert results(work)["reports/metrics.json"] == one["reports/metrics.json"]


def test_a_missing_network_is_a_labelled_gap(work):
    (work / "params.yaml").write_text(yaml.safe_dump(PARAMS | {"train": {"scenes": ["small"], "models": ["mlp"]}}))
    failed = stage("evaluate", "--params", "params.yaml", code=1)
    assert "small/tan1: mlp: no checkpoint data/regressors/small/mlp.safetensors" in failed.errors
    table = pd.read_csv(work / "reports/tables/methods.csv")
    gap = table[(table["method"] == "mlp")]
    assert gap["status"].tolist() == ["missing", "missing"]
    allowed = stage("evaluate", "--params", "params.yaml", "--allow-missing")
    assert len(allowed.result["missing"]) == 2
    stage("report", "--params", "params.yaml")
    page = (work / "reports" / "index.html").read_text()
    assert "2 things are missing" in page
    assert "small/tan1: MLP: no checkpoint" in page


def test_a_fit_that_cannot_be_simulated_is_told_and_the_others_go_on(work):
    path = work / "data/fits/small/tan1.json"
    fit = json.loads(path.read_text())
    fit["parameters"]["density"] |= {"multiplier": 1e-9, "bounds": [1e-10, 10]}
    path.write_text(json.dumps(fit))
    failed = stage("evaluate", "--params", "params.yaml", code=1)
    told = failed.errors.rpartition("└")[2]  # after progress and tables
    assert "small/tan1" in told
    assert "diverged" in told
    assert "small/tan2" not in told


def test_episodes_may_be_called_by_numbers_and_a_bound_be_zero(tmp_path, monkeypatch):
    """The report too reads names as names, and draws a landscape over a parameter that has no logarithm."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(SMALL))
    changes = {
        "scenes": ["small.yaml"],
        "fit": {"parameters": ["stretching", "damping"], "solver": {"starts": 1, "max_steps": 1}},
    }
    changes["evaluate"] = PARAMS["evaluate"] | {"landscapes": ["small/001"], "baselines": ["middle"]}
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(PARAMS | changes | {"scenes": ["small"]}))
    (tmp_path / "raw" / "scenes").mkdir(parents=True)
    (tmp_path / "small.yaml").rename(tmp_path / "raw" / "scenes" / "small.yaml")
    hidden = clouds_of(small_lift(), seed=1, stretching=0.7, density=1.0)
    write_episode(
        tmp_path / "data/episodes/small/001.npz", replace(hidden, meta={"truth": {"stretching": 0.7, "density": 1.0}})
    )
    stage("fit", "--params", "params.yaml", "--out", "data/fits", "data/episodes")
    stage("evaluate", "--params", "params.yaml")
    stage("report", "--params", "params.yaml")
    assert "small / 001" in (tmp_path / "reports/index.html").read_text(encoding="utf-8")
    assert (tmp_path / "reports/figures/landscape_small_001.svg").is_file()


def test_one_process_at_a_time_compares_the_published_data(tmp_path):
    with claimed(tmp_path / "reports"):
        said = study("published", tmp_path, "--out", tmp_path / "reports", code=1).errors
    assert "is being written by" in said


def test_profiles_are_whole_parameter_files():
    from pathlib import Path

    from diffcloud.jobs.settings import load_config

    root = Path(__file__).parents[2]
    assert load_config(root / "pipeline" / "profiles" / "release.yaml").fit.solver.starts == 9
    assert load_config(root / "pipeline" / "profiles" / "simulated.yaml").synthesize.per_scenario == 10
    paper = load_config(root / "pipeline" / "profiles" / "paper.yaml")
    assert (paper.generate.train, paper.generate.test, paper.synthesize.per_scenario) == (1500, 375, 10)


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on PATH: the page is not opened in a browser")
def test_the_page_runs_in_a_browser_without_errors_and_asks_nobody(work):
    nasty = "<!--<script>"  # an unescaped one would swallow the scripts
    for path in [*work.rglob("tan2.*")]:
        path.rename(path.with_name(path.name.replace("tan2", nasty)))
    for path in [
        *(work / "reports" / "tables").iterdir(),
        *(work / "data" / "fits").rglob("*.json"),
    ]:
        path.write_text(path.read_text().replace("tan2", nasty))
    stage("report", "--params", "params.yaml")
    page = work / "reports" / "index.html"
    assert page.stat().st_size < 25e6
    assert {path.suffix for path in (work / "reports" / "figures").iterdir()} == {".svg", ".png"}
    # a last script, of the test's own: sort a table that is not the first, and say how it went
    probe = """<script>addEventListener("load", () => {
      const table = document.querySelector("#comparison table"), head = table.tHead.rows[0].cells;
      const column = [...head].findIndex(cell => cell.textContent === "mean mm"); head[column].click();
      const values = [...table.tBodies[0].rows].map(row => +row.cells[column].dataset.value);
      const sorted = values.every((value, i) => i === 0 || values[i - 1] <= value);
      document.title = `sorted ${sorted}, faults ${JSON.stringify(faults)}`;
    });</script></body>"""
    watch = """<script>const faults = []; console.error = (...words) => faults.push(words.join(" "));
    addEventListener("error", event => faults.push(event.message), true);
    addEventListener("securitypolicyviolation", event => faults.push(event.blockedURI));</script>"""
    text = page.read_text().replace("<head>", "<head>" + watch).replace("</body>", probe)
    page.write_text(text)
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
        f"--user-data-dir={work / 'profile'}", "--virtual-time-budget=8000", "--window-size=800,600", "--dump-dom",
        page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert "<title>sorted true, faults []</title>" in done.stdout, re.search(r"<title>.*?</title>", done.stdout)
    # what the browser does not let out, no script of the page can ask for
    assert "Content-Security-Policy" in text
    assert not re.search(r"connect-src|https?:", re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])
