"""Scenes: ARCSim-compatible JSON files and the built-in scenarios, both turned into (System, State)."""

from diffcloud.arcsim.load import load_scene
from diffcloud.arcsim.write import write_scene
from diffcloud.scene.description import Scene
from diffcloud.scene.scenarios import SCENARIO_NAMES, Scenario, load_scenario

__all__ = ["SCENARIO_NAMES", "Scenario", "Scene", "load_scenario", "load_scene", "write_scene"]
