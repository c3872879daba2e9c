"""Contact of the cloth with obstacles and with itself. Half-spaces (tables, floors) have a closed form."""

from diffcloud.sim.contact.halfspace import ContactSettings, HalfSpaceContact, HalfSpaces
from diffcloud.sim.contact.mesh_contact import MeshContact, ReferenceContact

__all__ = ["ContactSettings", "HalfSpaceContact", "HalfSpaces", "MeshContact", "ReferenceContact"]
