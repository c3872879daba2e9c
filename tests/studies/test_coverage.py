"""`python -m studies coverage` and `diffcloud evaluate intervals` as a person runs them."""

from __future__ import annotations

import contextlib
import json
import math

import pytest
import yaml

from diffcloud.errors import ConfigError, DivergedError, OutputError
from diffcloud.io.episodes import read_episode
from diffcloud.jobs.scenarios import choose_scenario
from diffcloud.jobs.settings import load_config
from studies import coverage
from studies.coverage_page import counted, counts_of, coverage_page
from tests.cli.invoke import study
from tests.cli.test_commands import SMALL as LIFT
from tests.docs.form import check_form
from tests.regressors.test_checkpoints import regressor

SMALL = {**LIFT, "recorder": "whole_surface"}
PARAMS = {"fit": {"solver": {"starts": 1, "max_steps": 4}, "uncertain": "bending=1.5x"}}


@pytest.fixture
def work(tmp_path):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(SMALL))
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(PARAMS))
    with contextlib.chdir(tmp_path):
        yield tmp_path


COVERAGE = ("coverage", "--scenario", "small.yaml", "--recordings", 2, "--params", "params.yaml", "--out", "out")


class TestCoverage:
    def test_counts_and_records(self, work):
        done = study(*COVERAGE, "--fix", "density", "--seed", 3, "--markdown", "page.md")
        told = done.result["parameters"]["stretching"]
        assert told["n"] == 2
        assert 0 <= told["covered"] <= told["stated"] <= 2
        assert done.result["level"] == 0.9
        record = json.loads((work / "out/small/density_known/0001.json").read_text())
        assert set(record["truth"]) == {"stretching", "density", "bending"}
        assert record["intervals"]["parameters"].keys() == {"stretching"}
        assert "| small | density known | stretching | 2 |" in (work / "page.md").read_text()

    @pytest.mark.slow
    def test_a_later_call_keeps_what_is_finished(self, work):
        study(*COVERAGE, "--fix", "density")
        before = {path: path.stat().st_mtime_ns for path in (work / "out").rglob("*.*")}
        study(*COVERAGE, "--fix", "density", "--recordings", 3)
        after = {path: path.stat().st_mtime_ns for path in (work / "out").rglob("*.*")}
        assert before.items() <= after.items()
        free = study(*COVERAGE)
        assert set(free.result["parameters"]) == {"stretching", "density"}
        assert free.result["ratio"]["n"] == 2
        assert (work / "out/small/free/0000.json").is_file()

    def test_other_recordings_are_made_anew(self, work):
        study(*COVERAGE, "--recordings", 1)
        episode = work / "out/small/episodes/0000.npz"
        first, written = read_episode(episode), episode.stat().st_mtime_ns
        (work / "params.yaml").write_text(yaml.safe_dump({**PARAMS, "preprocess": {"points": 40}}))
        study(*COVERAGE, "--recordings", 1)
        second = read_episode(episode)
        assert first.meta["truth"] == second.meta["truth"]
        assert first.meta["made"] != second.meta["made"]
        assert episode.stat().st_mtime_ns != written

    def test_fits_with_other_known_parameters_share_a_raw_recording(self, work):
        (work / "small.yaml").write_text(yaml.safe_dump(LIFT))
        (work / "params.yaml").write_text(yaml.safe_dump({**PARAMS, "synthesize": {"image_size": [212, 120]}}))
        study(*COVERAGE, "--recordings", 1, "--fix", "density")
        episode = work / "out/small/episodes/0000.npz"
        written = episode.stat().st_mtime_ns
        assert read_episode(episode).meta["source"] == "raw episode"
        study(*COVERAGE, "--recordings", 1)
        assert episode.stat().st_mtime_ns == written

    @pytest.mark.parametrize("truth", ["refined", "finer"])
    def test_another_truth_has_a_folder_of_its_own(self, work, truth, monkeypatch):
        """The same cloth, as other steps and another mesh move it."""
        scenes = []
        frames = coverage.simulated_frames
        monkeypatch.setattr(
            coverage, "simulated_frames", lambda scenario, sets: scenes.append(scenario.scene) or frames(scenario, sets)
        )
        study(*COVERAGE, "--recordings", 1)
        study(*COVERAGE, "--recordings", 1, "--truth", truth)
        record, same = (
            json.loads((work / f"out/small/{name}/0000.json").read_text()) for name in (f"free_{truth}", "free")
        )
        assert record["truth"] == same["truth"]
        assert record["set_up"] == same["set_up"]
        assert scenes[1].frame_steps == 4 * scenes[0].frame_steps
        assert len(scenes[1].mesh.faces) == len(scenes[0].mesh.faces) * (4 if truth == "finer" else 1)

    def test_another_truth_is_recorded_with_noise(self, work):
        """1 mm along each axis; a frame that shows the start alone, which other steps leave where it was."""
        for truth in ("same", "refined"):
            study(*COVERAGE, "--recordings", 1, "--truth", truth)
        clouds = [read_episode(work / f"out/small/{name}/0000.npz").frame(0) for name in ("episodes", "episodes_refined")]
        assert abs(clouds[0] - clouds[1]).mean() == pytest.approx(1e-3 * math.sqrt(2 / math.pi), rel=0.15)

    def test_refits_share_what_is_fitted_and_nothing_else(self, work):
        done = study(*COVERAGE, "--recordings", 1, "--refits", 2, "--markdown", "page.md")
        first, second = (json.loads((work / f"out/small/free_refits/0000_0{n}.json").read_text()) for n in (0, 1))
        assert [first["truth"][name] == second["truth"][name] for name in ("stretching", "density", "bending")] == [
            True,
            True,
            False,
        ]
        assert all(first["set_up"][name] != second["set_up"][name] for name in first["set_up"])
        assert done.result["parameters"]["stretching"]["n"] == 2
        assert done.result["refits"]["stretching"]["cloths"] == 1
        page = (work / "page.md").read_text()
        assert "| small | free | stretching | 1 |" in page
        assert "| small | free refits |" not in page

    def test_a_network_predicts_the_same_recordings(self, work):
        """The ratio's interval is that of the ratio of what is drawn together."""
        regressor("posterior", scenario="small").write(work / "posterior.safetensors")
        done = study(*COVERAGE, "--checkpoint", "posterior.safetensors", "--markdown", "page.md")
        record = json.loads((work / "out/small/posterior/0001.json").read_text())
        fitted = json.loads((work / "out/small/free/0001.json").read_text())
        assert record["truth"] == fitted["truth"]
        ratio, stretch = record["intervals"]["ratio"], record["intervals"]["parameters"]["stretching"]
        assert ratio["low"] < ratio["value"] < ratio["high"]
        assert stretch["low"] < stretch["value"] < stretch["high"]
        assert "| small | posterior | stretching / density | 2 | 2 |" in (work / "page.md").read_text()
        assert set(done.result["parameters"]) == {"stretching", "density"}  # of the fits

    def test_a_failure_of_the_cloth_is_kept_and_told_again_a_full_disk_is_not(self, work, monkeypatch):
        def diverging(*arguments, **options):
            raise DivergedError(3, [0], "test")

        def full(*arguments, **options):
            raise OutputError("Cannot write there.")

        path = work / "out/small/density_known/0000.json"
        monkeypatch.setattr(coverage, "intervals_of", full)
        assert "Cannot write there" in study(*COVERAGE, "--recordings", 1, "--fix", "density").errors
        assert not path.exists()
        monkeypatch.setattr(coverage, "intervals_of", diverging)
        for _ in range(2):
            done = study(*COVERAGE, "--recordings", 1, "--fix", "density")
            assert "diverged" in done.errors
            assert done.result["failures"]
        assert "error" in json.loads(path.read_text())

    def test_records_of_other_calls_are_told(self, work):
        study(*COVERAGE, "--fix", "density")
        said = study(*COVERAGE, "--fix", "density", "--recordings", 1, "--seed", 5).errors
        assert "density_known holds 1 records of earlier calls" in said

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (("--checkpoint", "of_lift.safetensors"), "was trained for lift, which is not among the scenarios"),
            (("--refits", 2, "--checkpoint", "of_lift.safetensors"), "leave out --checkpoint or --refits"),
            (
                ("--checkpoint", "one.safetensors", "--checkpoint", "other.safetensors"),
                "one kind of network and one scenario",
            ),
            (("--fix", "air_density"), "--fix names a fitted parameter"),
            (("--fix", "density", "--fix", "stretching"), "Nothing is left to fit"),
        ],
    )
    def test_what_is_asked_for_must_make_sense(self, work, options, message):
        regressor("posterior", scenario="small").write(work / "one.safetensors")
        regressor("posterior", scenario="small").write(work / "other.safetensors")
        regressor("mlp", scenario="lift").write(work / "of_lift.safetensors")
        assert message in study(*COVERAGE, *options, code=1).errors
        assert not list((work / "out").rglob("*.json"))

    @pytest.mark.parametrize("name", ["self_friction", "shear"])
    def test_what_is_not_drawn_or_may_be_zero_is_refused_before_anything_is_fitted(self, work, name):
        told = {"fit": {**PARAMS["fit"], "uncertain": None, "parameters": ["stretching", name]}}
        (work / "params.yaml").write_text(yaml.safe_dump(told))
        assert f"not {name}" in study(*COVERAGE, code=1).errors
        assert not list((work / "out").rglob("*.json"))

    def test_further_material_is_drawn_as_it_is_doubted(self, work):
        before = coverage_truth(work)
        told = {"fit": {**PARAMS["fit"], "uncertain": None, "parameters": ["stretching", "density", "bending"]}}
        (work / "params.yaml").write_text(yaml.safe_dump(told))
        after = coverage_truth(work)
        assert after == before
        done = study(*COVERAGE, "--recordings", 1)
        assert set(done.result["parameters"]) == {"stretching", "density", "bending"}

    def test_another_level_or_factor_does_not_mix(self, work):
        study(*COVERAGE, "--recordings", 1)
        assert "level 0.9" in study(*COVERAGE, "--recordings", 1, "--level", 0.8, code=1).errors
        (work / "out/small/free/0000.json").rename(work / "out/small/free/0007.json")  # whichever cloths they are of
        assert "level 0.9" in study(*COVERAGE, "--recordings", 1, "--level", 0.8, code=1).errors
        (work / "out/small/free/0007.json").rename(work / "out/small/free/0000.json")
        path = work / "out/small/free/0000.json"
        assert json.loads(path.read_text())["intervals"]["within"] == 2.0
        (work / "params.yaml").write_text(yaml.safe_dump({"fit": {**PARAMS["fit"], "identified_factor": 1.2}}))
        study(*COVERAGE, "--recordings", 1)
        assert json.loads(path.read_text())["intervals"]["within"] == 1.2


