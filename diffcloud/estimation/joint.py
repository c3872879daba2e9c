"""One set of parameters for several recordings of one cloth, which may show different motions.

The residual level of a recording depends on its noise and on the model error. It is unknown and differs between
recordings. If each recording has its own variance, the joint likelihood is maximal where the geometric mean of the
losses is minimal:

    loss = (∏ loss_i)^(1/n)

A relative change of the loss then has the same weight in every recording. The loss of the paper uses the arithmetic
mean.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from diffcloud.errors import ConfigError
from diffcloud.estimation.names import of_recording
from diffcloud.estimation.objective import Objective
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import PARAMETERS
from diffcloud.sim.threads import map_threads

_TINY = 1e-300
_SAME = 1e-6


class JointObjective:
    """Losses of a batch of parameter sets on several recordings."""

    def __init__(self, members: Sequence[Objective]) -> None:
        """Combine the objectives of single recordings.

        Raises:
            ConfigError: the objectives differ in loss, length unit or nominal material.
        """
        self.members = tuple(members)
        self.paper = members[0].paper
        if any(one.paper != self.paper for one in members):
            raise ConfigError("A joint fit compares all recordings in one measure: the paper's, or the default one.")
        for one in members[1:]:
            check_same_cloth(members[0].scenario, one.scenario)

    @property
    def length_unit_m(self) -> float:
        return self.members[0].length_unit_m

    def __call__(self, parameters: Mapping[str, Tensor]) -> Tensor:
        """Return losses [B]; see `Objective`.

        Args:
            parameters: name -> [B]; `estimation.names` explains the names of variables that belong to one recording.
        """
        own = [(one, of_recording(parameters, index)) for index, one in enumerate(self.members)]
        return mean_loss(torch.stack(map_threads(lambda pair: pair[0](pair[1]), own)), paper=self.paper)

    def earliest(self, counts: Sequence[int]) -> JointObjective:
        """See `Objective.earliest`, with one count per recording."""
        return JointObjective([one.earliest([count]) for one, count in zip(self.members, counts, strict=True)])

    def reseed(self, seed: int) -> None:
        """Sample new points on the cloth and in the clouds."""
        for one in self.members:
            one.reseed(seed)


AnyObjective = Objective | JointObjective
"""Function that a solver minimises."""


def mean_loss(losses: Tensor, *, paper: bool) -> Tensor:
    """Average losses [n, B] over n recordings: geometric mean, or arithmetic mean for the loss of the paper."""
    return losses.mean(0) if paper or len(losses) == 1 else losses.clamp(min=_TINY).log().mean(0).exp()


def check_same_cloth(first: Scenario, other: Scenario) -> None:
    """Check that multipliers have the same meaning in two scenarios.

    Raises:
        ConfigError: they do not; names the parameter and its value in each scenario.
    """
    for told, one, two in (
        ("are in length units of", first.length_unit_m, other.length_unit_m),
        ("move mass and stiffness of nodes", _sets(first), _sets(other)),
        ("have a compression of", first.scene.material.compression, other.scene.material.compression),
    ):
        if one != two:
            raise ConfigError(f"A joint fit is of one cloth: {first.name} and {other.name} {told} {one} and {two}.")
    for parameter in PARAMETERS.values():
        if parameter.quantity in ("stretching", "shear", "bending", "density"):
            values = first.scene.nominal(parameter.quantity), other.scene.nominal(parameter.quantity)
            unit = "" if parameter.unit == "–" else f" {parameter.unit}"
            if abs(values[0] - values[1]) > _SAME * max(values):
                raise ConfigError(
                    f"A joint fit is of one cloth, whose {parameter.name} = 1 means {values[0]:g}{unit} in "
                    f"{first.name} and {values[1]:g} in {other.name}. Give both scenarios the same material."
                )


def _sets(scenario: Scenario) -> dict[str, int]:
    """Return parameter -> number of nodes, for the parameters that act on a part of the cloth."""
    return {name: len(nodes) for name, nodes in scenario.node_sets.items()}
