"""Sentences that state until when a simulation follows the recordings."""

from __future__ import annotations

import pytest

from diffcloud.estimation.record import EstimateRecord, Followed
from diffcloud.reporting.fit_page import followed_until
from tests.estimation.records import record_of, recording_of


def told(*recordings):
    """By recordings of frames 0.2 s apart. Each is given by c of its frames, and by whether it departs after them."""
    episodes, followed = [], []
    for name, (squares, departs) in zip(("towel", "shirt"), recordings, strict=False):
        one = [1.0] * len(squares)
        episodes.append(recording_of(name, frames=[*range(1, len(squares) + 1)], frame_rms_mm=one, counted=one))
        followed.append(Followed(horizon_s=0.2 * len(squares), departs=departs, chi_squares=squares, finer_mm=one))
    estimate = EstimateRecord(mean={}, sources={}, starts=[{}], weights=[1.0], recordings=followed)
    return followed_until(record_of(*episodes, estimate=estimate))


GOOD = [0.5, 1.0, 1.4, 0.8]


@pytest.mark.parametrize(
    ("squares", "departs", "end"),
    [
        (GOOD, False, "follows towel to within noise and mesh error up to the horizon, 0.8 s."),
        (GOOD, True, "follows towel to within noise and mesh error until 0.8 s, and then departs from it."),
        (
            [0.5, 0.5, 1.6, 0.5],
            False,
            "follows towel to within noise and mesh error until 0.4 s, and then departs from it.",
        ),
        ([1.6, 0.5], False, "does not follow towel from the first frame on."),
    ],
)
def test_one_recording(squares, departs, end):
    assert told((squares, departs)) == [f"The simulation {end}"]


def test_two_recordings_of_which_one_departs():
    first, second = told((GOOD, True), (GOOD, False))
    assert first.startswith("The simulation follows shirt ")
    assert first.endswith(" up to the horizon, 0.8 s.")
    assert second.startswith("The simulation follows towel ")
    assert second.endswith(" until 0.8 s, and then departs from it.")
