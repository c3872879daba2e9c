"""How a cloth lies when its motion begins: turned under the gripper, not quite flat, and not quite as large as stated.

The pose (`estimation.pose`) moves cloth, gripper and bodies together, which is the same motion seen from elsewhere. A
cloth that a hand has put down 5° askew, or with a rim that stands up, moves in another way, and so does a larger one.
So these are variables of the motion, like uncertain material (`estimation.uncertain`): fitted under priors, and no property
of the material. In a joint fit, each recording has its own, except for the size, which belongs to the cloth.

The turn is about the cloth's middle. Its height over the scene's is a sum of nine waves over the cloth,

    h(u, v) = Σ c_ij cos(π i u) cos(π j v),      u, v in [0, 1],      0 < i + j <= 3,

raised until no node is lower than before. `size` and `track` are logarithms: of how many times as large as the scene's the
cloth is, and of how many times as far as recorded the gripper goes. What they do to a motion: `estimation.inputs`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from diffcloud.errors import ConfigError, unknown_name
from diffcloud.estimation.names import of_all, plain_name
from diffcloud.estimation.parameters import FitSpace, Variable
from diffcloud.estimation.record import NuisanceValue
from diffcloud.mesh.topology import ClothMesh
from diffcloud.scene.scenarios import Scenario
from diffcloud.scene.scenarios.initial_state import INITIAL_STATE

_SHAPES = {f"shape_{i}_{j}": (i, j) for i in range(4) for j in range(4) if 0 < i + j <= 3}
_FLAT = 1e-6
"""Part of its size by which a level cloth may be off."""
_FARTHEST = 4.0
"""Bounds, in standard deviations."""


def with_initial_state(space: FitSpace, stated: Sequence[Mapping[str, float]], scenarios: Sequence[Scenario]) -> FitSpace:
    """The space with the variables appended.

    Args:
        stated: for each recording, name -> standard deviation [m, rad, 1]. `size` belongs to all: its
            largest holds.
        scenarios: of the recordings.

    Raises:
        ConfigError: a cloth that does not lie level, or a size where there is more than a table around the cloth.
    """
    sizes = [own["size"] for own in stated if "size" in own]
    deviations: list[dict[str, float]] = []
    for own, scenario in zip(stated, scenarios, strict=True):
        nodes = scenario.scene.mesh.nodes
        known = {**own, "size": max(sizes)} if sizes else own
        if known and np.ptp(nodes[:, 2]) > _FLAT * np.ptp(nodes, axis=0).max():
            told = f"initial_state {', '.join(known)}: this needs a cloth that lies level at the start"
            raise ConfigError(f"{told}; that of {scenario.name} does not.")
        if sizes:
            check_resizable(scenario)
        names = [each for name in INITIAL_STATE if name in known for each in (_SHAPES if name == "shape" else (name,))]
        deviations.append({name: known[asked_as(name)] for name in names})
    own_variables = _variables(deviations, length_unit_m=scenarios[0].length_unit_m)
    return FitSpace((*space.variables, *own_variables), space.fixed)


def variables_of(described: Sequence[Mapping[str, NuisanceValue]], *, length_unit_m: float) -> list[Variable]:
    """Return the variables that `described_initial_state` describes.

    Args:
        described: of each recording; other nuisance is passed over.

    Raises:
        ConfigError: an unknown one.
    """
    every = [{name: entry.prior for name, entry in one.items() if entry.of == "cloth"} for one in described]
    for name in (name for one in every for name in one):
        if not is_initial_state(name):
            raise ConfigError(
                unknown_name("variable of how a cloth lies", name, [*filter(is_initial_state, INITIAL_STATE), *_SHAPES])
            )
    return _variables(every, length_unit_m=length_unit_m)


def _variables(deviations: Sequence[Mapping[str, float]], *, length_unit_m: float) -> list[Variable]:
    """
    Args:
        deviations: for each recording, name of a variable -> [m, rad, 1].
    """
    return [_variable(name, deviation, length_unit_m) for name, deviation in of_all(deviations).items()]


def check_resizable(scenario: Scenario) -> None:
    """Check that the cloth's surroundings are at most one level table. Anything else would not grow with the cloth.

    Raises:
        ConfigError: the scene has wind, moving obstacles, further forces, or obstacles other than one level table.
    """
    around = scenario.scene.surrounding
    planes = [surface.plane() for surface in around.obstacles]
    level = [plane is not None and bool(abs(plane[0][2]) > 1 - _FLAT) for plane in planes]
    found = {
        "wind": any(around.wind),
        "obstacles that move": bool(around.moving or around.bodies),
        "further forces": bool(around.forces),
        "obstacles other than a level table": not all(level) or len(level) > 1,
    }
    if any(found.values()):
        more = ", ".join(name for name, there in found.items() if there)
        raise ConfigError(
            f"initial_state size: this needs a scene of cloth and table alone; {scenario.name} has {more}. Omit size."
        )


def _variable(name: str, deviation: float, length_unit_m: float) -> Variable:
    """
    Args:
        deviation: [m, rad, 1].
    """
    deviation /= length_unit_m if INITIAL_STATE[asked_as(name)] == "m" else 1.0
    return Variable(
        name, -_FARTHEST * deviation, _FARTHEST * deviation, centre=0.0, role="initial_state", deviation=deviation
    )


def is_initial_state(name: str) -> bool:
    """Whether a variable tells how a cloth lies."""
    plain = plain_name(name)
    return plain in _SHAPES or (plain in INITIAL_STATE and plain != "shape")


def asked_as(name: str) -> str:
    """The name in `INITIAL_STATE` under which a variable is requested; of any other, its own."""
    plain = plain_name(name)
    return "shape" if plain in _SHAPES else plain


def sizes_of(values: Mapping[str, Tensor]) -> tuple[Tensor | None, Tensor | None]:
    """[B] how many times as large as the scene's a cloth is, and how many times as far its gripper goes, in units of its
    size; differentiable. None: as large, as far.

    Args:
        values: name -> [B], those of the material too.
    """
    size, track = values.get("size"), values.get("track")
    if size is None:
        return None, None if track is None else track.exp()
    return size.exp(), (-size if track is None else track - size).exp()


def initial_nodes(mesh: ClothMesh, values: Mapping[str, Tensor]) -> Tensor | None:
    """[B, V, 3] where a cloth starts, at the scene's size; differentiable. None: as the scene has it.

    Args:
        values: name -> [B], those of the material too.
    """
    own = {name: value for name, value in values.items() if is_initial_state(name)}
    if not own:
        return None
    nodes = torch.as_tensor(mesh.nodes, dtype=torch.float64)
    batch = len(next(iter(own.values())))
    across, along = _unit_square(mesh)
    heights = torch.zeros(batch, len(nodes), dtype=torch.float64)
    for name, (i, j) in _SHAPES.items():
        if name in own:
            heights = heights + own[name][:, None] * torch.cos(torch.pi * i * across) * torch.cos(torch.pi * j * along)
    size, _ = sizes_of(own)
    heights = heights if size is None else heights / size[:, None]
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


def described_initial_state(
    space: FitSpace, values: Mapping[str, float], *, length_unit_m: float
) -> dict[str, NuisanceValue]:
    """Values as records keep them: name -> value and its prior, in SI."""
    found = {}
    for variable in space.variables:
        if variable.deviation is not None:
            unit = INITIAL_STATE[asked_as(variable.name)]
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
