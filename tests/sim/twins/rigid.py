"""Rotations and momenta of rigid bodies, in torch."""

from __future__ import annotations

import torch
from torch import Tensor

from diffcloud.sim.rigid.bodies import Bodies

_SMALL = 1e-8
"""Squared angle below which series replace quotients [rad²]; their error is below 1e-16."""


def rotation(vector: Tensor) -> Tensor:
    """The rotation about a vector by its length: [..., 3] [rad] -> [..., 3, 3] (Rodrigues), smooth everywhere."""
    squared = vector.square().sum(-1)[..., None, None]
    small = squared < _SMALL
    safe = torch.where(small, 1.0, squared)
    angle = safe.sqrt()
    sine = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    cosine = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.eye(3, dtype=vector.dtype) + sine * cross + cosine * (cross @ cross)


def angular_momentum(gyration: Tensor, orientation: Tensor, angular_velocity: Tensor) -> Tensor:
    """[..., 3] about the centre of mass and per mass, of bodies with gyration [..., 3, 3] [m²/s]."""
    local = orientation.mT @ angular_velocity[..., None]
    return (orientation @ (gyration @ local)).squeeze(-1)


def angular_momenta(bodies: Bodies, orientation: Tensor, angular_velocity: Tensor) -> Tensor:
    """[..., N, 3] of the bodies of a system [kg·m²/s]."""
    mass, gyration = torch.as_tensor(bodies.mass), torch.as_tensor(bodies.gyration)
    return mass[:, None] * angular_momentum(gyration, orientation, angular_velocity)
