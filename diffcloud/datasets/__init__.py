"""Simulated sets for the regressors: draws of parameters, and the runs that the simulator gives for them."""

from diffcloud.datasets.chunks import CHUNK, Replaced
from diffcloud.datasets.draws import Draws, ParameterBox, ParameterDraws
from diffcloud.datasets.simulation import SimulationOutcome, SimulationPlan, export_clouds, simulate_set

__all__ = [
    "CHUNK",
    "Draws",
    "ParameterBox",
    "ParameterDraws",
    "Replaced",
    "SimulationOutcome",
    "SimulationPlan",
    "export_clouds",
    "simulate_set",
]
