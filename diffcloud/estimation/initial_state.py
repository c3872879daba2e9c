"""Initial state of the cloth: rotated under the gripper, not quite flat, or not exactly of the stated size.

The pose (`estimation.pose`) moves cloth, gripper and bodies together, so the motion itself stays the same. A cloth that
was put down with a rotation of 5° or a raised rim moves differently, and so does a larger cloth. The initial state
therefore consists of variables of the motion, like uncertain material (`estimation.uncertain`). They are fitted under
priors and are no material properties. In a joint fit each recording has its own, except for the size, which belongs to
the cloth.

`turn` rotates the cloth about its centre. The height relative to the scene's cloth is a sum of nine waves,

    h(u, v) = Σ c_ij cos(π i u) cos(π j v),      u, v in [0, 1],      0 < i + j <= 3,

raised so that no node is lower than before. `size` is the logarithm of the cloth's size relative to the scene. `track`
is the logarithm of the length of the gripper's path relative to the recording. `estimation.inputs` explains their
effect on the motion.
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
"""A cloth counts as level if its height range is below this fraction of its size."""
_FARTHEST = 4.0
"""Bounds of the variables, in standard deviations."""


def with_initial_state(space: FitSpace, stated: Sequence[Mapping[str, float]], scenarios: Sequence[Scenario]) -> FitSpace:
    """Append the variables of the initial state to a space.

    Args:
        stated: for each recording, name -> standard deviation [m, rad, 1]. The largest one of `size` applies to all.

    Raises:
        ConfigError: a cloth does not start level, or `size` is requested in a scene with more than a level table.
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
        described: nuisance values of each recording; pose variables are ignored.

    Raises:
        ConfigError: a variable is unknown.
    """
    every = [{name: entry.prior for name, entry in one.items() if entry.of == "cloth"} for one in described]
    for name in (name for one in every for name in one):
        if not is_initial_state(name):
            raise ConfigError(
                unknown_name("initial-state variable", name, [*filter(is_initial_state, INITIAL_STATE), *_SHAPES])
            )
    return _variables(every, length_unit_m=length_unit_m)


def _variables(deviations: Sequence[Mapping[str, float]], *, length_unit_m: float) -> list[Variable]:
    """Return the variables of a fit.

    Args:
        deviations: for each recording, name of a variable -> standard deviation [m, rad, 1].
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
    """Return one variable with a normal prior about zero.

    Args:
        deviation: standard deviation [m, rad, 1].
    """
    deviation /= length_unit_m if INITIAL_STATE[asked_as(name)] == "m" else 1.0
    return Variable(
        name, -_FARTHEST * deviation, _FARTHEST * deviation, centre=0.0, role="initial_state", deviation=deviation
    )


def is_initial_state(name: str) -> bool:
    """Return whether a variable belongs to the initial state."""
    plain = plain_name(name)
    return plain in _SHAPES or (plain in INITIAL_STATE and plain != "shape")


def asked_as(name: str) -> str:
    """Return the key in `INITIAL_STATE` under which a variable is requested; other names are returned unchanged."""
    plain = plain_name(name)
    return "shape" if plain in _SHAPES else plain


def sizes_of(values: Mapping[str, Tensor]) -> tuple[Tensor | None, Tensor | None]:
    """Return the cloth's size relative to the scene [B], and the length of the gripper's path in units of this size
    [B]. Both are differentiable; None stands for 1.

    Args:
        values: name -> [B], also of other variables.
    """
    size, track = values.get("size"), values.get("track")
    if size is None:
        return None, None if track is None else track.exp()
    return size.exp(), (-size if track is None else track - size).exp()


def initial_nodes(mesh: ClothMesh, values: Mapping[str, Tensor]) -> Tensor | None:
    """Return the initial node positions [B, V, 3] at the scene's size, differentiable. None: the scene's own positions.

    Args:
        values: name -> [B], also of other variables.
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
    """Convert values to the form of the fit record: name -> value and prior, in SI units."""
    found = {}
    for variable in space.variables:
        if variable.deviation is not None:
            unit = INITIAL_STATE[asked_as(variable.name)]
            factor = length_unit_m if unit == "m" else 1.0
            value, prior = values[variable.name] * factor, variable.deviation * factor
            found[variable.name] = NuisanceValue(value=value, prior=prior, unit=unit, of="cloth")
    return found


def _unit_square(mesh: ClothMesh) -> tuple[Tensor, Tensor]:
    """Return two coordinates [V] of each node in the flat cloth, scaled to the range 0 to 1."""
    places = np.empty((len(mesh.nodes), 2))
    places[mesh.vert_node] = mesh.verts
    low = places.min(0)
    across, along = torch.as_tensor((places - low) / (places.max(0) - low)).T
    return across, along
