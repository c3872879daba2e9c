"""Numbers that state how a simulation ended."""

DONE = 0
NOT_FINITE = 1
INTERRUPTED = 2
FIRST_OWN = 16
"""Numbers from here on are specific to an integrator, whose `fault` describes them."""
