"""What is constant in a run (System) and what changes with each step (State)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.contact import HalfSpaces, MeshContact
from diffcloud.sim.energies import Air, Bending, Handles, Stretching
from diffcloud.sim.linear_solve import MatrixPattern
from diffcloud.sim.properties import Properties


@dataclass(frozen=True)
class System:
    """Everything constant in a run. Built by `build.build_system`."""

    mesh: ClothMesh
    time_step: float
    """[s]"""
    gravity: Tensor
    """[3] [m/s²]"""
    stretching: Stretching
    bending: Bending
    air: Air
    handles: Handles
    halfspaces: HalfSpaces | None
    """Planes only; None where `contact` covers them."""
    contact: MeshContact | None
    """Meshes and self-contact by proximity and impact zones."""
    obstacles: tuple[SurfaceMesh, ...]
    """Meshes to draw, and what contact is built from."""
    properties: Properties
    """Of the basis material, batch 1."""
    pattern: MatrixPattern
    newton_iterations: int = 1
    """1: one linearised step, as ARCSim does. More: Newton until the implicit step has converged."""

    @property
    def dtype(self) -> torch.dtype:
        return self.gravity.dtype

    @property
    def device(self) -> torch.device:
        return self.gravity.device


@dataclass(frozen=True)
class State:
    """A batch of cloths at one time."""

    positions: Tensor
    """[B, V, 3] [m]"""
    velocities: Tensor
    """[B, V, 3] [m/s]"""
    anchors: Tensor
    """[B, H, 3] handle anchors; meaningless until the handle becomes active [m]."""
    step: int = 0
