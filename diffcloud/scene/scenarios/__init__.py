"""Scenarios: a scene and how an experiment looks at it (which frame, which faces, which bounds).

The built-ins are procedural and in SI: `lift`, `fold`, `shake` (grid), `band_stretch` (band), `vest_hang` (vest), and, for
the published recordings under their gripper's track, `recorded_lift` and `recorded_fold` (grid). The `release_*` scenarios
carry the settings of the experiments published with the paper and take their scene from the published JSON. A
person's own scenario is a YAML file that starts from a built-in and changes what differs.
"""

from diffcloud.io.published import PAPER_THRESHOLD, RELEASE_UNIT_M
from diffcloud.scene.scenarios.band import BandScenario, band_scenario
from diffcloud.scene.scenarios.catalogue import SCENARIO_NAMES, built_in, load_scenario, make_scenario, read_options
from diffcloud.scene.scenarios.grid import GridScenario, grid_scenario
from diffcloud.scene.scenarios.scenario import Recorder, Scenario
from diffcloud.scene.scenarios.vest import VestScenario, vest_scenario

__all__ = [
    "PAPER_THRESHOLD",
    "RELEASE_UNIT_M",
    "SCENARIO_NAMES",
    "BandScenario",
    "GridScenario",
    "Recorder",
    "Scenario",
    "VestScenario",
    "band_scenario",
    "built_in",
    "grid_scenario",
    "load_scenario",
    "make_scenario",
    "read_options",
    "vest_scenario",
]
