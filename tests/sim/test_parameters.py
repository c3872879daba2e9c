"""One table of parameters serves bounds, units, record and documentation."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch

from diffcloud.errors import ConfigError
from diffcloud.estimation.result import physical_values
from diffcloud.scene.scenarios import load_scenario
from diffcloud.sim.properties import PARAMETERS, check_values
from tests.conftest import small_lift

_PAGE = (Path(__file__).parents[2] / "docs" / "concepts.md").read_text(encoding="utf-8")
_SECTION = _PAGE.split("\n## Parameters\n")[1].split("\n## ")[0]
NOT_IN_A_LIFT = {"body_mass", "added_mass", "linear_drag"}
DOCUMENTED = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+?) \|$", _SECTION, flags=re.MULTILINE)


def test_the_documentation_has_the_same_rows():
    assert [(parameter.name, parameter.meaning, parameter.unit) for parameter in PARAMETERS.values()] == DOCUMENTED


@pytest.mark.parametrize("name", PARAMETERS)
def test_every_parameter_has_bounds_it_allows_and_a_value_in_si(name):
    parameter = PARAMETERS[name]
    check_values({name: parameter.bounds[0]}, "the lower bound of")
    check_values({name: parameter.bounds[1]}, "the upper bound of")
    told = physical_values(load_scenario("lift"), {name: 0.5})[name]
    assert told.unit == parameter.unit
    assert told.meaning == parameter.meaning
    if parameter.quantity is None:
        assert told.value == 0.5
    elif name not in NOT_IN_A_LIFT:
        assert told.value == 0.5 * load_scenario("lift").scene.nominal(parameter.quantity) > 0


@pytest.mark.parametrize("name", PARAMETERS)
def test_every_parameter_changes_the_properties_it_is_named_for(name):
    scenario = small_lift(air="still")
    system, _ = scenario.scene.build()
    moved, base = (
        scenario.properties(system, {name: torch.tensor([value], dtype=torch.float64)}).tensors() for value in (0.7, 0.35)
    )
    changed = [a.numel() > 0 and not torch.equal(a, b) for a, b in zip(moved, base, strict=True)]
    assert any(changed) == (name != "body_mass")  # the lift has no bodies


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"strech": 1.0}, "--set: Unknown parameter 'strech'. Did you mean 'stretching'?"),
        ({"stretching": 0.0}, "--set stretching must be above 0, got 0; the lowest usual value is 0.1"),
        ({"body_mass": -1.0}, "--set body_mass must be above 0"),
        ({"damping": -0.1}, "--set damping must not be negative, got -0.1; the nearest allowed value is 0"),
        ({"compression": 1.1}, "--set compression is at most 1, got 1.1"),
        ({"density": float("nan")}, "--set density must be a finite number"),
        ({"density": float("inf")}, "--set density must be a finite number"),
    ],
)
def test_values_that_a_parameter_cannot_have(values, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        check_values(values, "--set")


def test_a_parameter_without_effect_is_refused():
    with pytest.raises(ConfigError, match="body_mass has no effect in lift, whose scene has no rigid bodies"):
        load_scenario("lift").check_parameters(["stretching", "body_mass"])
    with pytest.raises(ConfigError, match="compression has no effect in lift, whose cloth resists compression in full"):
        load_scenario("lift").check_parameters(["compression"])
    load_scenario("recorded_lift").check_parameters(["compression"])
