"""The pose that a simulated motion is compared at: the one of lowest loss, by Gauss and Newton's steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from diffcloud.estimation.pose import PoseSpace

Terms = Callable[[Tensor, float, Tensor | None], tuple[Tensor, Tensor, Tensor]]
"""Poses [b, d], a factor of the cap, and which entries [b] of the batch they belong to (None: all) -> loss [b], half of its
slope [b, d] and of its curvature [b, d, d]."""
_LARGEST = 300.0
"""Step, in what is resolved (`PoseSpace.resolved`)."""
_DAMPING = 1e-6


def aligned(space: PoseSpace, start: Tensor, terms: Terms, caps: Sequence[float]) -> Tensor:
    """[B, d] poses that steps from `start` [B, d] lead to, each one on the loss with another factor of the cap.

    An entry of the batch stops early once the factor is 1 and its step is small, whatever the others do. The scale stays
    until then: a scene that lies elsewhere comes nearer as it shrinks.
    """
    poses, going = start.clone(), torch.arange(len(start))
    eye = torch.eye(len(space.names), dtype=torch.float64)
    unscaled = space.unscaled
    for cap in caps:
        loss, slope, curvature = terms(poses[going], cap, None if len(going) == len(start) else going)
        # without a cap, a frame in which no place counts has an infinite loss; there, no prior holds the pose
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
