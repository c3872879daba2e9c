"""`diffcloud materials`: the presets with all their numbers."""

from __future__ import annotations

from rich.table import Table

from diffcloud.cli.console import JsonFlag, finish, output, say, show
from diffcloud.sim.materials import preset, presets


def materials(json: JsonFlag = False) -> None:
    """Every preset of a scenario's `material`, in SI, and where its numbers come from."""
    table = Table(
        "material", "density kg/m²", "stretching N/m", "stretched N/m", "Poisson", "shear N/m", "bending N·m", "damping s"
    )
    found = {}
    for name in presets():
        one = preset(name)
        values = {
            "density_kg_m2": one.density,
            "stretching_n_m": one.resting_stretching_stiffness,
            "strained_n_m": one.strained_stretching_stiffness,
            "poisson": one.resting_poisson_ratio,
            "shear_n_m": one.resting_shear_stiffness,
            "bending_n_m": one.resting_bending_stiffness,
            "damping_s": one.damping,
        }
        table.add_row(name, *(f"{value:.3g}" for value in values.values()))
        found[name] = values | {"source": one.source}
    show(table, json)
    if not json:
        for name in presets():
            say(f"{name}:", f"{preset(name).source}.", style="bold", console=output)
    finish(found, json)
