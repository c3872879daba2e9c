"""What a record says of its recordings."""

from __future__ import annotations

import pytest

from diffcloud.errors import ConfigError
from diffcloud.estimation.result import whole_material
from tests.conftest import small_lift
from tests.estimation.records import record_of, recording_of


def test_two_recordings_of_one_name_are_told_apart_by_their_scenario():
    record = record_of(recording_of("a"), recording_of("b"), recording_of("a", scenario="fold"))
    assert record.place_of("b") == 1
    assert record.place_of("b", "other.yaml") == 1
    assert [record.place_of("a", name) for name in ("lift", "fold")] == [0, 2]
    for scenario in (None, "other.yaml"):
        with pytest.raises(ConfigError, match="The fit knows a in fold and lift; rename one of these recordings"):
            record.place_of("a", scenario)
    with pytest.raises(ConfigError, match="Unknown recording of the fit 'c'"):
        record.place_of("c")


def test_material_of_a_record_has_the_air_that_moves_with_the_cloth():
    """Density is the cloth's own: weight per area. Added mass and linear drag are what the motion was simulated with."""
    scenario = small_lift(air="still")
    around, density = scenario.scene.surrounding, scenario.scene.material.density
    told = whole_material(scenario, {"density": 3.0, "added_mass": 2.0, "linear_drag": 0.5})
    assert told.density == pytest.approx(3 * density)
    assert told.added_mass == pytest.approx(2 * around.added_mass)
    assert told.linear_drag == pytest.approx(0.5 * around.linear_drag)
    without = whole_material(small_lift(air="drag"), {"density": 3.0})
    assert (without.added_mass, without.linear_drag) == (0.0, 0.0)
