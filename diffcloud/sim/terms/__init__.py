"""Force terms that all integrators share, one file each.

To add a force, write a file here and list it in `TERMS`. `term.py` defines what a term consists of. `compiled.module`
generates kernels from it. Each integrator adds its contact terms in its own module, such as `implicit.terms`.
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
"""Force terms whose elements are fixed before the simulation."""
