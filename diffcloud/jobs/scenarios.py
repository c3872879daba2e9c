"""Find scenarios by name: built-in ones, the user's own in raw/scenes, and those of fits."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from diffcloud.console import warn
from diffcloud.errors import ConfigError

if TYPE_CHECKING:
    from diffcloud.scene.scenarios import Scenario
    from diffcloud.scene.scenarios.catalogue import Options

OWN_SCENARIOS = Path("raw/scenes")
"""Folder of the user's own scenario files."""


def choose_scenario(name: str | None, scene: Path | None = None) -> Scenario:
    """Load a scenario and warn about parts of its scene that are not simulated."""
    from diffcloud.scene.scenarios import load_scenario  # imported here because it takes seconds, also for --help

    own = None if name is None else _own(name)
    scenario = load_scenario(name if own is None else own, scene)
    for message in limits(scenario):
        warn(message)
    return scenario


def scene_named(source: str) -> Scenario:
    """Load the scenario that the option --scene names.

    Args:
        source: a built-in name, a YAML file, a name in raw/scenes, an ARCSim scene JSON, or NAME=FILE.json for a published
            scenario with its scene file.

    Raises:
        ConfigError, SceneError: the scenario does not exist, or its file is damaged.
    """
    name, equals, file = source.partition("=")
    if equals and file.endswith(".json") and not Path(source).exists():
        return choose_scenario(name, Path(file))
    return choose_scenario(None, Path(source)) if source.endswith(".json") else choose_scenario(source)


def scenario_options(name: str) -> Options:
    """Return the fields of a built-in scenario or of the user's own scenario.

    Raises:
        ConfigError, SceneError: the scenario does not exist, or its file is damaged.
    """
    from diffcloud.scene.scenarios import built_in, read_options

    own = _own(name)
    return built_in(name) if own is None else read_options(own)


def fitted_scenario(fit: Path, name: str) -> str:
    """Find the scenario of a fit: a file written beside the fit, a built-in or own scenario, or a local file.

    Args:
        fit: JSON file of the fit.
        name: scenario name in the fit.

    Raises:
        ConfigError: there is no such scenario.
    """
    from diffcloud.scene.scenarios import SCENARIO_NAMES

    beside, here = fit.parent / "scenes" / f"{name}.yaml", Path(f"{name}.yaml")
    if beside.is_file():
        return str(beside)
    if name in SCENARIO_NAMES or _own(name) is not None:
        return name
    if here.is_file():
        return str(here)
    raise ConfigError(
        f"{fit} was fitted with the scenario {name}, which was not found. Put its YAML file into {fit.parent}/scenes/."
    )


def own_scene(source: str) -> Path | None:
    """Return the YAML file that --scene names, by path or by its name in raw/scenes; None for a built-in or scene JSON."""
    return Path(source) if source.endswith((".yaml", ".yml")) else _own(source)


def _own(name: str) -> Path | None:
    """Return the file of the user's own scenario with that name, or None. A built-in name always means the built-in."""
    from diffcloud.scene.scenarios import SCENARIO_NAMES

    path = OWN_SCENARIOS / f"{name}.yaml"
    return path if name not in SCENARIO_NAMES and path.is_file() else None


def limits(scenario: Scenario) -> list[str]:
    """Warnings: obstacles that the contact model does not support, and a mesh whose scale is inconsistent."""
    from diffcloud.io.obj import STRETCHED, other_lengths
    from diffcloud.sim.integrators import load_integrator

    factor, lengths = other_lengths(scenario.scene.mesh)
    told = [f"In the mesh of {scenario.name}, {lengths}"] if factor > STRETCHED else []
    surrounding = scenario.scene.surrounding
    meshes = [index for index, obstacle in enumerate(surrounding.obstacles) if obstacle.plane() is None]
    if not meshes or surrounding.reference_contact is not None or load_integrator(scenario.scene.integrator).meshes:
        return told
    return [
        *told,
        f"Obstacles {meshes} of {scenario.name} are not planar. Contact of this scene is simulated with planes only: the "
        "cloth passes through these, and results are valid until the first such contact.",
    ]
