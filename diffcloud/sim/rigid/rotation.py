"""Rotations: the exponential map within a step, roll-pitch-yaw where a person or a file format asks for it."""

from __future__ import annotations

import torch
from torch import Tensor

_SMALL = 1e-8
"""Squared angle below which series replace quotients [rad²]; their error is below 1e-16."""


def skew(vector: Tensor) -> Tensor:
    """[..., 3] -> [..., 3, 3] with skew(a) b = a x b."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def rotation(vector: Tensor) -> Tensor:
    """The rotation about a vector by its length: [..., 3] [rad] -> [..., 3, 3] (Rodrigues), smooth everywhere."""
    squared = vector.square().sum(-1)[..., None, None]
    small = squared < _SMALL
    safe = torch.where(small, 1.0, squared)
    angle = safe.sqrt()
    sine = torch.where(small, 1 - squared / 6, angle.sin() / angle)
    cosine = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    cross = skew(vector)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + sine * cross + cosine * (cross @ cross)


def left_jacobian(vector: Tensor) -> Tensor:
    """J with rotation(v + δ) ≈ rotation(J δ) rotation(v): [..., 3] -> [..., 3, 3]."""
    squared = vector.square().sum(-1)[..., None, None]
    small = squared < _SMALL
    safe = torch.where(small, 1.0, squared)
    angle = safe.sqrt()
    first = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    second = torch.where(small, 1 / 6 - squared / 120, (angle - angle.sin()) / (safe * angle))
    cross = skew(vector)
    return torch.eye(3, dtype=vector.dtype, device=vector.device) + first * cross + second * (cross @ cross)


def roll_pitch_yaw(matrix: Tensor) -> Tensor:
    """[..., 3, 3] -> [..., 3] with R = Rz(yaw) Ry(pitch) Rx(roll); pitch in [-π/2, π/2] [rad]."""
    roll = torch.atan2(matrix[..., 2, 1], matrix[..., 2, 2])
    pitch = torch.asin((-matrix[..., 2, 0]).clamp(-1, 1))
    yaw = torch.atan2(matrix[..., 1, 0], matrix[..., 0, 0])
    return torch.stack([roll, pitch, yaw], dim=-1)


def from_roll_pitch_yaw(angles: Tensor) -> Tensor:
    """[..., 3] (roll, pitch, yaw) [rad] -> [..., 3, 3]."""
    axes = torch.eye(3, dtype=angles.dtype, device=angles.device)
    about_x, about_y, about_z = (rotation(angles[..., i, None] * axes[i]) for i in range(3))
    return about_z @ about_y @ about_x
