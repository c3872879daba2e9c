"""`diffcloud visibility`: how much a motion shows of the parameters, against a camera's noise."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from diffcloud.cli.console import JsonFlag, finish, output, show
from diffcloud.cli.scenario_options import ScenarioName, SceneFile, choose_scenario
from diffcloud.estimation.visibility import visibility_map
from diffcloud.io.episodes import read_episode


def visibility(
    scenario: ScenarioName = None,
    scene: SceneFile = None,
    episode: Annotated[Path | None, typer.Option(help="Test the motion of its gripper track, over all frames.")] = None,
    noise_mm: Annotated[float, typer.Option(help="Differences above this count as visible.")] = 4.0,
    size: Annotated[int, typer.Option(min=2, help="Grid points per parameter.")] = 5,
    linear: Annotated[bool, typer.Option(help="Linear instead of logarithmic spacing.")] = False,
    json: JsonFlag = False,
) -> None:
    """Map of stretch x mass: RMS node distance in mm between neighbours at the loss frame, or over a recorded motion."""
    chosen = choose_scenario(scenario, scene)
    recorded = None if episode is None else read_episode(episode)
    found = visibility_map(chosen, episode=recorded, size=size, linear=linear)
    for name, distances in (("stretch", found.along_stretch_mm), ("mass", found.along_mass_mm)):
        rows, columns = (found.grid[1:], found.grid) if name == "stretch" else (found.grid, found.grid[1:])
        table = Table(f"step in {name}; stretch \\ mass", *(f"{value:.3g}" for value in columns))
        for value, row in zip(rows, distances, strict=True):
            table.add_row(f"{value:.3g}", *(Text(f"{d:.1f}", "" if d > noise_mm else "dim") for d in row))
        show(table, json)
    fraction = found.visible_fraction(noise_mm)
    if not json:
        from diffcloud.evaluation.summary import percent

        output.print(f"{percent(fraction)} of neighbouring pairs differ by more than {noise_mm} mm.")
    finish(
        {
            "visible_fraction": fraction,
            "grid": found.grid.tolist(),
            "along_stretch_mm": found.along_stretch_mm.tolist(),
            "along_mass_mm": found.along_mass_mm.tolist(),
        },
        json,
    )
