"""Contact of the cloth with obstacles. Half-spaces (tables, floors) have a closed form."""

from diffcloud.sim.contact.halfspace import ContactSettings, HalfSpaceContact, HalfSpaces

__all__ = ["ContactSettings", "HalfSpaceContact", "HalfSpaces"]
