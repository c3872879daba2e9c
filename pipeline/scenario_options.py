"""Options that choose a scenario, shared by several commands."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.console import warn

if TYPE_CHECKING:
    from diffcloud.scene.scenarios import Scenario

OWN_SCENARIOS = Path("raw/scenes")
"""A person's own scenario files, found by name."""

ScenarioName = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        help="lift, fold, band_stretch, vest_hang, shake, recorded_lift, recorded_fold, release_lift, release_fold, "
        f"release_hang, release_band, a YAML file, or the name of one in {OWN_SCENARIOS}.",
    ),
]
SceneFile = Annotated[Path | None, typer.Option("--scene", help="ARCSim scene JSON.")]


def choose_scenario(name: str | None, scene: Path | None = None) -> Scenario:
    """Load a scenario and say what of its scene is not simulated."""
    from diffcloud.scene.scenarios import SCENARIO_NAMES, load_scenario  # takes seconds, which help does without

    if name is not None and name not in SCENARIO_NAMES and (OWN_SCENARIOS / f"{name}.yaml").is_file():
        name = str(OWN_SCENARIOS / f"{name}.yaml")
    scenario = load_scenario(name, scene)
    for message in limits(scenario):
        warn(message)
    return scenario


def limits(scenario: Scenario) -> list[str]:
    """What the scene asks for and the contact model lacks."""
    surrounding = scenario.scene.surrounding
    meshes = [index for index, obstacle in enumerate(surrounding.obstacles) if obstacle.plane() is None]
    if not meshes or surrounding.reference_contact is not None or scenario.scene.integrator == "implicit":
        return []
    return [
        f"Obstacles {meshes} of {scenario.name} are not planar. Contact of this scene is simulated with planes only: the "
        "cloth passes through these, and results are valid until the first such contact."
    ]
