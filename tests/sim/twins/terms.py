"""Each force on one element, as a function of torch tensors that autograd differentiates.

All take the element's constants and parameters by name, and `motion`: positions, before, after and displacement [n, 3], and
`time_step` and `ahead`; they give the force on each node [n, 3].
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import SimpleNamespace

import numpy as np
import torch
from torch import Tensor

Numbers = Mapping[str, Tensor]
TINY = 1e-30


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Without the fused products of torch's own, so that parallel vectors give exactly zero."""
    return torch.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def norm(vector: Tensor) -> Tensor:
    return vector.square().sum(-1).clamp(min=TINY).sqrt()


def gravity(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> Tensor:
    return parameters["weight"][:, None] * constants["acceleration"]


def coefficients(samples: Tensor, e00: Tensor, e11: Tensor, e01: Tensor) -> Tensor:
    """(k0, k1, k2, k3) at a strain, as ARCSim samples its grid: samples [4, 30, 30, 30] over (C00, C11, C01)."""
    grid = torch.stack([e01.abs() * 60 / 29 - 1, (e11 + 0.25) * 60 / 29 - 1, (e00 + 0.25) * 60 / 29 - 1])
    found = torch.nn.functional.grid_sample(
        samples[None], grid.view(1, 1, 1, 1, 3), mode="bilinear", padding_mode="border", align_corners=False
    )
    return found.flatten()


def along_material(constants: Numbers, field: Tensor) -> Tensor:
    """[3, 2] derivatives of a field of the corners along u and v."""
    return torch.stack([field[1] - field[0], field[2] - field[0]], dim=1) @ constants["inverse_rest"]


def strained(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(deformation gradient [3, 2], E [2, 2], its change by the displacement [2, 2], (k0, k1, k2, k3)) of a face."""
    gradient, moved = along_material(constants, motion.positions), along_material(constants, motion.displacement)
    strain = 0.5 * (gradient.T @ gradient - torch.eye(2, dtype=gradient.dtype))
    change = 0.5 * (gradient.T @ moved + moved.T @ gradient)
    axial, shear = coefficients(constants["samples"], strain[0, 0], strain[1, 1], strain[0, 1]).split([3, 1])
    found = parameters["stretching"] * torch.cat([axial, parameters["shear"] * shear])
    return gradient, strain, change, found


def on_corners(constants: Numbers, rows: Tensor) -> Tensor:
    """[3, 3] forces on the corners of what pulls along u and v [3, 2]."""
    pull = -constants["area"] * rows @ constants["inverse_rest"].T  # [3, 2] on 1 and 2
    return torch.stack([-pull.sum(1), pull[:, 0], pull[:, 1]])


def stretching(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> Tensor:
    """-∂W/∂x - H d with W = a (k0 E00²/2 + k1 E00 E11 + k2 E11²/2 + k3 E01²)."""
    gradient, strain, change, (k0, k1, k2, k3) = strained(constants, parameters, motion)
    stiffness = torch.stack([torch.stack([k0, k1]), torch.stack([k1, k2])])
    after = strain + change
    axial, shear = stiffness @ after.diagonal(), k3 * after[0, 1]
    stress = torch.stack([torch.stack([axial[0], shear]), torch.stack([shear, axial[1]])])
    tension = stiffness @ strain.diagonal().clamp(min=0)
    onward = motion.ahead * along_material(constants, motion.after)
    return on_corners(constants, gradient @ stress + onward * tension)


def wrinkling(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> Tensor:
    """(1 - c) a times the stress of W - W* and its change by the motion ahead, by autograd, and the change that W alone has
    by the rest of the displacement. W* is the largest of e²/2y over many directions, and Newton's method from there."""
    gradient, strain, change, (k0, k1, k2, k3) = strained(constants, parameters, motion)
    k0, k2, k3 = (one + 1e-9 * (k0 + k2) for one in (k0, k2, k3))
    k1 = torch.minimum(k1, 0.999 * (k0 * k2).sqrt())
    stiffness = torch.stack([torch.stack([k0, k1]), torch.stack([k1, k2])])
    flexible = torch.linalg.inv(stiffness)
    strain = strain + 5e-4 * torch.eye(2, dtype=strain.dtype)

    def stressed(tensor: Tensor) -> Tensor:
        return (stiffness @ tensor.diagonal()).diag() + (1 - torch.eye(2, dtype=tensor.dtype)) * tensor * k3

    def stored(angle: Tensor, tensor: Tensor) -> Tensor:  # e²/2y
        t = torch.stack([angle.cos(), angle.sin()])
        squares = t * t
        compliance = ((flexible @ squares) * squares).sum(0) + 2 * (t[0] * t[1]) ** 2 / k3
        pulled = (t * (tensor @ t)).sum(0)
        return 0.5 * pulled.clamp(min=0) ** 2 / compliance

    def slope(of: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
        at = at if at.requires_grad else at.detach().requires_grad_()
        return torch.autograd.grad(of(at), at, create_graph=True)[0]

    def given_up(tensor: Tensor) -> Tensor:  # W - W*, eased
        whole = 0.5 * (tensor * stressed(tensor)).sum()
        if torch.linalg.eigvalsh(stressed(tensor).detach()).min() >= 0:
            kept = whole
        elif torch.linalg.eigvalsh(tensor.detach()).max() <= 0:
            kept = 0 * whole
        else:
            angles = torch.linspace(0, math.pi, 3601, dtype=tensor.dtype)
            angle = angles[stored(angles, tensor.detach()).argmax()]
            for _ in range(4):  # differentiated: each step doubles the order to which the angle follows the strain
                first = slope(lambda one: stored(one, tensor), angle)
                angle = angle - first / slope(lambda one: slope(lambda other: stored(other, tensor), one), angle)
            kept = stored(angle, tensor)
        scale = 0.25 * 5e-4**2 * (k0 + k2)
        r, q = (kept / scale + 1e-24).sqrt().clamp(max=1), ((whole - kept) / scale + 1e-24).sqrt()
        return scale * (r**2 * (1 - r) ** 3 + torch.where(q < 1, q**3 / 3, q**2 - q + 1 / 3))

    onward = motion.ahead * along_material(constants, motion.after)
    ahead = 0.5 * (gradient.T @ onward + onward.T @ gradient)
    stress = torch.autograd.functional.jvp(lambda one: slope(given_up, one), strain, ahead, create_graph=True)
    given = sum(stress) + stressed(change - ahead)
    return on_corners(constants, gradient @ ((parameters["compression"] - 1) * given))


def dihedral(nodes: Tensor) -> tuple[Tensor, Tensor]:
    """(angle, its gradient as it is used in forces [4, 3]) of a hinge: edge 0-1, opposite nodes 2 and 3."""
    edge = nodes[1] - nodes[0]
    squared = edge.square().sum().clamp(min=TINY)
    length = squared.sqrt()
    arms = nodes[2:] - nodes[0]
    normals = torch.stack([cross(edge, arms[0]), cross(arms[1], edge)])
    sine = -(edge * cross(normals[0], normals[1])).sum() / length
    cosine = (normals[0] * normals[1]).sum()
    flat = sine.detach().abs() + cosine.detach().abs() < TINY
    angle = torch.atan2(sine, cosine + flat)
    along = arms @ edge / squared
    area = norm(normals)
    height = torch.maximum(area / length, 1e-3 * length)
    tilts = normals / (area * height)[:, None]
    return angle, torch.stack([(along - 1) @ tilts, -along @ tilts, tilts[0], tilts[1]])


def bending(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> Tensor:
    """-K (θ + ∇θ · d) ∇θ"""
    angle, gradient = dihedral(motion.positions)
    angle = angle - constants["rest_angle"]
    angle = angle - 2 * math.pi * torch.floor(angle.detach() / (2 * math.pi) + 0.5)
    column = (constants["curvature"] * angle - 0.5).clamp(0, 4)
    low = min(int(column.detach()), 3)
    left, right = constants["rows"][:, low], constants["rows"][:, low + 1]
    table = (left + (right - left) * (column - low)).clamp(min=0).amin()
    stiffness = table * constants["stiffness"] * parameters["bending"]
    return -stiffness * (angle + (gradient * motion.displacement).sum()) * gradient


def air(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> Tensor:
    """A third of f = ρ a |u_n| v_n N + drag a v_t on each corner."""
    a, b, c = motion.positions
    normal = cross(b - a, c - a)
    normal = normal / norm(normal)
    before, after = constants["wind"] - motion.before.mean(0), constants["wind"] - motion.after.mean(0)
    relative = before if constants["lagged"] > 0 else after
    across = relative @ normal
    pressure = parameters["air_density"] * (before @ normal).abs() * across * normal
    drag = parameters["air_drag"] * (relative - across * normal) + parameters["linear_drag"] * relative
    return (constants["area"] * (pressure + drag) / 3).expand(3, 3)


def handles(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> Tensor:
    return parameters["hold"] * (parameters["target"] - motion.positions - motion.ahead * motion.after)


def planes(constants: Numbers, parameters: Numbers, motion: SimpleNamespace) -> Tensor:
    """Repulsion K c²/(2 τ) to first order in the motion of the step, and friction -γ P v."""
    normal, thickness = constants["normal"], constants["thickness"]
    violation = (thickness + constants["offset"] - motion.positions @ normal).clamp(min=0)
    pushing = constants["stiffness"] * violation.square() / (2 * thickness)
    limit = parameters["friction"] * pushing
    across = torch.eye(3, dtype=normal.dtype) - torch.outer(normal, normal)
    speed = norm(motion.before @ across)
    sticking = limit * motion.time_step / parameters["node_mass"] + 1e-12
    gamma = limit / torch.maximum(speed, sticking)
    approach = constants["stiffness"] * violation / thickness * (motion.ahead * motion.after @ normal)
    return (pushing - approach)[:, None] * normal - gamma[:, None] * (motion.after @ across)


def sampled(name: str, samples: np.ndarray) -> dict[str, Tensor]:
    """What a twin needs beside its element's constants."""
    return {"samples": torch.as_tensor(samples)} if name in ("stretching", "wrinkling") else {}
