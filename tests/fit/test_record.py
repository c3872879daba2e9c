"""What a record says of its recordings."""

from __future__ import annotations

import pytest

from diffcloud.errors import ConfigError
from tests.fit.records import record_of, recording_of


def test_two_recordings_of_one_name_are_told_apart_by_their_scenario():
    record = record_of(recording_of("a"), recording_of("b"), recording_of("a", scenario="fold"))
    assert record.place_of("b") == 1
    assert record.place_of("b", "other.yaml") == 1
    assert [record.place_of("a", name) for name in ("lift", "fold")] == [0, 2]
    for scenario in (None, "other.yaml"):
        with pytest.raises(ConfigError, match="The fit knows a in fold and lift; choose one by --scenario"):
            record.place_of("a", scenario)
    with pytest.raises(ConfigError, match="Unknown recording of the fit 'c'"):
        record.place_of("c")
