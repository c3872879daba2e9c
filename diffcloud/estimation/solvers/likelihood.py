"""The solver `likelihood`, which wraps `estimation.likelihood`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch

from diffcloud.estimation.joint import AnyObjective
from diffcloud.estimation.likelihood import LikelihoodSettings, estimate
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.residuals import Axis
from diffcloud.estimation.solvers.outcome import FitHistory, FitOutcome, Progress


def fit_likelihood(
    objective: AnyObjective,
    space: FitSpace,
    settings: LikelihoodSettings,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> FitOutcome:
    """Run `estimate` and return its most likely result. The losses in the history are mean squared distances.

    Raises:
        DivergedError, KeyboardInterrupt: see `estimate`.
    """
    began, best = time.perf_counter(), math.inf

    def tell(start: int, step: int, square: float, values: dict[str, float]) -> None:
        nonlocal best
        best = min(best, square)
        if progress is not None:
            progress(Progress(step, square, best, values))

    found = estimate(objective, space, settings, progress=tell)
    squares, places = zip(*found.best.trace, strict=True)
    values = [Axis.of(space).bounded(place[: len(space.names)])[None] for place in places]
    return FitOutcome(
        values=found.values,
        loss=squares[-1],
        best_start=0,
        simulations=found.simulations,
        stop_reason="interrupted" if found.interrupted else "converged" if found.best.converged else "iterations",
        seconds=time.perf_counter() - began,
        history=FitHistory(space.names, [torch.tensor([square]).double() for square in squares], values),
        estimate=found,
    )
