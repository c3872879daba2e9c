"""Physical quantities of a batch of simulations, and the named parameters that scale them.

A *property* is a tensor that the physics reads, such as the mass of each node. A *parameter* is a number that a person
fits, such as the density multiplier. Only this module maps parameters to properties.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from torch import Tensor

from diffcloud.errors import ConfigError, unknown_name


@dataclass(frozen=True)
class Properties:
    """Physical quantities with a leading batch axis [B, ...]. All are differentiable."""

    node_mass: Tensor
    """[B, V] inertial mass: the cloth and the air that moves with it [kg]."""
    weight: Tensor
    """[B, V] mass on which gravity acts: the cloth only [kg]."""
    stretching: Tensor
    """[B, F] multiplier on the stretching table of each face [-]."""
    shear: Tensor
    """[B] multiplier on the shear column of the stretching table, in addition to `stretching` [-]."""
    compression: Tensor
    """[B] fraction of the stretching stiffness that resists compression [-]. Has no effect if the material's is 1."""
    bending: Tensor
    """[B, H] multiplier on the bending table of each hinge [-]."""
    damping: Tensor
    """[B] stiffness-proportional damping [s]."""
    air_density: Tensor
    """[B] air density for the quadratic normal drag [kg/m³]."""
    air_drag: Tensor
    """[B] coefficient of the linear tangential drag [kg/(m²·s)]."""
    linear_drag: Tensor
    """[B] coefficient of the linear drag in all directions [kg/(m²·s)]."""
    friction: Tensor
    """[B] Coulomb coefficient between cloth and obstacles [-]."""
    self_friction: Tensor
    """[B] Coulomb coefficient of the cloth with itself [-]."""
    body_mass: Tensor
    """[B, N] mass of the rigid bodies [kg]. Their inertia scales with it."""

    @property
    def batch(self) -> int:
        return len(self.damping)

    def tensors(self) -> tuple[Tensor, ...]:
        """Return all fields in the order of their definition."""
        return tuple(getattr(self, field.name) for field in fields(self))

    def repeated(self, count: int) -> Properties:
        """Repeat the whole batch `count` times: [count · B, ...], copies outermost."""
        return Properties(*(tensor.repeat(count, *[1] * (tensor.dim() - 1)) for tensor in self.tensors()))


Quantity = Literal["stretching", "shear", "bending", "density", "air_density", "added_mass", "linear_drag", "body_mass"]
"""Quantity of the material, the air or the bodies that a multiplier scales."""


@dataclass(frozen=True)
class Parameter:
    """Meaning, unit and bounds of a named parameter."""

    name: str
    meaning: str
    unit: str
    """SI unit that users read and write. A multiplier times the nominal value of its `quantity` is in this unit."""
    bounds: tuple[float, float]
    """Default bounds of a fit. If the parameter has a `quantity`, they are multiples of the scene's nominal value."""
    quantity: Quantity | None = None
    """Quantity that the simulator multiplies. None: the simulator takes the value itself."""
    most: float = math.inf
    """Largest physically meaningful value."""

    def check(self, value: float, what: str, nominal: float = 1.0) -> None:
        """Raise an error if the parameter cannot have a value.

        Args:
            value: in `unit`, or a multiplier.
            what: name of the value in the message, such as "--set stretching".
            nominal: nominal value in `unit`; 1 if `value` is a multiplier.

        Raises:
            ConfigError: the parameter cannot have this value.
        """
        low, high = (bound * nominal for bound in self.bounds)
        if not math.isfinite(value):
            raise ConfigError(f"{what} must be a finite number, got {value:g}. The default range is {low:g} to {high:g}.")
        if self.quantity is not None and value <= 0:
            raise ConfigError(f"{what} must be above 0, got {value:g}; the lowest usual value is {low:g}.")
        if value > _LARGEST * nominal or (self.quantity is not None and value < nominal / _LARGEST):
            raise ConfigError(
                f"{what} is {value:g}; values from {nominal / _LARGEST:g} to {_LARGEST * nominal:g} are simulated, and "
                f"from {low:g} to {high:g} are usual."
            )
        if value < 0:
            raise ConfigError(f"{what} must not be negative, got {value:g}; the nearest allowed value is 0.")
        if value > self.most:
            raise ConfigError(f"{what} is at most {self.most:g}, got {value:g}.")


