"""Contact detection and contact forces: contact surfaces, pairs of nearby primitives, distances, and collision-free
steps."""
