"""How a cloth lies when its motion begins: turned under the gripper, and not quite flat.

The pose (`fit.pose`) moves cloth, gripper and bodies together, which is the same motion seen from elsewhere. A cloth that a
hand has laid down 5° askew, or with a rim that stands up, moves in another way. So these are variables of the motion, like
doubtful material (`fit.doubts`): fitted under priors, one set for a recording, and no property of the cloth.

The turn is about the cloth's middle. Its height over where the scene lays it is a sum of nine waves over the cloth,

    h(u, v) = Σ c_ij cos(π i u) cos(π j v),      u, v in [0, 1],      0 < i + j <= 3,

raised until no node is lower than before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.fit.parameters import FitSpace, Variable
from diffcloud.fit.priors import parse_deviations
from diffcloud.fit.record import NuisanceValue
from diffcloud.mesh.topology import ClothMesh
from diffcloud.scene.scenarios import Scenario
from diffcloud.sim.properties import Properties
from diffcloud.sim.simulate import init
from diffcloud.sim.system import State, System

LAID: dict[str, Literal["m", "rad"]] = {"turn": "rad", "shape": "m"}
"""Name -> unit. `shape` stands for the height of each wave."""
_SHAPES = {f"shape_{i}_{j}": (i, j) for i in range(4) for j in range(4) if 0 < i + j <= 3}
_FLAT = 1e-6
"""Part of its size by which a level cloth may be off."""
_FARTHEST = 4.0
"""Bounds, in standard deviations."""


def parse_laid(text: str) -> dict[str, float]:
    """What `--laid` says -> name -> standard deviation of its prior [m, rad], as of `parse_deviations`.

    Raises:
        ConfigError: an unknown name or unit, a unit of something else, or what is no positive number; names it.
    """
    return parse_deviations(text, "laid", LAID)


def with_laid(space: FitSpace, laid: Mapping[str, float], scenarios: Sequence[Scenario]) -> FitSpace:
    """The space with the variables appended.

    Args:
        laid: name -> standard deviation [m, rad].
        scenarios: of the recordings.

    Raises:
        ConfigError: several recordings, of which each would need its own, or a cloth that does not lie level.
    """
    if not laid:
        return space
    told = f"laid {', '.join(laid)}: "
    if len(scenarios) > 1:
        raise ConfigError(
            f"{told}the cloth lies differently in each recording, which joint fits do not support; fit them one by one."
        )
    nodes = scenarios[0].scene.mesh.nodes
    if np.ptp(nodes[:, 2]) > _FLAT * np.ptp(nodes, axis=0).max():
        raise ConfigError(f"{told}this needs a cloth that lies level at the start; that of {scenarios[0].name} does not.")
    names = [own for name in LAID if name in laid for own in (_SHAPES if name == "shape" else (name,))]
    own = [_variable(name, laid[asked_as(name)], scenarios[0].length_unit_m) for name in names]
    return FitSpace((*space.variables, *own), space.fixed)


def variables_of(described: Mapping[str, NuisanceValue], *, length_unit_m: float) -> list[Variable]:
    """Those that `described_laid` tells of.

    Raises:
        ConfigError: an unknown one.
    """
    for name in described:
        if not is_laid(name):
            raise ConfigError(unknown_name("variable of how a cloth lies", name, ["turn", *_SHAPES]))
    return [_variable(name, entry.prior, length_unit_m) for name, entry in described.items()]


def _variable(name: str, deviation: float, length_unit_m: float) -> Variable:
    """
    Args:
        deviation: [m, rad].
    """
    deviation /= length_unit_m if LAID[asked_as(name)] == "m" else 1.0
    return Variable(name, -_FARTHEST * deviation, _FARTHEST * deviation, centre=0.0, doubtful=True, deviation=deviation)


def is_laid(name: str) -> bool:
    """Whether a variable tells how a cloth lies."""
    return name == "turn" or name in _SHAPES


def asked_as(name: str) -> str:
    """The name in `LAID` under which a variable is asked for; of any other, its own."""
    return "shape" if name in _SHAPES else name


def _material_of(values: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Those that do not tell how a cloth lies."""
    return {name: value for name, value in values.items() if not is_laid(name)}


def laid_nodes(mesh: ClothMesh, values: Mapping[str, Tensor]) -> Tensor | None:
    """[B, V, 3] where a cloth starts; differentiable. None: as the scene has it.

    Args:
        values: name -> [B], those of the material too.
    """
    own = {name: value for name, value in values.items() if is_laid(name)}
    if not own:
        return None
    nodes = torch.as_tensor(mesh.nodes, dtype=torch.float64)
    batch = len(next(iter(own.values())))
    across, along = _unit_square(mesh)
    heights = torch.zeros(batch, len(nodes), dtype=torch.float64)
    for name, (i, j) in _SHAPES.items():
        if name in own:
            heights = heights + own[name][:, None] * torch.cos(torch.pi * i * across) * torch.cos(torch.pi * j * along)
    turn = own.get("turn", torch.zeros(batch, dtype=torch.float64))
    middle = nodes[:, :2].mean(0)
    x, y = (nodes[:, :2] - middle).T
    cos, sin = torch.cos(turn)[:, None], torch.sin(turn)[:, None]
    return torch.stack(
        [
            cos * x - sin * y + middle[0],
            sin * x + cos * y + middle[1],
            nodes[:, 2] + heights - heights.amin(-1, keepdim=True),
        ],
        dim=-1,
    )


def start_of(system: System, values: Mapping[str, Tensor]) -> State | None:
    """The state in which motions of these values begin; arguments as of `laid_nodes`. None: that of the scene."""
    nodes = laid_nodes(system.mesh, values)
    return None if nodes is None else init(system, len(nodes), positions=nodes)


def inputs_of(scenario: Scenario, system: System, values: Mapping[str, Tensor]) -> tuple[Properties, State | None]:
    """What parameter sets are to the simulator: properties, and a start (None: that of the scene).

    Args:
        system: of the scenario's scene.
        values: name -> [B].
    """
    return scenario.properties(system, _material_of(values)), start_of(system, values)


def described_laid(space: FitSpace, values: Mapping[str, float], *, length_unit_m: float) -> dict[str, NuisanceValue]:
    """Values as records keep them: name -> value and its prior, in SI."""
    found = {}
    for variable in space.variables:
        if variable.deviation is not None:
            unit = LAID[asked_as(variable.name)]
            factor = length_unit_m if unit == "m" else 1.0
            value, prior = values[variable.name] * factor, variable.deviation * factor
            found[variable.name] = NuisanceValue(value=value, prior=prior, unit=unit, of="cloth")
    return found


def _unit_square(mesh: ClothMesh) -> tuple[Tensor, Tensor]:
    """[V] where each node is on the cloth, across and along, from 0 to 1."""
    places = np.empty((len(mesh.nodes), 2))
    places[mesh.vert_node] = mesh.verts
    low = places.min(0)
    across, along = torch.as_tensor((places - low) / (places.max(0) - low)).T
    return across, along
