"""Fitting simulator parameters to point clouds with the simulator's derivatives."""

from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace, Variable
from diffcloud.fit.result import FitResult, physical_values, read_fit, write_fit
from diffcloud.fit.solvers import AdamSettings, GaussNewtonSettings, Progress, fit_adam, fit_gauss_newton, solve

__all__ = [
    "AdamSettings",
    "FitResult",
    "FitSpace",
    "GaussNewtonSettings",
    "Objective",
    "Progress",
    "Variable",
    "fit_adam",
    "fit_gauss_newton",
    "physical_values",
    "read_fit",
    "solve",
    "write_fit",
]
