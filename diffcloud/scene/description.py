"""Description of a scene, before it is converted to tensors."""

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
    """One cloth with its handles and surroundings. Lengths are in the scene's own unit."""

    mesh: ClothMesh
    material: Material
    handles: Handles
    frame_time: float
    """Time between frames [s]."""
    frame_steps: int = 1
    end_time: float = math.inf
    """End of the simulation [s]."""
    surrounding: Surrounding = field(default_factory=Surrounding)
    mass_material: Material | None = None
    """Material for the node masses, if it differs from `material` (see `arcsim.load.load_scene`)."""
    integrator: str = "implicit"
    """Key of `sim.integrators.INTEGRATORS`. "implicit": converged steps with smooth contact and rigid bodies. "arcsim":
    ARCSim's steps, which ARCSim scene files and the `release_*` experiments use."""
    order: Order = 2
    """Order of the implicit integrator: 2 is BDF2, 1 is backward Euler. Scenes with rigid bodies always use 1."""
    shaped: bool = False
    """Whether the rest angles of the hinges are those of the mesh (sewn or moulded) instead of flat."""

    @property
    def time_step(self) -> float:
        """Duration of a simulation step [s]."""
        return self.frame_time / self.frame_steps

    @property
    def default_frames(self) -> int | None:
        """Number of frames until `end_time`, counted like ARCSim: the step that reaches it is the last."""
        if math.isinf(self.end_time):
            return None
        return math.ceil(math.ceil(self.end_time / self.time_step - 1e-9) / self.frame_steps)

    @property
    def bodies(self) -> SurfaceMesh:
        """All static obstacles except planar ones (tables), as one mesh; possibly empty."""
        return SurfaceMesh.joined([obstacle for obstacle in self.surrounding.obstacles if obstacle.plane() is None])

    def nominal(self, name: Quantity) -> float:
        """Return the quantity to which a multiplier refers, in the scene's units. These are stretching stiffness at
        rest [N/m], shear stiffness divided by it, and bending stiffness [N·m]. Others are density [kg/m²], air density
        [kg/m³], added mass [kg/m²] and linear drag [kg/(m²·s)] of the air, and the mass of all rigid bodies [kg]."""
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
        """Return the same scene with another integrator and the contact model that belongs to it.

        Raises:
            SceneError: the integrator is unknown.
        """
        surrounding = load_integrator(integrator).with_contact(self.surrounding)
        return replace(self, integrator=integrator, order=order, surrounding=surrounding)

    def finer(self) -> Scene:
        """Return the same scene with each face of the cloth divided into four. The first nodes are those of this scene.
        A new node between two nodes that are held in the same way is held like them. So pads and pivots keep their
        size."""
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
        """Build the scene: (System, State at time zero with batch size 1)."""
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
