"""Pose of lowest loss at which a simulated motion is compared, found by Gauss–Newton steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from diffcloud.estimation.pose import PoseSpace

Terms = Callable[[Tensor, float, Tensor | None], tuple[Tensor, Tensor, Tensor]]
"""Function that returns the loss [b], half its gradient [b, d] and half its Hessian approximation [b, d, d]. Its
arguments are poses [b, d], a factor of the distance cap, and the batch entries [b] of the poses (None: all)."""
_LARGEST = 300.0
"""Maximum step, in multiples of `PoseSpace.resolved`."""
_DAMPING = 1e-6


def aligned(space: PoseSpace, start: Tensor, terms: Terms, caps: Sequence[float]) -> Tensor:
    """Return poses [B, d] after one Gauss–Newton step from `start` [B, d] for each factor of the distance cap in
    `caps`. A batch entry stops early if the factor is 1 and its step is small. The scale is held fixed while the factor
    is not 1, because shrinking the scene would otherwise make up for a position error."""
    poses, going = start.clone(), torch.arange(len(start))
    eye = torch.eye(len(space.names), dtype=torch.float64)
    unscaled = space.unscaled
    for cap in caps:
        loss, slope, curvature = terms(poses[going], cap, None if len(going) == len(start) else going)
        # without a cap, a frame without visible points has an infinite loss; the prior is then omitted
        prior = torch.where(loss.isfinite(), loss, 0.0)[:, None] * space.prior_weights
        slope, curvature = slope + prior * poses[going], curvature + torch.diag_embed(prior)
        if cap != 1.0:
            slope, curvature = slope * unscaled, curvature * unscaled * unscaled[:, None]
        scaled = curvature * space.resolved[:, None] * space.resolved
        damping = _DAMPING * scaled.diagonal(dim1=-2, dim2=-1).amax(-1).clamp(min=1e-300)
        step = -torch.linalg.solve(scaled + damping[:, None, None] * eye, slope * space.resolved)
        step = step * (_LARGEST / step.abs().amax(-1, keepdim=True).clamp(min=_LARGEST))
        poses[going] += step * space.resolved
        if cap == 1.0:
            going = going[step.abs().amax(-1) >= 1.0]
            if not len(going):
                break
    return poses