def coverage_truth(folder):
    config = load_config(folder / "params.yaml")
    config = config.model_copy(update={"fit": config.fit.model_copy(update={"uncertain": None})})
    return coverage.CoverageJob(choose_scenario("lift"), 3, 5, (), 0.9, "same", config, folder / "out").truth()


def test_refusals_and_failures_count_as_misses(tmp_path):
    def record(value, low, high, status="identified"):
        entry = {"value": value, "low": low, "high": high, "nominal": 1.0, "status": status}
        return {
            "truth": {"stretching": 1.0, "density": 1.0},
            "intervals": {"parameters": {"stretching": entry}, "within": 1.5, "level": 0.9},
        }

    folder = tmp_path / "lift" / "density_known"
    folder.mkdir(parents=True)
    records = [
        record(1.1, 0.9, 1.4),
        record(1.2, 1.15, 1.3),
        record(2.0, 1.5, 2.5),
        record(1.0, None, None, "the fit has not arrived"),
        {"truth": {"stretching": 1.0, "density": 1.0}, "error": "diverged"},
    ]
    for index, one in enumerate(records):
        (folder / f"{index:04d}.json").write_text(json.dumps(one))
    told = counted(folder)["parameters"]["stretching"]
    assert (told["n"], told["stated"], told["covered"]) == (5, 3, 1)
    assert told["statuses"] == {"identified": 3, "the fit has not arrived": 1}
    assert told["identified_within"] == 2
    assert told["rms_error"] == pytest.approx(math.sqrt((math.log(1.1) ** 2 + math.log(1.2) ** 2 + math.log(2) ** 2) / 4))
    assert told["sources"] == {}
    assert "| lift | density known | stretching | 5 | 3 | 1 (20 %) |" in coverage_page(counts_of(tmp_path))