_LARGEST = 1e6
"""Largest multiplier; its inverse is the smallest. Beyond it, sums lose the smaller terms to rounding."""
_MULTIPLIED = (0.1, 10.0)
PARAMETERS: dict[str, Parameter] = {
    parameter.name: parameter
    for parameter in (
        Parameter("stretching", "stretching stiffness: force per width per strain", "N/m", _MULTIPLIED, "stretching"),
        Parameter("density", "mass per area (of a node set, where the scene names one)", "kg/m²", _MULTIPLIED, "density"),
        Parameter("shear", "shear stiffness over stretching stiffness", "–", _MULTIPLIED, "shear"),
        Parameter("compression", "part of the stretching stiffness that resists compression", "–", (0.001, 1.0), most=1.0),
        Parameter("bending", "bending stiffness per width", "N·m", _MULTIPLIED, "bending"),
        Parameter("air_density", "air density, for drag that is quadratic in speed", "kg/m³", _MULTIPLIED, "air_density"),
        Parameter("added_mass", "mass per area of the air that moves with the cloth", "kg/m²", _MULTIPLIED, "added_mass"),
        Parameter("linear_drag", "drag per area that is linear in speed", "kg/(m²·s)", _MULTIPLIED, "linear_drag"),
        Parameter("damping", "stiffness-proportional damping", "s", (0.0, 0.1)),
        Parameter("friction", "Coulomb coefficient between cloth and obstacles", "–", (0.0, 1.5)),
        Parameter("self_friction", "Coulomb coefficient of the cloth with itself", "–", (0.0, 1.5)),
        Parameter("body_mass", "mass of all rigid bodies", "kg", _MULTIPLIED, "body_mass"),
    )
}
"""Every parameter by name. Bounds, units, checks, records and docs/concepts.md are made from this table. The paper fits
stretching and density in [0.1, 10]."""


def check_values(values: Mapping[str, float], option: str) -> None:
    """Check values of parameters by name.

    Args:
        option: option that gave the values, for messages.

    Raises:
        ConfigError: a parameter is unknown, or cannot have its value.
    """
    for name, value in values.items():
        if name not in PARAMETERS:
            raise ConfigError(f"{option}: {unknown_name('parameter', name, PARAMETERS)}")
        PARAMETERS[name].check(value, f"{option} {name}")


def one_set(values: Mapping[str, float]) -> dict[str, Tensor]:
    """Convert the values of one parameter set to a batch of one: name -> [1]."""
    return {name: torch.tensor([value], dtype=torch.float64) for name, value in values.items()}


def scaled_properties(
    base: Properties,
    values: Mapping[str, Tensor],
    *,
    faces: Tensor,
    node_sets: Mapping[str, Tensor] | None = None,
) -> Properties:
    """Apply a batch of parameter sets to the nominal properties.

    Args:
        base: the nominal material, batch 1.
        values: name -> [B] multipliers or absolute values, see `PARAMETERS`.
        faces: [F, 3] node indices, to average a node set's multiplier over each face.
        node_sets: parameter name -> bool [V]. `density` and `stretching` then act on those nodes only, as in the published
            experiments. A face takes the mean multiplier of its corners.

    Raises:
        ConfigError: a parameter is unknown, does not support node sets, or the values have different lengths.
    """
    node_sets = node_sets or {}
    for name in values:
        if name not in PARAMETERS:
            raise ConfigError(unknown_name("parameter", name, PARAMETERS))
    for name in node_sets:
        if name not in ("density", "stretching"):
            raise ConfigError(f"A node set for {name!r} is not supported; node sets act on density and stretching.")
    lengths = {len(value) for value in values.values()} or {1}
    if len(lengths) > 1:
        raise ConfigError(f"Parameters have different batch lengths: {sorted(lengths)}.")
    batch = lengths.pop()
    base = base.repeated(batch) if base.batch != batch else base
    one = base.damping.new_ones(batch)

    def get(name: str) -> Tensor:
        return values.get(name, one)

    def over_nodes(name: str) -> Tensor:  # [B, V] or [B, 1]
        value = get(name)[:, None]
        return value if name not in node_sets else torch.where(node_sets[name], value, 1.0)

    stretch = over_nodes("stretching")
    if stretch.shape[1] > 1:
        stretch = stretch[:, faces].mean(-1)
    weight = base.weight * over_nodes("density")
    return replace(
        base,
        node_mass=weight + (base.node_mass - base.weight) * get("added_mass")[:, None],
        weight=weight,
        stretching=base.stretching * stretch,
        shear=base.shear * get("shear"),
        compression=values.get("compression", base.compression),
        bending=base.bending * get("bending")[:, None],
        damping=values.get("damping", base.damping),
        air_density=base.air_density * get("air_density"),
        air_drag=base.air_drag * get("air_density"),
        linear_drag=base.linear_drag * get("linear_drag"),
        body_mass=base.body_mass * get("body_mass")[:, None],
        friction=values.get("friction", base.friction),
        self_friction=values.get("self_friction", base.self_friction),
    )
