"""The forces that all integrators have, one file each; `term.py` says what a force is, `compiled.module` what is generated
from it.

A new force is a file here and a line in `TERMS`. Each integrator adds its contact in a module of its own, such as
`implicit.terms`.
"""

from importlib import import_module

from diffcloud.sim.terms.term import Term

TERMS: tuple[Term, ...] = tuple(
    import_module(f"{__name__}.{file}").TERM
    for file in (
        "gravity",
        "stretching",
        "wrinkling",
        "bending",
        "air",
        "handles",
    )
)
"""Forces between nodes that are known before the motion."""
