"""How an episode can end."""

DONE = 0
NOT_FINITE = 1
INTERRUPTED = 2
FIRST_OWN = 16
"""Numbers from here on are an integrator's own; its `fault` explains them."""
