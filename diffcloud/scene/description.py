"""A scene in the project's own terms, before it becomes tensors."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from diffcloud.mesh.refinement import refined
from diffcloud.mesh.topology import ClothMesh, SurfaceMesh
from diffcloud.sim.build import build_system
from diffcloud.sim.handles import Handle, Handles
from diffcloud.sim.integrators import load_integrator
from diffcloud.sim.materials import Material
from diffcloud.sim.properties import Quantity
from diffcloud.sim.simulate import init
from diffcloud.sim.surrounding import Order, Surrounding
from diffcloud.sim.system import State, System


@dataclass(frozen=True)
class Scene:
    """One cloth, what holds it, and what surrounds it. Lengths in the scene's own unit."""

    mesh: ClothMesh
    material: Material
    handles: Handles
    frame_time: float
    """[s]"""
    frame_steps: int = 1
    end_time: float = math.inf
    """[s]"""
    surrounding: Surrounding = field(default_factory=Surrounding)
    mass_material: Material | None = None
    """Gives the node masses where it differs from `material` (see `arcsim.load.load_scene`)."""
    integrator: str = "implicit"
    """A key of `sim.integrators.INTEGRATORS`. "implicit": converged steps with smooth contact and rigid bodies; "arcsim":
    ARCSim's steps. The one default; scene files of ARCSim and the `release_*` experiments name theirs."""
    order: Order = 2
    """Of the implicit integrator: 2, BDF2, or 1, backward Euler, which scenes with rigid bodies always have."""
    shaped: bool = False
    """Whether the cloth's hinges are at rest as the mesh stands (something sewn or moulded), not flat."""

    @property
    def time_step(self) -> float:
        """[s]"""
        return self.frame_time / self.frame_steps

    @property
    def default_frames(self) -> int | None:
        """Frames until `end_time`, counted as ARCSim does: the step that reaches it is the last."""
        if math.isinf(self.end_time):
            return None
        return math.ceil(math.ceil(self.end_time / self.time_step - 1e-9) / self.frame_steps)

    @property
    def bodies(self) -> SurfaceMesh:
        """All static obstacles but the planar ones (tables), as one mesh to draw; without any, no nodes and no faces."""
        return SurfaceMesh.joined([obstacle for obstacle in self.surrounding.obstacles if obstacle.plane() is None])

    def nominal(self, name: Quantity) -> float:
        """What multipliers act on, in the scene's units: stiffness at rest in stretching [N/m], in shear divided by
        that, or in bending [N·m]; density of the cloth or of the air that moves with it [kg/m²], of the air [kg/m³], its
        linear drag [kg/(m²·s)], mass of all rigid bodies [kg]."""
        match name:
            case "stretching":
                return self.material.resting_stretching_stiffness
            case "shear":
                return self.material.resting_shear_part
            case "bending":
                return self.material.resting_bending_stiffness
            case "density":
                return (self.mass_material or self.material).density
            case "air_density":
                return self.surrounding.air_density
            case "added_mass":
                return self.surrounding.added_mass
            case "linear_drag":
                return self.surrounding.linear_drag
            case "body_mass":
                return float(self.build()[0].properties.body_mass.sum()) if self.surrounding.bodies else 0.0

    def stepped(self, integrator: str, order: Order = 2) -> Scene:
        """The same scene with an integrator and the contact that is its own.

        Raises:
            SceneError: no such integrator.
        """
        surrounding = load_integrator(integrator).with_contact(self.surrounding)
        return replace(self, integrator=integrator, order=order, surrounding=surrounding)

    def finer(self) -> Scene:
        """The same scene, each face of the cloth cut into four; its first nodes are those of this one. What lies between
        two nodes that are held alike is held like them: a pad keeps its size, and a pivot, which `build` scales, too."""
        mesh, edges = refined(self.mesh)
        turned = {replace(handle, turned=Handle.turned): handle.turned for handle in self.handles.handles}
        more: list[Handle] = []
        for place, (a, b) in enumerate(edges.tolist(), len(self.mesh.nodes)):
            for handle in self.handles.handles:
                other = turned.get(replace(handle, node=b, turned=Handle.turned)) if handle.node == a else None
                if other is not None:
                    x, y, z = ((one + two) / 2 for one, two in zip(handle.turned, other, strict=True))
                    more.append(replace(handle, node=place, turned=(x, y, z)))
        return replace(self, mesh=mesh, handles=replace(self.handles, handles=(*self.handles.handles, *more)))

    def build(self) -> tuple[System, State]:
        """(System, State at time zero with batch 1)."""
        system = build_system(
            self.mesh,
            self.material,
            time_step=self.time_step,
            handles=self.handles,
            surrounding=self.surrounding,
            mass_material=self.mass_material,
            integrator=self.integrator,
            order=self.order,
            shaped=self.shaped,
        )
        return system, init(system)
