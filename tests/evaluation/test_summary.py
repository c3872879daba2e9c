"""Tables and sentences from made-up records with known answers."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from diffcloud.evaluation.page import comparison_page
from diffcloud.evaluation.repeats import consistency, other_repeats, parameter_table, repeatability, transfer
from diffcloud.evaluation.summary import (
    against_predictors,
    against_reference,
    fit_table,
    headline,
    metrics,
    overview,
    percent,
    sentences,
    tables,
)
from diffcloud.io.fingerprints import fingerprint
from tests.docs.form import check_form
from tests.evaluation.records import record, records


@pytest.fixture
def told():
    return tables(records(), {("lift", "tan1"): {"diffcloud": {"optimisation": 3.0}, "mlp": {"training": 10.0}}})


def test_means_and_who_is_best(told):
    means = told["means"].set_index(["scenario", "method"])
    assert means.loc[("lift", "diffcloud"), "loss"] == pytest.approx(0.0015)
    assert means.loc[("lift", "diffcloud"), "best"] == 2
    assert means.loc[("lift", "mlp"), "best"] == 1  # its loss on tan1 is within the noise of the lowest
    assert means.loc[("lift", "middle"), "best"] == 0


def test_against_predictors_compares_means_of_the_same_episodes(told):
    row = against_predictors(told["methods"]).set_index("scenario").loc["lift"]
    assert (row["lowest"], row["episodes"], row["predictor"]) == (2, 2, "mlp")
    assert row["below"] == pytest.approx(1 - 0.0015 / 0.00252)


def test_a_predictor_that_fails_in_a_hard_episode_looks_no_better_for_it():
    told = [
        record("lift", "easy", methods={"diffcloud": 0.001, "mlp": 0.002, "pointnet2": 0.003}),
        record("lift", "hard", methods={"diffcloud": 0.010, "mlp": 0.015}),
    ]
    (row,) = against_predictors(tables(told, {})["methods"]).to_dict("records")
    assert (row["predictor"], row["loss"], row["predictor_loss"]) == ("mlp", pytest.approx(0.0055), pytest.approx(0.0085))
    assert row["below"] == pytest.approx(1 - 0.0055 / 0.0085)


def test_reference_fits_are_a_column_with_a_tolerance_of_five_percent():
    references = {("lift", "tan1"): 0.00096, ("lift", "tan2"): 0.0019}
    table = tables(records(), {}, references)["methods"]
    assert against_reference(table) == (1, 2)
    assert against_reference(tables(records(), {})["methods"]) is None


def test_gaps_have_a_row_and_a_reason(told):
    gaps = told["methods"][told["methods"]["status"] == "missing"]
    assert gaps[["episode", "method", "reason"]].to_numpy().tolist() == [["tan1", "meteornet", "no checkpoint"]]


def test_metrics_are_plain_numbers(told):
    found = metrics(told)
    assert found["methods"]["lift"]["diffcloud"]["episodes"] == 2
    assert not any(isinstance(value, float) and math.isnan(value) for value in found["methods"]["lift"]["mlp"].values())
    assert found["statuses"]["lift"]["stretching"] == {"ratio_only": 2}


def test_the_headline_is_small_rounded_and_knows_no_time():
    """RMS in millimetres of losses 0.001 and 0.003 in m²; ratios of 1 and 2 where the truth is 0.5: factors 2 and 4."""
    truth = {"stretching": 0.5, "density": 1.0}
    known = [
        record("lift", "a", methods={"diffcloud": 0.001, "middle": 0.01, "mlp": 0.02}, truth=truth),
        record("lift", "b", methods={"diffcloud": 0.003, "middle": 0.01}, truth=truth, stretch=2.0),
        record("fold", "c", methods={"diffcloud": 0.004}),
    ]
    found = headline(tables(known, {("lift", "a"): {"diffcloud": {"optimisation": 3.0}}}))
    rms_mm = {name: 1e3 * math.sqrt(loss) for name, loss in (("first", 0.001), ("second", 0.003), ("middle", 0.01))}
    assert found["lift"]["rms_mm"]["diffcloud"] == pytest.approx((rms_mm["first"] + rms_mm["second"]) / 2, abs=0.005)
    assert found["lift"]["rms_mm"]["middle"] == 100.0
    assert set(found["lift"]["rms_mm"]) == {"diffcloud", "middle"}  # trained weights depend on the processor
    assert found["lift"]["ratio_factor"] == pytest.approx(math.sqrt(8), abs=5e-4)  # the median of factors is geometric
    assert "ratio_factor" not in found["fold"]
    assert all(float(f"{value:.4g}") == value for value in found["lift"]["rms_mm"].values())


def test_a_fit_has_a_row_with_what_its_start_and_its_end_are_worth():
    truth = {"stretching": 0.5, "density": 1.0}
    told = [
        record("lift", "joint-a", fit="joint", methods={"diffcloud": 0.001}, truth=truth, start=0.02),
        record("lift", "joint-b", fit="joint", methods={"diffcloud": 0.003}, truth=truth, start=0.04),
        record("fold", "a", stretch=8.0, methods={"diffcloud": 0.004}, start=None),  # whose start diverges
        record("fold", "b", methods={"middle": 0.004}),  # whose fit diverges
    ]
    told[2]["methods"][0]["values"]["turn"] = -0.1  # how the cloth lay is not what the cloth is
    table = fit_table(told)
    assert "fitted_turn" not in table
    assert table[["scenario", "episode"]].to_numpy().tolist() == [["lift", "joint"], ["fold", "a"]]
    assert table["loss"].tolist() == pytest.approx([0.002, 0.004])
    assert table["rms_mm"].tolist() == pytest.approx([1e3 * 0.002**0.5, 1e3 * 0.004**0.5])
    assert table["loss_start"].tolist() == pytest.approx([0.03, math.nan], nan_ok=True)
    assert table["fitted_ratio"].tolist() == pytest.approx([1.0, 8.0])
    assert table["true_ratio"].tolist() == pytest.approx([0.5, math.nan], nan_ok=True)


class TestRepeats:
    def test_repeatability_is_the_largest_over_the_smallest(self):
        table = repeatability(parameter_table(records())).set_index(["scenario", "parameter"])
        assert table.loc[("lift", "stretching"), "factor"] == pytest.approx(2.0)
        assert table.loc[("lift", "ratio"), "factor"] == pytest.approx(2.0)
        assert ("fold", "stretching") not in table.index  # one recording has no spread

    def test_recordings_of_a_joint_fit_agree_because_they_were_made_to(self):
        joint = [record("lift", f"joint-{name}", fit="joint") for name in ("tan1", "tan2")]
        assert parameter_table(joint).empty
        assert repeatability(parameter_table(joint)).empty
        pd.testing.assert_frame_equal(parameter_table(records() + joint), parameter_table(records()))

    def test_transfer_between_own_fit_and_middle(self):
        (row,) = transfer(records()).to_dict("records")
        assert (row["source"], row["target"]) == ("tan2", "tan1")
        assert row["gain"] == pytest.approx((0.01 - 0.004) / (0.01 - 0.001))

    def test_consistency_compares_geometric_means(self):
        table = consistency(parameter_table(records())).set_index("parameter")
        assert table.loc["stretching", "value_first"] == pytest.approx(math.sqrt(2.0))
        assert table.loc["stretching", "factor"] == pytest.approx(8.0 / math.sqrt(2.0))

    def test_labels_of_simulated_targets_name_no_cloth(self):
        simulated = [
            record("lift", "a", fabric="hidden1", truth={"stretching": 1.0}),
            record("fold", "b", fabric="hidden1"),
        ]
        assert consistency(parameter_table(simulated)).empty

    def test_other_repeats_are_of_the_same_fabric(self):
        metas = {"a": {"fabric": "tan"}, "b": {"fabric": "tan"}, "c": {"fabric": "navy"}, "d": {}, "e": {}}
        fits = {name: {"stretching": 1.0} for name in metas}
        found = other_repeats(metas, fits)
        assert {name: list(others) for name, others in found.items()} == {"a": ["b"], "b": ["a"], "c": [], "d": [], "e": []}


class TestWords:
    def test_sentences_say_who_wins_and_what_is_known(self, told):
        said = sentences(told)
        assert "DiffCloud has the lowest mean loss over 2 episodes" in said["winners"][0]
        told_of = " ".join(said["intervals"])
        assert "status of stretching: ratio only in 2 of 2 episodes; 90% intervals end within a factor of 2" in told_of
        assert "lift: stretching / density is known within a factor of 1.07 (median)." in told_of
        assert "lift / tan2: the misfit is 14.2 mm." in told_of
        assert "lift / tan1: the loss is 1.7 times what noise leaves." in told_of
        assert any("by a factor of 2 in stretching" in line for line in said["repeats"])

    @pytest.mark.parametrize(("ends", "disagree"), [((3.0, 4.0), True), ((0.1, 0.2), True), ((0.1, 9.0), False)])
    def test_a_posterior_is_a_second_opinion(self, ends, disagree):
        one = record("lift", "tan1", methods={"diffcloud": 0.001, "posterior": 0.002})
        one["methods"][1]["intervals"] = {"stretching": list(ends)}
        told = tables([one], {})
        row = told["intervals"].set_index("parameter").loc["stretching"]
        assert row["low"] < 4 < row["high"] < 12
        assert (row["posterior_low"], row["posterior_high"]) == (4 * ends[0], 4 * ends[1])
        said = [line for line in sentences(told)["intervals"] if "posterior" in line]
        assert len(said) == disagree
        assert all("fit and posterior disagree on stretching by more than their widths" in line for line in said)

    def test_credibility_holds_one_recording_against_repeats_and_another_motion(self, told):
        said = sentences(told)["credibility"]
        stretch = next(line for line in said if "stretching" in line)
        assert "differ by a factor of 2, at most 2, another motion of it by a factor of 5.66, at most 5.66" in stretch
        assert "not for the fabric" in stretch
        mass = next(line for line in said if "density" in line)
        assert "holds beyond its own recording" in mass

    def test_overview_has_a_row_per_scenario(self, told):
        row = overview(told).iloc[0]
        assert (row["first"], row["second"], row["status_stretching"]) == ("DiffCloud", "MLP", "ratio only (2/2)")

    def test_markdown_has_every_table_and_what_is_missing(self, told):
        page = comparison_page(told, ["lift/tan1: meteornet: no checkpoint"], "Tea towels", "make towels")
        assert page.startswith(
            "# Tea towels: which method has the lowest loss?\n\nDiffCloud has the lowest mean loss in lift ("
        )
        assert "1 expected results are missing." in page
        for heading in ("Loss per episode", "Means", "What is identified", "Transfer between repeats", "What is missing"):
            assert f"<summary>{heading}</summary>" in page
        assert "nan" not in page.lower()
        check_form(page)

    def test_nothing_at_all(self):
        told = tables([record("lift", "e", methods={"diffcloud": 0.1}, stated=False)], {})
        assert sentences(told)["repeats"] == []
        assert isinstance(overview(told), pd.DataFrame)
        page = comparison_page(told, [], "Tea towels", "make towels")
        assert "What is identified" not in page
        check_form(page)


def test_fingerprints_tell_inputs_apart():
    import numpy as np

    one = fingerprint([{"a": np.arange(3)}, "x"], packages=["io"])
    assert one == fingerprint([{"a": np.arange(3)}, "x"], packages=["io"])
    assert one != fingerprint([{"a": np.arange(4)}, "x"], packages=["io"])
    assert one != fingerprint([{"a": np.arange(3)}, "x"], packages=["mesh"])


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.0, "0 %"),
        (1.0, "100 %"),
        (0.42, "42 %"),
        (0.9949, "99 %"),
        (0.0042, "0.4 %"),
        (0.0004, "less than 0.1 %"),
        (1e-12, "less than 0.1 %"),
        (0.997, "99.7 %"),
        (0.9999, "more than 99.9 %"),
        (1.254, "125 %"),
    ],
)
def test_no_share_is_rounded_to_nothing_or_to_all(share, text):
    assert percent(share) == text
