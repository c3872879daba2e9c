"""Simulated data sets for the regressors: sampled parameters, and the simulated motions."""

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
