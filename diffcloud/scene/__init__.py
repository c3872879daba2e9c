"""Scenes: built-in scenarios, YAML files that modify them, and scene files. All become (System, State)."""

from diffcloud.scene.description import Scene
from diffcloud.scene.registry import load_scene
from diffcloud.scene.scenarios import SCENARIO_NAMES, Scenario, load_scenario

__all__ = ["SCENARIO_NAMES", "Scenario", "Scene", "load_scenario", "load_scene"]
