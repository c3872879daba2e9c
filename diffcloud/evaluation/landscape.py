"""Loss over two parameters on a grid, and the optimiser's path."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from diffcloud.estimation.batches import batch_losses
from diffcloud.estimation.objective import Objective
from diffcloud.estimation.parameters import FitSpace
from diffcloud.estimation.record import History


def loss_landscape(
    objective: Objective, space: FitSpace, values: Mapping[str, float], history: History, *, size: int
) -> dict[str, Any] | None:
    """Return the losses over the first two requested parameters, with the others as fitted.

    Args:
        values: fitted values.
        history: history of the fit.
        size: number n of points along each axis between the bounds, at equal ratios, or equal distances if a bound is
            zero.

    Returns:
        names; x, y: [n] values of the first and the second parameter; loss: [n][n] with rows of y, None if a run
            diverged; paths: [iterations][2] for each start; fitted: [2]. None if fewer than two parameters are
            requested.
    """
    if len(space.asked.variables) < 2:
        return None
    first, second = space.variables[:2]
    axes = [np.geomspace(v.low, v.high, size) if v.low > 0 else np.linspace(v.low, v.high, size) for v in (first, second)]
    x, y = np.meshgrid(*axes)
    places = np.tile([values[name] for name in space.names], (size * size, 1))
    places[:, 0], places[:, 1] = x.ravel(), y.ravel()
    losses = batch_losses(objective, space, torch.as_tensor(places).double()).reshape(size, size)
    columns = [history.names.index(variable.name) for variable in (first, second)]
    paths = np.array(history.values, dtype=np.float64)[:, :, columns].swapaxes(0, 1)  # [B, N, 2]; None is NaN
    begun = np.isfinite(np.array(history.loss, dtype=np.float64)).T & np.isfinite(paths).all(-1)
    return {
        "names": [first.name, second.name],
        "x": axes[0].tolist(),
        "y": axes[1].tolist(),
        "loss": [[value if np.isfinite(value) else None for value in row] for row in losses.tolist()],
        "paths": [path[there].tolist() for path, there in zip(paths, begun, strict=True) if there.any()],
        "fitted": [values[first.name], values[second.name]],
    }
