"""The table of how recordings lie."""

from __future__ import annotations

from diffcloud.estimation.record import LeftOut, NuisanceValue
from diffcloud.reporting.poses import poses_table
from tests.reporting.pages import entry


def test_poses_are_shown_in_millimetres_and_degrees_and_pointed_out_beyond_their_priors():
    found = poses_table([("lift / tan1", entry().fit)])
    cells = dict(zip(found.heads, found.rows[0], strict=True))
    assert [cells[head].text for head in ("fit", "recording", "RMS mm")] == ["lift / tan1", "tan1", "10.0"]
    assert cells["RMS mm"].note == "10.0 in frame 1"
    assert (cells["x mm"].text, cells["x mm"].note) == ("210.0", "beyond its prior")
    assert (cells["yaw °"].text, cells["yaw °"].note) == ("5.7", "")
    assert cells["points that count"].text == "80 %"
    assert cells["cut mm"].text == "–"


def test_a_joint_fit_shows_what_the_others_say_of_each():
    one, other = entry("a").fit, entry("b").fit
    assert "RMS mm by the others" not in poses_table([("a", one)]).heads
    one.episodes[0].left_out = LeftOut(loss=1e-4, rms_mm=11.3, parameters={})
    found = poses_table([("a", one), ("b", other)])
    assert found.heads[-1] == "RMS mm by the others"
    assert [row[-1].text for row in found.rows] == ["11.3", "–"]


def test_what_a_fit_did_not_free_is_a_dash():
    one, other = entry("a").fit, entry("b").fit
    other.episodes[0].nuisance = {}
    other.episodes[0].rms_to_cloth_mm = None  # the paper's measure has one direction
    found = poses_table([("a", one), ("b", other)])
    row = dict(zip(found.heads, found.rows[1], strict=True))
    assert row["x mm"].text == row["cloud to cloth mm"].text == "–"


def test_waves_of_an_uneven_cloth_are_one_number():
    one = entry("a").fit
    waves = {f"shape_{i}_{j}": height for (i, j), height in {(0, 1): 0.003, (1, 0): -0.004}.items()}
    one.episodes[0].nuisance = {
        "turn": NuisanceValue(value=0.1, prior=0.04, unit="rad", of="cloth"),
        **{name: NuisanceValue(value=value, prior=0.005, unit="m", of="cloth") for name, value in waves.items()},
    }
    found = poses_table([("a", one)])
    row = dict(zip(found.heads, found.rows[0], strict=True))
    assert (row["turn °"].text, row["turn °"].note) == ("5.7", "beyond its prior")
    assert (row["shape mm"].text, row["shape mm"].note) == ("3.5", "")  # their RMS
    assert not waves.keys() & {head.split()[0] for head in found.heads}
