"""What is constant in a run (System) and what changes with each step (State)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.contact import HalfSpaces, MeshContact
from diffcloud.sim.contact.smooth import SmoothContact
from diffcloud.sim.elements import Elements
from diffcloud.sim.energies import Air, Bending, Handles, Stretching
from diffcloud.sim.linear_solve import GeneralPattern, MatrixPattern
from diffcloud.sim.properties import Properties
from diffcloud.sim.rigid.bodies import Bodies, BodyState
from diffcloud.sim.scenery import Scenery


@dataclass(frozen=True)
class Apart:
    """The elements with corners of their own, to differentiate each on its own."""

    stretching: Stretching
    air: Air
    bending: Bending
    hinge_faces: Elements
    """[2 H, 3] both faces of each hinge."""


@dataclass(frozen=True)
class ImplicitSetup:
    """What the converged implicit step needs beyond the linearised one."""

    contact: SmoothContact
    bodies: Bodies
    scenery: Scenery
    moves: Tensor
    """bool [N] of cloth nodes, obstacle points and body points: those that contact can move."""
    apart: Apart
    pattern: GeneralPattern


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
    implicit: ImplicitSetup | None = None
    """For the converged implicit step with smooth contact; None: the linearised step."""

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
    bodies: BodyState | None = None
    """Of the rigid bodies; None: where they start."""
