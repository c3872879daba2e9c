"""From a cloth mesh, a material and a surrounding to a System."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.errors import SceneError
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.contact import ContactSettings, HalfSpaces, MeshContact, ReferenceContact
from diffcloud.sim.energies import Air, Bending, Handles, Stretching
from diffcloud.sim.linear_solve import pattern
from diffcloud.sim.materials import Material
from diffcloud.sim.properties import Properties
from diffcloud.sim.state import System


@dataclass(frozen=True)
class Surrounding:
    """Everything around the cloth."""

    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """[m/s²]"""
    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Velocity of the air [m/s]."""
    air_density: float = 1.0
    """[kg/m³]; ARCSim's default, real air has 1.2."""
    air_drag: float = 0.0
    """Tangential drag [kg/(m²·s)]."""
    friction_cloth: float = 0.6
    friction_obstacle: float = 0.3
    contact: ContactSettings = field(default_factory=ContactSettings)
    proximity: bool = True
    """Whether planes repel and rub (off: only projection)."""
    obstacles: tuple[SurfaceMesh, ...] = ()
    reference_contact: ReferenceContact | None = None
    """Contact with all meshes and of the cloth with itself by proximity and impact zones; None: with planes only."""


def build_system(
    mesh: ClothMesh,
    material: Material,
    *,
    time_step: float,
    handles: Handles,
    surrounding: Surrounding | None = None,
    mass_material: Material | None = None,
    newton_iterations: int = 1,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> System:
    """Assemble a System.

    Args:
        time_step: [s].
        mass_material: material whose density gives the node masses, where it differs from `material` (the published
            experiments reload their tables after the masses were computed).
        newton_iterations: 1 for one linearised step (ARCSim), more for a converged implicit step.

    Raises:
        SceneError: a time step that is not positive, or a handle on a node that does not exist.
    """
    surrounding = surrounding or Surrounding()
    device = torch.device(device)
    if not time_step > 0 or newton_iterations < 1:
        raise SceneError(f"Time step and Newton iterations must be positive, got {time_step} s and {newton_iterations}.")
    if surrounding.reference_contact is not None and newton_iterations > 1:
        raise SceneError(
            "Contact by proximity and impact zones belongs to the linearised step; set newton_iterations to 1."
        )
    for node in handles.nodes:
        if not 0 <= node < len(mesh.nodes):
            raise SceneError(f"A handle holds node {node}, but the cloth has nodes 0..{len(mesh.nodes) - 1}.")

    def tensor(array: NDArray[np.float64] | Sequence[float]) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array, dtype=np.float64), dtype=dtype, device=device)

    stretching = Stretching.build(mesh, material, dtype=dtype, device=device)
    bending = Bending.build(mesh, material, dtype=dtype, device=device)
    density = (mass_material or material).density
    properties = Properties(
        node_mass=tensor(density * mesh.node_area)[None],
        stretching=tensor(np.ones((1, len(mesh.faces)))),
        bending=tensor(np.ones((1, len(mesh.hinges.length)))),
        damping=tensor([material.damping]),
        air_density=tensor([surrounding.air_density]),
        air_drag=tensor([surrounding.air_drag]),
        friction_obstacle=tensor([surrounding.friction_obstacle]),
        friction_cloth=tensor([surrounding.friction_cloth]),
    )
    return System(
        mesh=mesh,
        time_step=time_step,
        gravity=tensor(surrounding.gravity),
        stretching=stretching,
        bending=bending,
        air=Air(stretching.elements, stretching.area, tensor(surrounding.wind)),
        handles=handles,
        halfspaces=_halfspaces(mesh, surrounding, dtype, device),
        contact=_mesh_contact(mesh, surrounding, dtype, device),
        obstacles=surrounding.obstacles,
        properties=properties,
        pattern=pattern(len(mesh.nodes), [mesh.faces, mesh.hinges.nodes], device),
        newton_iterations=newton_iterations,
    )


def _mesh_contact(
    mesh: ClothMesh, surrounding: Surrounding, dtype: torch.dtype, device: torch.device
) -> MeshContact | None:
    if surrounding.reference_contact is None:
        return None
    return MeshContact.build(
        mesh,
        surrounding.obstacles,
        surrounding.contact,
        surrounding.reference_contact,
        proximity=surrounding.proximity,
        dtype=dtype,
        device=device,
    )


def _halfspaces(mesh: ClothMesh, surrounding: Surrounding, dtype: torch.dtype, device: torch.device) -> HalfSpaces | None:
    """Planar obstacles as half-spaces, on the side where most of the cloth starts."""
    if surrounding.reference_contact is not None:
        return None
    planes = [plane for plane in (obstacle.plane() for obstacle in surrounding.obstacles) if plane is not None]
    if not planes:
        return None
    normals = np.array([normal for normal, _ in planes])
    offsets = np.array([offset for _, offset in planes])
    side = np.where(np.median(mesh.nodes @ normals.T - offsets, axis=0) < 0, -1.0, 1.0)
    area = mesh.node_area if surrounding.proximity else np.zeros_like(mesh.node_area)
    return HalfSpaces(
        normals=torch.as_tensor(normals * side[:, None], dtype=dtype, device=device),
        offsets=torch.as_tensor(offsets * side, dtype=dtype, device=device),
        node_area=torch.as_tensor(area, dtype=dtype, device=device),
        settings=surrounding.contact,
    )
