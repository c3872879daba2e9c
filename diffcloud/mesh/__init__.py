"""Triangle meshes: topology, geometry in material space, and procedural shapes (numpy and scipy only)."""

from diffcloud.mesh.shapes import (
    box_surface,
    cylinder_surface,
    grid_cloth,
    lined_cloth,
    loop_cloth,
    rectangle_surface,
    sphere_surface,
    vest_cloth,
    vest_shoulder,
)
from diffcloud.mesh.topology import ClothMesh, Hinges, SurfaceMesh

__all__ = [
    "ClothMesh",
    "Hinges",
    "SurfaceMesh",
    "box_surface",
    "cylinder_surface",
    "grid_cloth",
    "lined_cloth",
    "loop_cloth",
    "rectangle_surface",
    "sphere_surface",
    "vest_cloth",
    "vest_shoulder",
]
