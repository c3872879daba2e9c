"""Fitting simulator parameters to point clouds with the simulator's derivatives."""

from diffcloud.fit.joint import JointObjective
from diffcloud.fit.objective import Objective
from diffcloud.fit.parameters import FitSpace, Variable
from diffcloud.fit.record import FitRecord, read_fit
from diffcloud.fit.result import FitResult, physical_values, write_fit
from diffcloud.fit.solvers import (
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
