"""Fitting simulator parameters to point clouds by gradient descent."""

from diffcloud.fit.objective import Objective
from diffcloud.fit.optimise import AdamSettings, Progress, fit_adam
from diffcloud.fit.parameters import FitSpace, Variable
from diffcloud.fit.result import FitResult, physical_values, read_fit, write_fit

__all__ = [
    "AdamSettings",
    "FitResult",
    "FitSpace",
    "Objective",
    "Progress",
    "Variable",
    "fit_adam",
    "physical_values",
    "read_fit",
    "write_fit",
]
