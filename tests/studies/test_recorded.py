"""The page of the published recordings, of made-up fits."""

from __future__ import annotations

import pytest

from diffcloud.errors import ConfigError
from studies import recorded as study
from tests.docs.form import check_form
from tests.estimation.records import parameter_of, record_of, recording_of


def fit(name, stretch, rms=8.0, **changes):
    yaw = {"value": 0.1, "prior": 0.5, "unit": "rad", "of": "pose"}
    x = {"value": 0.03, "prior": 0.1, "unit": "m", "of": "pose"}
    scenario = "recorded_lift" if name.startswith("lift") else "recorded_fold"
    parameters = {
        "stretching": parameter_of(value=stretch, **changes),
        "density": parameter_of(value=0.2),
        "bending": parameter_of(value=4e-6),
        "compression": parameter_of(multiplier=0.12),
        "shear": parameter_of(multiplier=0.9),
    }
    one = recording_of(name, scenario=scenario, nuisance={"yaw": yaw, "x": x}, frames=[16, 17], frame_rms_mm=[1.0, 1.0],
                       counted=[0.5, 0.5])  # fmt: skip
    return record_of(one, scenario=scenario, parameters=parameters, rms_mm=rms)


def test_the_page_has_means_rows_and_repeats():
    fits = {
        "lift_tan": fit("lift_tan", 20.0, 8.0),
        "lift_tan2": fit("lift_tan2", 26.0, 10.0, at_bound=True),
        "fold_tan": fit("fold_tan", 20.0, 5.0),
        "fold_tan2": fit("fold_tan2", 60.0, 6.0),
    }
    page = study.page(fits)
    assert "The mean RMS distance is 9.0 mm (recorded_lift) and 5.5 mm (recorded_fold)." in page
    assert "| recorded_lift | 2 | 9.0 | 1 of 1 |" in page
    assert "| recorded_fold | 2 | 5.5 | 0 of 1 |" in page
    assert "| lift_tan | 8.0 | 12.0, 7.5 | 2 | 100 | 4 | 0.12 | 0.9 | 3.0 | 5.7° | 2 |" in page
    assert "| lift_tan2 | 10.0 | 12.0, 7.5 | 2 | 130* |" in page
    assert "within a factor of 1.5 in 1 of 2 pairs" in page
    assert "| lift_tan | 1.30 |" in page
    assert "| fold_tan | 3.00 |" in page
    check_form(page)


def test_a_folder_without_episodes_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="holds no episodes"):
        study.main(tmp_path, tmp_path / "fits", tmp_path / "page.md", 1)