def test_rows_of_one_kind_of_truth_are_counted_together(tmp_path):
    """Of twenty recordings, 14 to 20 are in the band of 90 %; networks have rows of their own, and refits none."""
    for folder, held in {
        "free": 16,
        "density_known": 13,
        "density_known_finer": 15,
        "posterior": 0,
        "mlp_finer": 0,
        "free_refits": 20,
    }.items():
        (tmp_path / "lift" / folder).mkdir(parents=True)
        for index in range(20):
            entry = {"value": 1.0, "low": 0.9 if index < held else 1.1, "high": 1.2, "nominal": 1.0, "status": "identified"}
            told = {"parameters": {"stretching": entry}, "within": 1.5, "level": 0.9}
            record = {"truth": {"stretching": 1.0, "density": 1.0}, "intervals": told}
            (tmp_path / "lift" / folder / f"{index:04d}.json").write_text(json.dumps(record))
    page = coverage_page(counts_of(tmp_path))
    assert "| same | 2 | 40 | 29 (72 %) | 1 of 2 |" in page
    assert "| finer | 1 | 20 | 15 (75 %) | 1 of 1 |" in page
    assert "| refined |" not in page
    assert "In 29 (72 %) of 40 cases (same), 15 (75 %) of 20 cases (finer), 0 (0 %) of 20 cases (mlp finer), 0 " in page
    check_form(page)


