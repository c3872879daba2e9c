"""Scenarios: a scene with the settings of an experiment, such as compared frames, sampled faces and bounds.

The built-in ones are procedural and in SI units: `lift`, `fold`, `shake` (grid), `band_stretch` (band) and `vest_hang`
(vest). `recorded_lift` and `recorded_fold` (grid) belong to the published recordings with their gripper tracks. The
`release_*` scenarios have the settings of the experiments published with the paper and read the published scene JSON. A
user's scenario is a YAML file that names a built-in one and the fields that differ.
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
