"""Fingerprints: equal for equal plans in every process, different for any change."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from diffcloud.io.fingerprints import _described, fingerprint
from diffcloud.scene.scenarios import built_in, make_scenario


def mark(plan):
    return fingerprint(plan, packages=())


class TestFingerprint:
    def test_a_function_is_known_by_its_name(self):
        assert _described([np.mean, make_scenario]) == [
            "numpy.mean",
            f"{make_scenario.__module__}.make_scenario",
        ]

    def test_a_scenario_is_known_by_its_values(self):
        lift = built_in("lift")
        assert mark(make_scenario(lift)) == mark(make_scenario(type(lift).model_validate(lift.model_dump())))
        assert "0x" not in str(_described(make_scenario(lift)))

    def test_any_change_counts(self):
        lift = make_scenario(built_in("lift"))
        plans = [
            lift,
            replace(lift, name="other"),
            [lift],
            np.zeros(2),
            np.zeros(3),
            np.zeros(2, np.float32),
            np.ones(2),
            "0",
            0,
        ]
        assert len({mark(plan) for plan in plans}) == len(plans)

    @pytest.mark.parametrize("value", [object(), functools.partial(make_scenario)])
    def test_what_only_an_address_tells_apart_is_refused(self, value):
        with pytest.raises(TypeError, match="address in memory"):
            mark({"value": value})
