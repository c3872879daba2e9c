"""How an episode can end."""

DONE = 0
NOT_POSITIVE_DEFINITE = 1
NOT_FINITE = 2
UNRESOLVED = 3
"""Impacts of a step that passes of detection and projection did not resolve."""
STUCK = 4
"""An implicit step that did not converge."""
INTERRUPTED = 5
