"""From a cloth mesh, a material and a surrounding to a System."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray

from diffcloud.errors import SceneError
from diffcloud.mesh.topology import ClothMesh
from diffcloud.sim.contact import HalfSpaces, MeshContact
from diffcloud.sim.contact.barrier import Barrier
from diffcloud.sim.contact.smooth import PlaneContacts, SmoothContact
from diffcloud.sim.contact.surface import ContactSurface
from diffcloud.sim.elements import Elements
from diffcloud.sim.energies import Air, Bending, Handles, Stretching
from diffcloud.sim.linear_solve import GeneralPattern, pattern
from diffcloud.sim.materials import Material
from diffcloud.sim.properties import Properties
from diffcloud.sim.rigid import Bodies
from diffcloud.sim.scenery import Scenery
from diffcloud.sim.state import Apart, ImplicitSetup, System
from diffcloud.sim.surrounding import Surrounding

Integrator = Literal["implicit", "linearised"]


def build_system(
    mesh: ClothMesh,
    material: Material,
    *,
    time_step: float,
    handles: Handles,
    surrounding: Surrounding | None = None,
    mass_material: Material | None = None,
    integrator: Integrator = "linearised",
    shaped: bool = False,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> System:
    """Assemble a System.

    Args:
        time_step: [s].
        mass_material: material whose density gives the node masses, where it differs from `material` (the published
            experiments reload their tables after the masses were computed).
        integrator: "implicit" for the converged step with smooth contact and rigid bodies, "linearised" for ARCSim's.
        shaped: whether the cloth's hinges are at rest as the mesh stands, not flat.

    Raises:
        SceneError: a time step that is not positive, or a handle on a node that does not exist.
    """
    surrounding = surrounding or Surrounding()
    device = torch.device(device)
    if not time_step > 0:
        raise SceneError(f"The time step must be positive, got {time_step} s.")
    if integrator == "linearised" and (surrounding.moving or surrounding.bodies):
        raise SceneError("Moving obstacles and rigid bodies need the implicit integrator.")
    if integrator == "implicit" and surrounding.reference_contact is not None:
        raise SceneError("Contact by proximity and impact zones belongs to the linearised integrator.")
    for node in handles.nodes:
        if not 0 <= node < len(mesh.nodes):
            raise SceneError(f"A handle holds node {node}, but the cloth has nodes 0..{len(mesh.nodes) - 1}.")

    def tensor(array: NDArray[np.float64] | Sequence[float]) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array, dtype=np.float64), dtype=dtype, device=device)

    stretching = Stretching.build(mesh, material, dtype=dtype, device=device)
    bending = Bending.build(mesh, material, dtype=dtype, device=device, shaped=shaped)
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
        body_mass=torch.zeros(1, 0, dtype=dtype, device=device),
    )
    air = Air(stretching.elements, stretching.area, tensor(surrounding.wind))
    setup = None
    if integrator == "implicit":
        setup = _implicit(mesh, surrounding, stretching, bending, air)
        properties = replace(properties, body_mass=setup.bodies.mass[None])
    return System(
        mesh=mesh,
        time_step=time_step,
        gravity=tensor(surrounding.gravity),
        stretching=stretching,
        bending=bending,
        air=air,
        handles=handles,
        halfspaces=_halfspaces(mesh, surrounding, dtype, device),
        contact=_mesh_contact(mesh, surrounding, dtype, device),
        obstacles=(
            *surrounding.obstacles,
            *(obstacle.mesh for obstacle in surrounding.moving),
            *(body.mesh for body in surrounding.bodies),
        ),
        properties=properties,
        pattern=pattern(len(mesh.nodes), [mesh.faces, mesh.hinges.nodes], device),
        implicit=setup,
    )


def _implicit(
    mesh: ClothMesh, surrounding: Surrounding, stretching: Stretching, bending: Bending, air: Air
) -> ImplicitSetup:
    dtype, device = stretching.area.dtype, stretching.area.device
    bodies = Bodies.build(surrounding.bodies, dtype=dtype, device=device)
    static = [obstacle for obstacle in surrounding.obstacles if obstacle.plane() is None]
    obstacles = [*static, *(o.mesh for o in surrounding.moving), *(b.mesh for b in surrounding.bodies)]
    scenery = Scenery.build(static, surrounding.moving)
    settings = surrounding.contact
    surface = ContactSurface.build(
        mesh,
        obstacles,
        movable=[False] * (len(obstacles) - len(bodies)) + [True] * len(bodies),
        touches_itself=surrounding.self_contact,
        dtype=dtype,
        device=device,
    )
    half = _halfspaces(mesh, surrounding, dtype, device)
    planes = None
    if half is not None:
        body_points = surface.points >= len(mesh.nodes) + len(scenery.fixed)
        own = (surface.points < len(mesh.nodes)) | body_points
        planes = PlaneContacts(half.normals, half.offsets, surface.points[own], surface.point_area[own])
    faces, hinges = stretching.elements.apart(), bending.elements.apart()
    pair = torch.stack([hinges.nodes[:, [0, 1, 2]], hinges.nodes[:, [1, 0, 3]]], dim=1).flatten(0, 1)
    apart = Apart(
        stretching=replace(stretching, elements=faces),
        air=replace(air, elements=faces),
        bending=replace(bending, elements=hinges, faces=torch.arange(len(pair), device=device)),
        hinge_faces=Elements(pair, hinges.node_count),
    )
    return ImplicitSetup(
        contact=SmoothContact(
            Barrier(settings.stiffness, settings.repulsion_thickness, settings.sticking_speed), surface, planes
        ),
        bodies=bodies,
        scenery=scenery,
        moves=surface.movable[surface.owner],
        apart=apart,
        pattern=GeneralPattern.build(len(mesh.nodes) + 2 * len(bodies), [mesh.faces, mesh.hinges.nodes], device),
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
