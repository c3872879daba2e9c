"""Fitting simulator parameters to point clouds with the simulator's derivatives."""

from diffcloud.estimation.joint import JointObjective
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace, Variable
from diffcloud.estimation.record import FitRecord, read_fit
from diffcloud.estimation.result import FitResult, physical_values, write_fit
from diffcloud.estimation.solvers import (
    AdamSettings,
    CmaEsSettings,
    LikelihoodSettings,
    Progress,
    RandomSearchSettings,
    fit_adam,
    fit_cma_es,
    fit_likelihood,
    fit_random_search,
    solve,
)

__all__ = [
    "AdamSettings",
    "CmaEsSettings",
    "FitRecord",
    "FitResult",
    "FitSpace",
    "JointObjective",
    "LikelihoodSettings",
    "Objective",
    "Progress",
    "RandomSearchSettings",
    "Variable",
    "fit_adam",
    "fit_cma_es",
    "fit_likelihood",
    "fit_random_search",
    "physical_values",
    "read_fit",
    "solve",
    "write_fit",
]
