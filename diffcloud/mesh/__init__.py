"""Triangle meshes: topology, material-space geometry, and procedural shapes (numpy only)."""

from diffcloud.mesh.shapes import grid_cloth
from diffcloud.mesh.topology import ClothMesh, Hinges, SurfaceMesh

__all__ = ["ClothMesh", "Hinges", "SurfaceMesh", "grid_cloth"]