def test_refits_hold_what_nine_of_ten_find_within_the_factor(tmp_path):
    """Of ten refits of each of four cloths: the first has one beside, the second two; the third's fits fail twice, the
    fourth's always. Verdicts have nothing to do with it."""
    folder = tmp_path / "lift" / "free_refits"
    folder.mkdir(parents=True)
    for cloth, beside in enumerate((1, 2, 0, 0)):
        for refit in range(10):
            value, status = 2.0 if refit < beside else 1.2, "identified" if refit < 6 else "not_identified"
            entry = {"value": value, "low": 1.0, "high": 2.0, "nominal": 1.0, "status": status}
            told = {"intervals": {"parameters": {"stretching": entry}, "within": 1.5, "level": 0.9}}
            record = {"truth": {"stretching": 1.0, "density": 1.0}, **told}
            if cloth == 3 or (cloth == 2 and refit > 7):
                record = {"truth": record["truth"], "error": "diverged"}
            (folder / f"{cloth:04d}_{refit:02d}.json").write_text(json.dumps(record))
    told = counted(folder)["refits"]["stretching"]
    assert told == {"cloths": 4, "held": 1, "identified": (6, 10), "others": (12, 30)}
    assert "| lift | free | stretching | 4 | 1 | 6 of 10 (60 %) | 12 of 30 (40 %) |" in coverage_page(counts_of(tmp_path))


def test_sources_are_told_beside_what_noise_alone_would_hold(tmp_path):
    """Of two recordings off by 20 %, the noise of one accounts for that."""
    folder = tmp_path / "lift" / "density_known"
    folder.mkdir(parents=True)
    for index, noise in enumerate((0.07, 0.13)):
        entry = {"value": math.exp(0.2), "low": 1.0, "high": 2.0, "nominal": 1.0, "status": "identified"}
        sources = {"recording": {"stretching": noise}, "step size": {"stretching": 0.3}, "prior": {"stretching": 0.0}}
        told = {"parameters": {"stretching": entry}, "within": 1.5, "level": 0.9, "sources": sources}
        record = {"truth": {"stretching": 1.0, "density": 1.0}, "intervals": told}
        (folder / f"{index:04d}.json").write_text(json.dumps(record))
    told = counted(folder)["parameters"]["stretching"]
    assert told["noise_alone"] == 1  # the quantile is 1.64
    assert told["sources"] == pytest.approx({"recording": 0.1, "step size": 0.3, "prior": 0.0})
    assert "| lift | density known | stretching | 1 (50 %) | step size 90 %, recording 10 % |" in coverage_page(
        counts_of(tmp_path)
    )


def test_a_page_is_of_one_level(tmp_path):
    for place, level in enumerate((0.9, 0.5)):
        folder = tmp_path / "lift" / ("free" if place else "density_known")
        folder.mkdir(parents=True)
        entry = {"value": 1.0, "low": 0.9, "high": 1.1, "nominal": 1.0, "status": "identified"}
        told = {"parameters": {"stretching": entry}, "within": 1.5, "level": level}
        (folder / "0000.json").write_text(json.dumps({"truth": {"stretching": 1.0, "density": 1.0}, "intervals": told}))
    with pytest.raises(ConfigError, match=r"one level of intervals, got 0\.5, 0\.9"):
        coverage_page(counts_of(tmp_path))
    (tmp_path / "lift" / "density_known" / "0000.json").unlink()
    page = coverage_page(counts_of(tmp_path))
    assert "How often do 50 % intervals contain the true value?" in page
    assert "exactly 50 %" in page
    check_form(page)
