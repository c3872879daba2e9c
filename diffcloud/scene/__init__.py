"""Scenes: the built-in scenarios, YAML files that vary them, and scene files, all turned into (System, State)."""

from diffcloud.scene.description import Scene
from diffcloud.scene.registry import load_scene
from diffcloud.scene.scenarios import SCENARIO_NAMES, Scenario, load_scenario

__all__ = ["SCENARIO_NAMES", "Scenario", "Scene", "load_scenario", "load_scene"]
