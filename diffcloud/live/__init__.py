"""Live view of the cameras during a recording."""
